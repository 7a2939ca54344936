"""How the loops of an export were run over the rows of its record."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.historian.grid import Grid
from pipeline.historian.guessing import LOOP
from pipeline.historian.tags import Tag
from pipeline.metrics import Array
from pipeline.records.operated import Operated, operation

AUTOMATIC = re.compile(r"a|aut.*|r?cas.*|kas.*", re.IGNORECASE)  # names of modes in which a controller moves the MV


def operated(
    grid: Grid, code: NDArray[np.uint8], tags: Sequence[Tag], modes: Mapping[str, Sequence[str]]
) -> tuple[Operated, ...]:
    """The loops whose set point is known. ``code`` (n,) is 0 in rows of the record, ``modes`` are names by tag."""
    sps, pvs, mvs = ([t for t in tags if t.role == role] for role in ("sp", "pv", "mv"))
    found = []
    for place, sp in enumerate(sps):
        pv = _partner(sp, pvs, place)
        mode = _partner(sp, [t for t in tags if t.role == "mode"], 0 if len(sps) == 1 else -1)
        if pv is None:
            continue
        rows = (code == 0) & ~np.isnan(grid.value[sp.tag])
        auto = _automatic(grid.value[mode.tag], modes[mode.tag]) if mode is not None else None
        if auto is not None and np.any(rows & auto):
            rows = rows & auto
        else:
            auto = None
        if not rows.any():
            continue
        # A row that is left out ends a piece: what the MV did meanwhile is not this loop's.
        piece = grid.piece[rows] + np.cumsum(np.diff(np.flatnonzero(rows), prepend=np.flatnonzero(rows)[0] - 1) > 1)
        moves = np.column_stack([grid.value[t.tag][rows] for t in mvs]).astype(np.float64)
        error, travel = operation(grid.value[sp.tag][rows], grid.value[pv.tag][rows], moves, piece, grid.period_s)
        found.append(
            Operated(
                pv.name,
                pv.unit,
                int(np.count_nonzero(rows)),
                auto is not None,
                error,
                {t.name: float(v) for t, v in zip(mvs, travel, strict=True)},
                {t.name: t.unit for t in mvs},
            )
        )
    return tuple(found)


def _partner(sp: Tag, tags: Sequence[Tag], place: int) -> Tag | None:
    """The tag of the same loop by its name; else the one at a place, -1: none."""
    own = LOOP.match(sp.tag)
    for tag in tags:
        match = LOOP.match(tag.tag)
        if own is not None and match is not None and match["loop"] == own["loop"]:
            return tag
    return tags[place] if 0 <= place < len(tags) else None


def _automatic(mode: Array, names: Sequence[str]) -> NDArray[np.bool_] | None:
    """Rows (n,) whose mode is an automatic one; None where no mode of the tag is known as such."""
    known = [i for i, name in enumerate(names) if AUTOMATIC.fullmatch(name.strip())]
    return np.isin(mode, known) if known else None
