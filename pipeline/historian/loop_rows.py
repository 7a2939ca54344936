"""The loops of an export: which set point, PV, mode and MV belong together, and the rows in which each was at work."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.grid import Grid
from loopwright.pipeline.historian.guessing import loop_in
from loopwright.pipeline.historian.tags import Tag, automatic, by_hand
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.set_points import SetPoints


@dataclass(frozen=True, slots=True, eq=False)
class LoopRows:
    """One loop over the rows (n,) of the record in which it is automatic, or over all where no mode is known."""

    sp: Tag
    pv: Tag
    own_mvs: tuple[Tag, ...]  # the MV of the same name; where no name tells, all of them
    same_name: bool  # whether a name tells
    automatic: bool  # whether a mode says which rows these are
    manual: bool  # whether a mode says that it was in manual in each of them: no controller was at work
    rows: NDArray[np.bool_]  # of the grid
    piece: NDArray[np.int64]  # (n,) counts up where rows are left out: what the MV did meanwhile is not this loop's


def loops(
    grid: Grid, code: NDArray[np.uint8], tags: Sequence[Tag], modes: Mapping[str, Sequence[str]]
) -> Iterator[LoopRows]:
    """The loops whose set point is known. ``code`` (n,) is 0 in rows of the record, ``modes`` are names by tag."""
    sps, pvs, mvs = ([t for t in tags if t.role == role] for role in ("sp", "pv", "mv"))
    for place, sp in enumerate(sps):
        pv = _partner(sp, pvs, place)
        mode = _partner(sp, [t for t in tags if t.role == "mode"], 0 if len(sps) == 1 else -1)
        if pv is None:
            continue
        mv = _partner(sp, mvs, -1)
        rows = (code == 0) & ~np.isnan(grid.value[sp.tag])
        auto = _rows_of(automatic, grid.value[mode.tag], modes[mode.tag]) if mode is not None else None
        hand = _rows_of(by_hand, grid.value[mode.tag], modes[mode.tag]) if mode is not None else None
        known = auto is not None and bool(np.any(rows & auto))
        if auto is not None and known:
            rows = rows & auto
        if not rows.any():
            continue
        kept = np.flatnonzero(rows)
        piece = grid.piece[rows] + np.cumsum(np.diff(kept, prepend=kept[0] - 1) > 1)
        own, manual = tuple(mvs) if mv is None else (mv,), hand is not None and bool(hand[rows].all())
        yield LoopRows(sp, pv, own, mv is not None, known, manual, rows, piece)


def set_points(
    grid: Grid, code: NDArray[np.uint8], tags: Sequence[Tag], modes: Mapping[str, Sequence[str]], worked: Container[str]
) -> SetPoints:
    """The set points in the rows of the record, of loops whose mode is known or whose PV is among those ``worked`` on.

    Nobody knows of the others whether their set points were followed.
    """
    known = [loop for loop in loops(grid, code, tags, modes) if loop.automatic or loop.pv.name in worked]
    columns = [np.where(loop.rows, grid.value[loop.sp.tag], np.nan)[code == 0] for loop in known]
    values = np.column_stack(columns) if columns else np.empty((int(np.count_nonzero(code == 0)), 0))
    return SetPoints(tuple(loop.pv.name for loop in known), values.astype(np.float64))


def _partner(sp: Tag, tags: Sequence[Tag], place: int) -> Tag | None:
    """The tag of the same loop, as a person or its name says; else the one at a place, -1: none."""
    own = loop_in(sp)
    for tag in tags:
        if own and loop_in(tag) == own:
            return tag
    return tags[place] if 0 <= place < len(tags) else None


def _rows_of(kind: Callable[[str], bool], mode: Array, names: Sequence[str]) -> NDArray[np.bool_] | None:
    """Rows (n,) whose mode has a name of a kind; None where no mode of the tag has one."""
    known = [i for i, name in enumerate(names) if kind(name)]
    return np.isin(mode, known) if known else None
