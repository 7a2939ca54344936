"""Stretches in which a PV and the inputs contradict each other: no answer, an answer to nothing, the other sign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.cleaning.findings import Finding, counted
from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import runs_of
from loopwright.pipeline.metrics import Array

SHORTEST_WINDOW, LONGEST_WINDOW, WINDOW_SETTLINGS = 60, 400, 2.0  # rows of a window, in rows and in settling times
STEPS = 4  # a window begins at every quarter of one
WHOLE_WINDOW = 0.7  # of a window's rows must have both values
TRUSTED = 0.8  # median share of the variance that the inputs explain in a window: else nothing is judged
# explained share of at least this, in at least so many windows of the same region
EXPLAINED_SHARE, OTHER_WINDOWS = 0.6, 3
COVERED = 0.6  # of a window's expected range, that a window of the same region must cover
SMALL_MOTION, HIGH_CORRELATION = 0.3, 0.5  # one motion against another, and correlations
RESIDUAL_EDGE = 6.0  # medians of the residual
MOST_CONTRADICTED = 0.4  # of the rows: more are no exception
WORDS = {
    "no answer": "does not answer to its inputs as it does elsewhere: a dead sensor or a closed loop around another",
    "no cause": "moves while its inputs rest: a frozen input, or a load that nobody measures",
    "other sign": "answers with the other sign",
}


@dataclass(frozen=True, slots=True, eq=False)
class MotionWindows:
    """First rows (m,) of windows of ``length`` rows, and of each: the motions, their correlation, what is expected."""

    length: int
    start: NDArray[np.int64]
    actual: Array  # (m,) standard deviation of the PV
    expected: Array  # (m,) of what the inputs explain
    correlation: Array  # (m,)
    share: Array  # (m,) of the PV's variance that they explain
    low: Array  # (m,) smallest expected value
    high: Array

    @classmethod
    def of(cls, y: Array, expected: Array, length: int) -> MotionWindows:
        """From a PV y (n,) and its expected values (n,); windows with too many gaps are left out."""
        part = max(length // STEPS, 1)
        m = len(y) // part
        ok = np.isfinite(y[: m * part]) & np.isfinite(expected[: m * part])
        y0, e0 = (float(np.mean(v[: m * part][ok])) if ok.any() else 0.0 for v in (y, expected))
        v = np.where(ok, y[: m * part] - y0, 0.0)
        e = np.where(ok, expected[: m * part] - e0, 0.0)

        def sums(values: Array) -> Array:
            """Over each window of STEPS parts, (m - STEPS + 1,)."""
            return np.convolve(values.reshape(m, part).sum(axis=1), np.ones(STEPS), "valid")

        if m < STEPS:
            ok, v, e, m = np.zeros(STEPS * part, bool), np.zeros(STEPS * part), np.zeros(STEPS * part), STEPS
        count = sums(ok.astype(np.float64))
        n = np.maximum(count, 1.0)
        my, me = sums(v) / n, sums(e) / n
        vv, ee, ve = sums(v * v) / n - my**2, sums(e * e) / n - me**2, sums(v * e) / n - my * me
        floor = np.where(ok, e, np.inf).reshape(m, part).min(axis=1)
        ceiling = np.where(ok, e, -np.inf).reshape(m, part).max(axis=1)
        low = np.min([floor[i : m - STEPS + 1 + i] for i in range(STEPS)], axis=0) + e0
        high = np.max([ceiling[i : m - STEPS + 1 + i] for i in range(STEPS)], axis=0) + e0
        sd, motion = np.sqrt(np.maximum(vv, 0.0)), np.sqrt(np.maximum(ee, 0.0))
        both = ve / np.maximum(sd * motion, 1e-300)
        share = 1.0 - (vv + ee - 2 * ve) / np.maximum(vv, 1e-300)
        keep = count >= WHOLE_WINDOW * STEPS * part
        start = np.arange(m - STEPS + 1, dtype=np.int64) * part
        return cls(STEPS * part, start[keep], *(a[keep] for a in (sd, motion, both, share, low, high)))


def contradict(
    grid: Grid, signals: Sequence[Tag], expected: Mapping[str, Array], settling: Mapping[str, int]
) -> list[Finding]:
    """Mask such stretches of each PV, which ``expected`` (n,) the inputs explain; changes the grid's codes in place.

    Only where the inputs explain the PV well in most windows, and also in the region of the stretch: a gain that
    changes over the range is no contradiction.
    """
    found = []
    for tag in (t for t in signals if t.role == "pv"):
        y = np.where(grid.code[tag.tag] == 0, grid.value[tag.tag], np.nan)
        if tag.tag in grid.limits:
            y[grid.limits[tag.tag]] = np.nan  # there it answers to nothing by right
        length = int(np.clip(WINDOW_SETTLINGS * settling.get(tag.tag, 0), SHORTEST_WINDOW, LONGEST_WINDOW))
        windows = MotionWindows.of(y, expected[tag.tag], length)
        for kind, rows in _judged(windows, len(y)).items():
            if kind == "no cause":
                rows = _with_its_rest(rows, [grid.value[t.tag] for t in signals if t.role == "mv"])
            elif rows.any():
                rows = _to_its_edges(rows, np.abs(y - expected[tag.tag]), length // 2)
            new = rows & (grid.code[tag.tag] == 0) & np.isfinite(y)
            if new.any():
                grid.code[tag.tag][new] = Reason.UNLIKE
                start, end = runs_of(rows)
                words = (
                    f"{WORDS[kind]}, in {counted(int(new.sum()), 'row')}, from row {int(start[0])} to {int(end[-1])}"
                )
                found.append(Finding("unlike", tag.tag, words, True))
    return found


def _with_its_rest(rows: NDArray[np.bool_], inputs: Sequence[Array]) -> NDArray[np.bool_]:
    """The rows, and with them the whole of the longest rest of an MV that has a part in them."""
    out = rows.copy()
    for u in inputs:
        start, end = runs_of(np.r_[False, np.diff(u) == 0])
        for a, b in zip(*runs_of(rows), strict=True):
            rests = [(e - s, s, e) for s, e in zip(start, end, strict=True) if s < b and e > a]
            if rests and max(rests)[0] >= 0.5 * (b - a):
                _, s, e = max(rests)
                out[s:e] = True
    return out


def _to_its_edges(rows: NDArray[np.bool_], residual: Array, most: int) -> NDArray[np.bool_]:
    """The rows, and up to ``most`` on each side as long as half of the residuals (n,) stay beyond what is usual."""
    far = residual > RESIDUAL_EDGE * float(np.nanmedian(residual[~rows]))
    out = rows.copy()
    for a, b in zip(*runs_of(rows), strict=True):
        out[a - _reach(far[max(a - most, 0) : a][::-1]) : b + _reach(far[b : b + most])] = True
    return out


def _reach(far: NDArray[np.bool_]) -> int:
    """Rows up to the last one that is far, with half of all before it."""
    share = np.cumsum(far) / np.arange(1, len(far) + 1)
    last = np.flatnonzero(far & (share >= 0.5))
    return int(last[-1]) + 1 if last.size else 0


def _judged(w: MotionWindows, n: int) -> dict[str, NDArray[np.bool_]]:
    """Rows (n,) by kind; none where the inputs explain the PV badly, or too many rows are struck."""
    if len(w.start) < 2 * OTHER_WINDOWS:
        return {}
    moving = np.maximum(w.actual, w.expected) > SMALL_MOTION * float(np.median(w.actual))
    if not moving.any() or float(np.median(w.share[moving])) < TRUSTED:
        return {}
    usual = float(np.median(w.expected[moving]))
    silent, alone = w.actual < SMALL_MOTION * w.expected, w.expected < SMALL_MOTION * w.actual
    kinds = {
        "no answer": moving & silent & (np.abs(w.correlation) < SMALL_MOTION) & (w.expected > SMALL_MOTION * usual),
        "no cause": moving & alone & (w.correlation < HIGH_CORRELATION) & (w.actual > SMALL_MOTION * usual),
        "other sign": moving
        & ~silent
        & ~alone
        & (w.correlation < -HIGH_CORRELATION)
        & (w.actual > SMALL_MOTION * usual),
    }
    found = {}
    struck = np.zeros(n, dtype=bool)
    for kind, flagged in kinds.items():
        rows = np.zeros(n, dtype=bool)
        for i in np.flatnonzero(flagged):
            if _explained_elsewhere(w, int(i)):
                rows[w.start[i] : w.start[i] + w.length] = True
        found[kind] = rows & ~struck
        struck |= rows
    return found if struck.mean() <= MOST_CONTRADICTED else {}


def _explained_elsewhere(w: MotionWindows, i: int) -> bool:
    """Whether windows that expect the same values, and do not overlap this one, are explained well."""
    span = max(float(w.high[i] - w.low[i]), 1e-300)
    covered = (np.minimum(w.high, w.high[i]) - np.maximum(w.low, w.low[i])) / span
    same = (covered >= COVERED) & (np.abs(w.start - w.start[i]) >= w.length)
    good = same & (w.share >= EXPLAINED_SHARE)
    return int(good.sum()) >= OTHER_WINDOWS and good.sum() >= 0.5 * same.sum()
