"""How the loops of an export were run over the rows of its record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.grid import Grid
from loopwright.pipeline.historian.loop_rows import loops
from loopwright.pipeline.historian.tags import Tag
from loopwright.pipeline.records.operated import Operated, operation


def operated(
    grid: Grid, code: NDArray[np.uint8], tags: Sequence[Tag], modes: Mapping[str, Sequence[str]]
) -> tuple[Operated, ...]:
    """The loops whose set point is known, without those that were in manual all the time: nothing followed it.

    ``code`` (n,) is 0 in rows of the record, ``modes`` are names by tag.
    """
    mvs, found = [t for t in tags if t.role == "mv"], []
    for loop in loops(grid, code, tags, modes):
        if loop.manual:
            continue
        rows, pv = loop.rows, loop.pv
        moves = np.column_stack([grid.value[t.tag][rows] for t in mvs]).astype(np.float64)
        error, travel = operation(
            grid.value[loop.sp.tag][rows], grid.value[pv.tag][rows], moves, loop.piece, grid.period_s
        )
        found.append(
            Operated(
                pv.name,
                pv.unit,
                int(np.count_nonzero(rows)),
                loop.automatic,
                error,
                {t.name: float(v) for t, v in zip(mvs, travel, strict=True)},
                {t.name: t.unit for t in mvs},
            )
        )
    return tuple(found)
