"""Readings at their own times -> rows at one period."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.sampling import (
    TagSampling,
    exact_step,
    row_numbers,
    sampling,
    whole_multiple,
)
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.files.numbers import Codes
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.metrics import Array

# in all, and for each reading: a record of more is mostly filled in
MOST_GRID_ROWS, MOST_ROWS_A_READING = 20_000_000, 20
THINNED = 1.9  # readings a period from which PVs are averaged
LEAST_PIECE = 2  # rows
ENOUGH_READINGS = 0.3  # of the usual readings of a period, for their mean
LONG_GRID = 1_000_000  # rows
GRID_CHUNK = 500_000  # rows


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Rows at one period. Row k: PVs at ``time_s`` [k], what is held over the period from there on."""

    period_s: float
    time_s: Array  # (n,) [s] as the export counts
    piece: NDArray[np.int64]  # (n,) number of the piece between two gaps in time
    value: dict[str, Array]  # (n,) NaN where there is no value
    code: dict[str, Codes]  # (n,) why there is none; GOOD where there is one
    bridged: dict[str, int]  # rows whose value was drawn or held over a bad or missing reading
    limits: dict[str, NDArray[np.bool_]] = field(default_factory=dict)  # (n,) at its lowest or highest value
    fresh: dict[str, NDArray[np.bool_]] = field(default_factory=dict)  # (n,) of an analyser: rows with a new reading

    def __len__(self) -> int:
        return len(self.time_s)

    def known(self, tag: str) -> Array:
        """The tag's values (n,), NaN where it has a reason or stands at its end; its own array where it never does.

        At the end it answers to nothing.
        """
        code = self.code[tag]
        out = (code != 0) | self.limits[tag] if tag in self.limits else code != 0
        return np.where(out, np.nan, self.value[tag]) if out.any() else self.value[tag]

    def put(self, tag: str, value: Array, fresh: NDArray[np.bool_]) -> None:
        """An analyser's values (n,), with the rows (n,) that have a new reading: none takes a row of others away."""
        self.value[tag], self.fresh[tag] = value, fresh
        self.code[tag], self.bridged[tag] = np.zeros(len(self), np.uint8), 0

    def lighten(self, tag: str) -> None:
        """Keep single precision of a long tag: enough for what is only drawn from here on."""
        if len(self) > LONG_GRID:
            self.value[tag] = self.value[tag].astype(np.float32)


def resampled(
    pv: Sequence[Series],
    held: Sequence[Series],
    period_s: float,
    hold_s: float | None = None,
    done: Callable[[str], None] = lambda _: None,
    *,
    sampled: bool = False,
) -> tuple[Grid, tuple[TagSampling, ...]]:
    """All series on one grid: PVs and measured disturbances (``pv``) drawn or averaged, the others held.

    Grid: pieces of the PVs' time without a gap longer than their hold. Where the PVs' stamps keep time and the period
    is a whole multiple of their step, every reading (every n-th) is a row at its own time, so that nothing adds up
    along the record; else rows at one period, with the phase of the piece's stamps.
    PVs: held where they are stored beyond a dead band, or their series says so, else on a straight line between two
    good readings no farther apart than the hold; where two or more readings fall into a period, the mean over
    (t - h, t], against aliasing.
    Held ones: the reading that holds at the middle between t and the next row, so that jitter of less than half a
    period does not matter; the mean over it where they are thinned out. ``done`` is called with each tag
    whose readings are needed no more.
    ``sampled``, for MVs that follow the PVs: no means, but what a controller of that period sees and does at the row's
    own time. The mean of an MV holds what a controller did because of the PV's noise within that row; a model takes it
    for the plant's answer, and starts the wrong way.
    """
    if not period_s > 0:
        raise RecordError(f"the period is {period_s:g} s; it must be positive")
    rates = {s.tag: sampling(s, period_s, hold_s) for s in (*pv, *held)}
    time_s, piece, step_s = _times(pv, period_s, max(rates[s.tag].hold_s for s in pv))
    scan_s = min((period_s, *(rates[s.tag].step_s for s in pv if rates[s.tag].step_s))) if sampled else period_s
    middle = time_s + 0.5 * np.minimum(np.diff(time_s, append=np.inf), scan_s)
    value, code, bridged = {}, {}, {}
    for s in (*pv, *held):
        rate = rates[s.tag]
        thin = not sampled and 0 < rate.step_s * THINNED <= period_s and not s.categories and not rate.irregular
        if s in pv and thin:
            out, over = _mean(time_s, *_good(s), period_s, 0.5 * step_s)
        elif thin:
            out, over = _held(time_s, middle, *_good(s), period_s, rate.hold_s, thin)
        else:
            line = s.between == "line" or (s in pv and not rate.dead_band)
            # A held signal that goes on a line is worth its middle over a period.
            at = time_s if s in pv or not line else middle
            out, over = _in_chunks(_line if line else _held, at, middle, s, period_s, rate.hold_s)
        value[s.tag], code[s.tag] = out, _reasons(time_s, s, out, period_s)
        bridged[s.tag] = 0 if rate.irregular else int(np.count_nonzero(over))
        done(s.tag)
    return Grid(period_s, time_s, piece, value, code, bridged), tuple(rates.values())


def _times(pv: Sequence[Series], h: float, gap_s: float) -> tuple[Array, NDArray[np.int64], float]:
    """Times (n,) of the rows, their pieces (n,), and the step of the readings that are rows, 0 where none are."""
    one = all(s.time_s is pv[0].time_s for s in pv) and bool(np.all(np.diff(pv[0].time_s) > 0))
    clock = pv[0].time_s if one else np.unique(np.concatenate([s.time_s for s in pv]))
    if not clock.size:
        raise RecordError("the process variables have no reading with a time; export a longer time")
    cuts = np.flatnonzero(np.diff(clock) > gap_s) + 1
    starts, ends = np.r_[0, cuts], np.r_[cuts, len(clock)]
    rows = (clock[ends - 1] - clock[starts]) / h + 1
    if rows.sum() > min(MOST_GRID_ROWS, MOST_ROWS_A_READING * len(clock)):
        raise RecordError(
            f"a period of {h:g} s gives {rows.sum():.3g} rows from {len(clock)} readings; give a longer --period"
        )
    step_s = exact_step(clock) or 0.0
    factor = whole_multiple(h, step_s) if step_s else 0
    times: list[Array] = []
    pieces: list[NDArray[np.int64]] = []
    own = factor > 0
    for start, end in zip(starts, ends, strict=True):
        part = clock[start:end]
        number = row_numbers(part, step_s) if factor else None
        at = _even_times(part, h) if number is None else _own_times(part, number, step_s, factor)
        own = own and number is not None
        if len(at) >= LEAST_PIECE:
            times.append(at)
            pieces.append(np.full(len(at), len(pieces), dtype=np.int64))
    if not times and len(clock) > 1 and gap_s < float(np.median(np.diff(clock))):
        raise RecordError(
            f"the hold of {gap_s:g} s is shorter than the time between two readings, "
            f"{float(np.median(np.diff(clock))):.4g} s, so that each stands alone; give a longer --hold, or none"
        )
    if not times:
        raise RecordError(
            f"no stretch of the export is longer than {LEAST_PIECE} periods of {h:g} s; give a shorter --period"
        )
    return np.concatenate(times), np.concatenate(pieces), step_s if own else 0.0


def _own_times(t: Array, number: NDArray[np.int64], step_s: float, factor: int) -> Array:
    """Times of every ``factor``-th row of the stamps t (m,): their own, on a line where a reading is lost.

    The first stamp is none where the mean up to it would miss too many readings.
    """
    first = factor if factor * ENOUGH_READINGS > 1 else 0
    row = np.arange(first, int(number[-1]) + (factor + 1) // 2, factor, dtype=np.float64)
    if len(row) == len(t) == number[-1] + 1:
        return t
    return np.interp(row, number, t) + step_s * np.maximum(row - number[-1], 0.0)


def _even_times(t: Array, h: float) -> Array:
    first = _phase(t[:1000], h)
    return first + h * np.arange(int(np.floor((t[-1] - first) / h + 0.5)) + 1, dtype=np.float64)


def _phase(t: Array, h: float) -> float:
    """First time of a grid that runs through the middle of jittered stamps."""
    angle = 2j * np.pi * (t - t[0]) / h
    mean = np.exp(angle).mean()
    shift = float(np.angle(mean) / (2 * np.pi)) if abs(mean) > 0.5 else 0.0
    return float(t[0]) + (shift * h if abs(shift) > 1e-6 else 0.0)


def _good(s: Series, rows: slice = slice(None)) -> tuple[Array, Array]:
    """Times and values (m,) of the good ones among some readings."""
    good = s.code[rows] == Reason.GOOD
    return s.time_s[rows][good], s.value[rows][good]


def _in_chunks(
    rule: Callable[..., tuple[Array, NDArray[np.bool_]]], at: Array, middle: Array, s: Series, h: float, hold_s: float
) -> tuple[Array, NDArray[np.bool_]]:
    """The rule over GRID_CHUNK rows at a time, and the readings that these rows can see.

    Its steps need several times the memory of its result.
    """
    out, over = np.empty(len(at)), np.empty(len(at), dtype=bool)
    reach = hold_s + 2 * h
    for i in range(0, len(at), GRID_CHUNK):
        own = slice(i, min(i + GRID_CHUNK, len(at)))
        first, last = np.searchsorted(s.time_s, (at[own.start] - reach, at[own.stop - 1] + reach))
        out[own], over[own] = rule(at[own], middle[own], *_good(s, slice(first, last)), h, hold_s)
    return out, over


def _line(at: Array, _middle: Array, t: Array, v: Array, h: float, hold_s: float) -> tuple[Array, NDArray[np.bool_]]:
    out = np.full(len(at), np.nan)
    if not t.size:
        return out, np.zeros(len(at), dtype=bool)
    slack = 1e-6 * h
    right = np.searchsorted(t, at - slack, "left")
    left = np.clip(np.searchsorted(t, at + slack, "right") - 1, 0, len(t) - 1)
    right = np.clip(right, 0, len(t) - 1)
    gap = t[right] - t[left]
    share = np.where(gap > slack, (at - t[left]) / np.where(gap > slack, gap, 1.0), 0.0)
    between = (at >= t[left] - slack) & (at <= t[right] + slack)  # not beyond the last reading
    inside = between & (gap >= -slack) & (gap <= hold_s) & (share >= 0) & (share <= 1)
    exact = np.abs(at - t[left]) <= slack
    out[inside] = (v[left] + share * (v[right] - v[left]))[inside]
    out[exact] = v[left][exact]
    # At the ends of a stretch the nearest reading of the same period counts.
    near = np.where(np.abs(at - t[left]) <= np.abs(at - t[right]), left, right)
    distance = np.abs(at - t[near])
    edge = np.isnan(out) & (distance <= 0.5 * h)
    out[edge] = v[near][edge]
    return out, np.isfinite(out) & (distance > 0.5 * h + slack)


def _mean(at: Array, t: Array, v: Array, h: float, later_s: float = 0.0) -> tuple[Array, NDArray[np.bool_]]:
    """Means over (at - h, at], these ends ``later_s`` later: half a step, where jitter must not move a reading."""
    t = t - later_s if later_s else t
    row = np.searchsorted(at, t - 1e-6 * h, "left")
    inside = row < len(at)
    inside[inside] = at[row[inside]] - t[inside] < h * (1 - 1e-6)
    count = np.bincount(row[inside], minlength=len(at))
    total = np.bincount(row[inside], weights=v[inside], minlength=len(at))
    usual = np.median(count[count > 0]) if count.any() else 1.0
    enough = count >= max(1.0, ENOUGH_READINGS * usual)
    return np.where(enough, total / np.maximum(count, 1), np.nan), enough & (count < 0.7 * usual)


def _held(
    at: Array, middle: Array, t: Array, v: Array, h: float, hold_s: float, thin: bool = False
) -> tuple[Array, NDArray[np.bool_]]:
    if not t.size:
        return np.full(len(at), np.nan), np.zeros(len(at), dtype=bool)
    last = np.searchsorted(t, middle, "right") - 1
    age = middle - t[np.maximum(last, 0)]
    ok = (last >= 0) & (age <= hold_s + 0.5 * h)
    out = np.where(ok, v[np.maximum(last, 0)], np.nan)
    if thin:
        area = np.r_[0.0, np.cumsum(v[:-1] * np.diff(t))]

        def integral(x: Array) -> Array:
            k = np.clip(np.searchsorted(t, x, "right") - 1, 0, len(t) - 1)
            return area[k] + v[k] * (x - t[k])

        mean = (integral(at + h) - integral(at)) / h
        out = np.where(ok & (at >= t[0]), mean, out)
    return out, ok & (age > 1.1 * h)


def _reasons(at: Array, s: Series, out: Array, h: float) -> Codes:
    """For rows without a value, the reason of the bad reading nearest to them within a period; else GAP."""
    code = np.zeros(len(at), np.uint8)
    lost = np.flatnonzero(~np.isfinite(out))
    if not lost.size:
        return code
    code[lost] = Reason.GAP
    bad = np.flatnonzero(~s.good & (s.code != Reason.DUPLICATE))
    if bad.size:
        t = s.time_s[bad]
        right = np.clip(np.searchsorted(t, at[lost]), 0, len(t) - 1)
        left = np.maximum(right - 1, 0)
        near = np.where(np.abs(t[left] - at[lost]) <= np.abs(t[right] - at[lost]), left, right)
        close = np.abs(t[near] - at[lost]) <= 1.05 * h
        code[lost[close]] = s.code[bad[near[close]]]
    return code
