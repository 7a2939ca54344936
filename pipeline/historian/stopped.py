"""Zeros of a measured disturbance: a feed that stopped, or a dead sensor, as the process variables answer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopwright.pipeline.historian.findings import Finding, counted
from loopwright.pipeline.historian.grid import Grid
from loopwright.pipeline.historian.missing_codes import apart_zeros
from loopwright.pipeline.historian.reason import Reason
from loopwright.pipeline.historian.static import explained
from loopwright.pipeline.historian.tags import Tag
from loopwright.pipeline.metrics import Array

BETTER = 0.5  # of the other's squared error: then one of the two explains the PV


def of_zeros(grid: Grid, signals: Sequence[Tag]) -> list[Finding]:
    """Mask zeros of a measured disturbance that a PV contradicts, name the others; changes the grid's codes in place.

    Only zeros that stand apart from all other values. A PV contradicts them where the inputs explain it much better
    if the disturbance goes on a line from the value before to the value after.
    """
    found = []
    for tag in (t for t in signals if t.role == "dv"):
        values = _good(grid, tag.tag)
        n = apart_zeros(values)
        if not n:
            continue
        zero = values == 0.0
        if _contradicted(grid, signals, tag, values, zero):
            grid.code[tag.tag][zero] = Reason.SENTINEL
            words = f"reads 0 in {counted(n, 'row')}, and the process variables go on as if it did not: a dead sensor"
        else:
            words = (
                f"reads 0 in {counted(n, 'row')}, far from all other values: they stay, as of a flow that stopped; if "
                "its sensor was dead then, empty these cells in the export"
            )
        found.append(Finding("zero", tag.tag, words, bool(grid.code[tag.tag][zero].any())))
    return found


def _contradicted(grid: Grid, signals: Sequence[Tag], tag: Tag, values: Array, zero: np.ndarray) -> bool:
    """Whether some PV says that the zeros (n,) of the values (n,) are not true, and none that they are."""
    rows = np.arange(len(values))
    other = np.isfinite(values) & ~zero
    bridged = np.where(zero, np.interp(rows, rows[other], values[other]), values)
    inputs = {t.tag: _good(grid, t.tag) for t in signals if t.role != "pv"}
    against, in_favour = False, False
    for pv in (t.tag for t in signals if t.role == "pv"):
        y = _good(grid, pv)
        true, false = (
            (explained(y, list((inputs | {tag.tag: v}).values()), grid.piece)[0] - y) for v in (values, bridged)
        )
        both = np.isfinite(true) & np.isfinite(false)
        if both.any():
            of_true, of_false = float(np.mean(true[both] ** 2)), float(np.mean(false[both] ** 2))
            against |= of_false < BETTER * of_true
            in_favour |= of_true < BETTER * of_false
    return against and not in_favour


def _good(grid: Grid, tag: str) -> Array:
    return np.where(grid.code[tag] == 0, grid.value[tag], np.nan)
