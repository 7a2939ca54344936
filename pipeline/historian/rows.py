"""Rows of the grid: stuck and saturated stretches, the reason of each row, and the record of those that have none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cells import usual
from loopwright.pipeline.historian.character import clipped, runs_of, stuck
from loopwright.pipeline.historian.export import Series
from loopwright.pipeline.historian.findings import Finding, counted
from loopwright.pipeline.historian.grid import Grid
from loopwright.pipeline.historian.missing_codes import PERCENT
from loopwright.pipeline.historian.reason import Reason
from loopwright.pipeline.historian.sampling import Sampling
from loopwright.pipeline.historian.tags import GUESSED_PAD, KEEP, Tag
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

OVERFLOWS = f"where the plant ends there, as a tank that overflows, {KEEP}"
SHORTEST_RUN = 20  # rows
PAD = 0.1  # of the span, beyond the values seen, in a range that was not given


def stretches(grid: Grid, signals: Sequence[Tag], rates: Mapping[str, Sampling]) -> list[Finding]:
    """Mask stuck and saturated rows of PVs and measured disturbances; changes the grid's codes in place.

    A tag that is stored by exception repeats its value on purpose: it is neither.
    """
    found = []
    spans = {t.tag: float(np.ptp(usual(grid.value[t.tag]))) for t in signals}
    together = grid.piece[1:] == grid.piece[:-1]
    for tag in signals:
        if tag.role == "mv" or rates[tag.tag].irregular:
            continue
        values, code = grid.value[tag.tag], grid.code[tag.tag]
        zero = values == 0.0 if tag.role == "dv" else np.zeros(len(values), dtype=bool)  # a flow that stopped stays
        at_end, ends = clipped(values, tag.low, tag.high)
        at_end &= ~zero
        if at_end.any():
            kept = tag.ends == "keep" or (tag.ends == "" and _within_its_range(tag, values, [end for end, _ in ends]))
            if not kept:
                code[at_end & (code == 0)] = Reason.SATURATED
            grid.limits[tag.tag] = at_end
            kind = "limit" if kept else "saturated"
            found.append(Finding(kind, tag.tag, _of_ends(tag, ends, kept=kept), not kept))
        others = [(grid.value[name], span) for name, span in spans.items() if name != tag.tag]
        still = stuck(values, others, together) & ~zero & ~at_end
        new = still & (code == 0)
        if new.any():
            code[new] = Reason.STUCK
            start, end = runs_of(still)
            some = counted(len(start), "stretch", "stretches")
            words = f"repeats one value in {some}, the longest of {int((end - start).max())} rows"
            found.append(Finding("stuck", tag.tag, f"{words}, while others move", True))
    return found


def _of_ends(tag: Tag, ends: Sequence[tuple[float, int]], *, kept: bool) -> str:
    places = " and ".join(f"{end:g} in {counted(n, 'row')}" for end, n in ends)
    if kept:
        return f"stands at a limit of the plant: {places}; these rows stay"
    given = [v for v in (tag.low, tag.high) if v is not None and any(abs(v - end) <= 1e-6 * abs(v) for end, _ in ends)]
    if given:
        return f"stands at the end of its range: {places}; {OVERFLOWS}"
    return f"stands at its lowest or highest value: {places}, taken for the end of the transmitter's range; {OVERFLOWS}"


def _within_its_range(tag: Tag, values: Array, ends: Sequence[float]) -> bool:
    """Whether a range that was given goes beyond the ends: then the plant ends there, and the transmitter does not.

    A range that may be the guess of the table of tags says nothing.
    """
    if tag.low is None or tag.high is None:
        return False
    low, high = usual(values)
    span = high - low
    guess = (low - GUESSED_PAD * span, high + GUESSED_PAD * span)
    near = 0.05 * span
    guessed = abs(tag.low - guess[0]) < near and abs(tag.high - guess[1]) < near
    slack = 1e-6 * (tag.high - tag.low)
    return not (guessed or (tag.unit == "%" and (tag.low, tag.high) == PERCENT)) and all(
        tag.low + slack < end < tag.high - slack for end in ends
    )


def row_codes(
    grid: Grid, signals: Sequence[Tag], tags: Sequence[Tag], own: Mapping[str, Series], without: Sequence[str]
) -> NDArray[np.uint8]:
    """The first reason of each row over all signals, then of the modes, then of runs that are too short."""
    code = np.zeros(len(grid), np.uint8)
    for t in signals:
        code = np.where(code == 0, grid.code[t.tag], code)
    for t in (t for t in tags if t.role == "mode"):
        names = own[t.tag].categories
        left_out = np.isin(grid.value[t.tag], [names.index(w) for w in without if w in names])
        code[left_out & (code == 0)] = Reason.MODE
    start, end = runs_of(code == 0)
    cut = np.flatnonzero(np.diff(grid.piece)) + 1
    for a, b in zip(start, end, strict=True):
        edges = np.r_[a, cut[(cut > a) & (cut < b)], b]
        for first, last in pairwise(edges):
            if last - first < SHORTEST_RUN:
                code[first:last] = Reason.SHORT_RUN
    return code


def record_of(grid: Grid, code: NDArray[np.uint8], signals: Sequence[Tag]) -> Record:
    """The rows without a reason as a record: a run ends at a gap and at every row that was left out.

    A long grid keeps its values in single precision only.
    """
    kept = np.flatnonzero(code == 0)
    if not kept.size:
        counts = np.bincount(code, minlength=len(Reason))
        words = ", ".join(f"{int(counts[r])} x {r.words}" for r in Reason if counts[r])
        raise RecordError(f"no row of {len(code)} is good in all signals: {words}; {_remedy(counts)}")
    fresh = np.r_[True, (np.diff(kept) > 1) | (np.diff(grid.piece[kept]) > 0)]
    run = np.cumsum(fresh) - 1
    groups = {r: [t for t in signals if t.role == r] for r in ("pv", "mv", "dv")}
    columns = {r: np.empty((len(kept), len(g))) for r, g in groups.items()}
    for role, group in groups.items():
        for i, tag in enumerate(group):
            columns[role][:, i] = grid.value[tag.tag][kept]
            grid.lighten(tag.tag)
    own = {r: tuple(_signal(t, v) for t, v in zip(g, columns[r].T, strict=True)) for r, g in groups.items()}
    position = np.arange(len(run)) - np.maximum.accumulate(np.where(fresh, np.arange(len(run)), 0))
    time_s = position.astype(np.float64) * grid.period_s
    return Record(
        grid.period_s, own["pv"], own["mv"], own["dv"], run, time_s, columns["pv"], columns["mv"], columns["dv"]
    )


def _remedy(counts: NDArray[np.int64]) -> str:
    """Remedies, by the reason that most rows have; short pieces follow from the others."""
    causes = {r: int(counts[r]) for r in Reason if r not in {Reason.GOOD, Reason.SHORT_RUN}}
    most = max(causes, key=lambda r: causes[r])
    if most == Reason.MODE:
        return "leave fewer modes out: give --without-mode for fewer of them"
    if most == Reason.GAP or not causes[most]:
        return "name fewer tags, or a longer --hold"
    if most == Reason.EMPTY:
        return "name fewer tags, or a longer --hold where an empty cell says that nothing changed"
    return "name fewer tags, or export them again"


def _signal(tag: Tag, values: Array) -> Signal:
    """The tag's signal.

    A range that was not given is what the values show: of a percentage 0 to 100, of another MV what was seen, of a
    PV a tenth more. It holds what the controller may command.
    """
    commands = [v for v in (tag.command_low, tag.command_high) if v is not None]
    low, high = min(float(values.min()), *commands, np.inf), max(float(values.max()), *commands, -np.inf)
    if tag.unit == "%" and low >= 0 and high <= 100:
        low, high = 0.0, 100.0
    elif tag.role != "mv":
        pad = PAD * (high - low)
        low, high = (float(f"{v:.3g}") for v in (low - pad, high + pad))
    # A given end may lie on the wrong side of values that nothing forbids.
    if not (low if tag.low is None else tag.low) < (high if tag.high is None else tag.high):
        wide = max(1.0, 0.1 * abs(high))
        low, high = (low if tag.low is None else tag.low) - wide, (high if tag.high is None else tag.high) + wide
        tag = replace(tag, low=None, high=None)
    return tag.signal(low, high)
