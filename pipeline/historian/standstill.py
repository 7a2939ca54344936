"""Stops of the plant: MVs rest at an end or the feed is off, and the PVs leave where they work; with the warm-up."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.cleaning.findings import Finding, counted
from loopwright.pipeline.historian.cleaning.outliers_and_units import TEMPERATURES
from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.tag_checks import CODES, apart_zeros
from loopwright.pipeline.historian.cleaning.tags import KEEP, Tag
from loopwright.pipeline.historian.drift import explained
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import runs_of
from loopwright.pipeline.historian.guessing import seen_range
from loopwright.pipeline.historian.settling import in_words
from loopwright.pipeline.metrics import Array

# ---------------------------------------------- zeros of a measured disturbance: a feed that stopped, or a dead sensor
EXPLAINING_ERROR = 0.5  # of the other's squared error: then one of the two explains the PV


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
            against |= of_false < EXPLAINING_ERROR * of_true
            in_favour |= of_true < EXPLAINING_ERROR * of_false
    return against and not in_favour


def _good(grid: Grid, tag: str) -> Array:
    return np.where(grid.code[tag] == 0, grid.value[tag], np.nan)


# -------------------------------------------------------------------------------------------------- stops of the plant
Where = NDArray[np.bool_]
Band = tuple[float, float]
Rows = tuple[int, int]  # from the first to before the second

SAMPLES = 100_000  # of the time of the record
SHORTEST_STOP, BACK = 20, 10  # rows of a stop, and rows in a row that the signals work again
MOST_STOPPED = 0.3  # of the rows: more is how the plant is run
OUTER = 0.02  # quantile at each end of the band where a signal works
AT_MV_END = 0.01  # of an MV's span at its end
FEED_OFF, FEED_QUIET = 0.02, 0.05  # of a feed's usual value, and of its band: below both it is off, and at rest
BAND_PAD, FAR_BEYOND_BAND = 0.25, 1.0  # widths of a signal's band beyond it: away; far away
BEYOND_MV = 2.0  # how much farther than the MVs, in widths of the band each: no answer goes so far
ARRIVED_WAY, LONG_REST = 0.1, 5.0  # of a PV's way: it has come to rest; and times the way, a rest that no test holds
RETURNED = 0.25  # of how far a PV went in a rest: it is back so near to where it was before
MOSTLY_AWAY, MVS_STILL = 0.5, 0.8  # of a stop's rows: signals are away; MVs rest, where no end says that they do
MOST_STOPS = 5  # of a feed: one that is off again and again is how the plant is run
NAMED = 3  # stops whose times are named


@dataclass(frozen=True, slots=True)
class _Plant:
    """The values (n,) of all signals at one clock, their bands where the plant works, and their usual values."""

    value: Mapping[str, Array]
    band: Mapping[str, Band]
    usual: Mapping[str, float]
    tags: Mapping[str, Tag]

    def of(self, role: str) -> list[str]:
        return [tag for tag in self.value if self.tags[tag].role == role]

    def beyond(self, tag: str, rows: Rows) -> Array:
        """How far a signal is outside its band in some rows (m,), in widths of the band."""
        v, (low, high) = self.value[tag][slice(*rows)], self.band[tag]
        width = max(high - low, 1e-9 * max(abs(low), abs(high), 1e-300))
        return np.maximum(np.maximum(low - v, v - high), 0.0) / width

    def away(self, rows: Rows) -> list[str]:
        """PVs and disturbances that have left their bands."""
        return [
            t for role in ("pv", "dv") for t in self.of(role) if np.mean(self.beyond(t, rows) > BAND_PAD) > MOSTLY_AWAY
        ]

    def off(self, tag: str, rows: Rows) -> bool:
        """Whether a feed is off: near zero beside its usual value, and at rest. A temperature has no zero."""
        if self.tags[tag].unit.strip().casefold() in TEMPERATURES:
            return False
        v, (low, high) = self.value[tag][slice(*rows)], self.band[tag]
        spread = float(np.ptp(np.quantile(v, [0.05, 0.95])))
        most = FEED_OFF * abs(self.usual[tag])
        return abs(float(np.median(v))) < most and spread <= FEED_QUIET * max(high - low, most)

    def far(self, rows: Rows, beyond: float = FAR_BEYOND_BAND) -> bool:
        """Whether every PV is far outside its band, in the median by more than ``beyond`` widths."""
        return all(float(np.median(self.beyond(tag, rows))) > max(FAR_BEYOND_BAND, beyond) for tag in self.of("pv"))


def stops(
    own: Mapping[str, Series], tags: Sequence[Tag], text_of: Callable[[float, float], str]
) -> tuple[list[tuple[float, float]], list[Finding]]:
    """Spans [s] of time in which the plant stood still and warmed up again, and findings for them and for what may be.

    A stop is one of these:

    - A measured disturbance is off, as a feed that stopped; all MVs rest somewhere, and all PVs have left the band
      where they work. A PV is enough where all MVs rest at zero or at an end of their stated range.
    - All MVs rest at such an end, well outside of where they work, and all PVs are far outside of theirs: farther than
      MVs explain, or for so much longer than they took to get there that it is no test. No measured disturbance is as
      it never was before.

    The warm-up lasts until each signal that was away is back in its band. Other long rests far outside are named with
    the ``--leave-out`` that takes them: the largest move of a record may say most of the plant. ``text_of`` writes a
    span [s] as FROM..TO. A tag of an MV whose ``ends`` say keep tells no stop.
    """
    known = {t.tag: t for t in tags if t.role in {"pv", "mv", "dv"} and own[t.tag].good.any()}
    mvs = [t for t in known.values() if t.role == "mv"]
    pvs = [t for t in known.values() if t.role == "pv"]
    if not pvs or not mvs or any(t.ends == "keep" for t in mvs):
        return [], []
    time_s = own[pvs[0].tag].time_s
    time_s = np.unique(time_s[:: max(1, len(time_s) // SAMPLES)])
    value = {tag: _held(own[tag], time_s) for tag in known}
    at_end = _rests([_near(value[t.tag], (0.0, *_stated(t, own[t.tag]))) for t in mvs])
    at_own = _rests([_near(value[t.tag], (value[t.tag].min(), value[t.tag].max())) for t in mvs])
    off_by_feed = [_rests([_is_off(value[t.tag])]) for t in known.values() if t.role == "dv"]
    off = [rows for stretches in off_by_feed if len(stretches) <= MOST_STOPS for rows in stretches]
    if not (at_end or at_own or off):
        return [], []
    rests = _spread_over(len(time_s), [*at_end, *off])
    whole = _with_return(rests, [value[t.tag] for t in pvs])
    for _ in range(2):  # the warm-up is where no signal works: the second time it is left out of the bands
        working = {tag: v[~whole] for tag, v in value.items()}
        plant = _Plant(
            value, {t: _band(v) for t, v in working.items()}, {t: _usual(v) for t, v in working.items()}, known
        )
        found = _joined(
            [rows for rows in at_end if _is_stop(plant, rows)] + [r for r in off if _without_feed(plant, r)]
        )
        spans = [_with_warm_up(plant, rows) for rows in found]
        whole = rests | _spread_over(len(time_s), spans)
    if _spread_over(len(time_s), spans).mean() > MOST_STOPPED:
        found, spans = [], []
    step = float(np.median(np.diff(time_s)))
    seconds = [(float(time_s[a]) - 0.5 * step, float(time_s[b - 1]) + 0.5 * step) for a, b in spans]
    stood = sum(float(time_s[b - 1] - time_s[a]) for a, b in found)
    away = [t.tag for t in mvs] + [tag for rows in found for tag in plant.away(rows)]
    findings = [_of_stops(list(dict.fromkeys(away)), seconds, stood, text_of)] if found else []
    taken = _spread_over(len(time_s), spans)
    perhaps = [r for r in at_end if plant.far(r)] + [r for r in at_own if plant.far(r) and _is_long(plant, r)]
    perhaps = _joined([_with_warm_up(plant, r) for r in perhaps if not taken[slice(*r)].any()])
    texts = [text_of(float(time_s[a]) - 0.5 * step, float(time_s[b - 1]) + 0.5 * step) for a, b in perhaps]
    return seconds, findings + _of_rests(pvs, mvs, texts)


def _of_stops(
    tags: Sequence[str], spans: Sequence[tuple[float, float]], stood_s: float, text_of: Callable[[float, float], str]
) -> Finding:
    when = ", ".join(text_of(*span) for span in spans[:NAMED]) + ", ..." * (len(spans) > NAMED)
    many = f"{len(spans)} stops of the plant, together" if len(spans) > 1 else "a stop of the plant, of"
    words = (
        f"{many} {in_words(stood_s)}; {in_words(sum(b - a for a, b in spans))} are left out with the warm-up, {when}; "
        f"where the plant worked, {KEEP}"
    )
    return Finding("stop", ", ".join(tags), words, True)


def _of_rests(pvs: Sequence[Tag], mvs: Sequence[Tag], texts: Sequence[str]) -> list[Finding]:
    """Rows that a person may leave out: stretches that may be a stop of the plant, or say most of it."""
    if not texts:
        return []
    options = " ".join(f"--leave-out {text}" for text in texts[:NAMED])
    words = (
        f"far outside of where it works, with {', '.join(t.tag for t in mvs)} at rest at an end: was that a stop of "
        f"the plant? {options} leaves it out"
    )
    return [Finding("rest", ", ".join(t.tag for t in pvs), words)]


def _held(series: Series, at: Array) -> Array:
    """The values (n,) that hold at these times; the first one before it."""
    good = series.good & ~np.isin(series.value, CODES)
    place = np.searchsorted(series.time_s[good], at, "right") - 1
    return series.value[good][np.maximum(place, 0)]


def _with_return(rests: Where, pvs: Sequence[Array]) -> Where:
    """The rests (n,), each until all PVs (n,) return near where they were; the rests alone if that is ``MOST_STOPPED``.

    A slow warm-up is longer than its stop, and would count as where the plant works.
    """
    whole = rests.copy()
    for first, last in zip(*runs_of(rests), strict=True):
        if first == 0:  # nobody knows where the PVs were before
            continue
        for v in pvs:
            away = np.abs(v - np.median(v[max(first - BACK, 0) : first]))
            back = np.r_[away[last:] <= RETURNED * away[first:last].max(), False]
            whole[last : last + int(back.argmax())] = True  # nothing of a PV that never comes back
    return whole if whole.mean() <= MOST_STOPPED else rests


def _near(u: Array, ends: Sequence[float]) -> Where:
    return np.min([np.abs(u - end) for end in ends], axis=0) <= AT_MV_END * float(np.ptp(u))


def _stated(tag: Tag, series: Series) -> list[float]:
    """The ends of an MV's range that somebody stated: the table writes its lowest and highest reading as a guess."""
    ends = [end for end in (tag.low, tag.high) if end is not None]
    if len(ends) < 2 or tag.unit == "%":
        return ends
    seen = seen_range(series)
    return [] if seen is not None and np.allclose(seen, ends, rtol=1e-5, atol=0.0) else ends


def _is_off(v: Array) -> Where:
    """Where a disturbance (n,) is near zero, beside what it usually is."""
    return np.abs(v) < FEED_OFF * abs(_usual(v))


def _usual(v: Array) -> float:
    return float(np.median(v))


def _rests(where: Sequence[Where]) -> list[Rows]:
    """Stretches of at least SHORTEST_STOP rows in which all of ``where``, (n,) each, hold; none where that is usual."""
    both = np.all(where, axis=0)
    start, end = runs_of(both)
    long = end - start >= SHORTEST_STOP
    found = list(zip(start[long].tolist(), end[long].tolist(), strict=True))
    return found if _spread_over(len(both), found).mean() <= MOST_STOPPED else []


def _spread_over(n: int, stretches: Sequence[Rows]) -> Where:
    where = np.zeros(n, dtype=bool)
    for a, b in stretches:
        where[a:b] = True
    return where


def _joined(stretches: Sequence[Rows]) -> list[Rows]:
    """The stretches in order, those that overlap as one."""
    n = max((b for _, b in stretches), default=0)
    start, end = runs_of(_spread_over(n, stretches))
    return list(zip(start.tolist(), end.tolist(), strict=True))


def _band(working: Array) -> Band:
    low, high = np.quantile(working, [OUTER, 1 - OUTER])
    return float(low), float(high)


def _is_stop(plant: _Plant, rows: Rows) -> bool:
    """Whether a rest of all MVs at an end is a stop."""
    away = plant.away(rows)
    pvs = plant.of("pv")
    loads = [t for t in away if t not in pvs]
    if len(loads) < len(away) and any(plant.off(t, rows) for t in loads):
        return True
    if loads:  # one that is as large as never before may explain all
        return False
    beyond = max(float(np.median(plant.beyond(tag, rows))) for tag in plant.of("mv"))
    if beyond <= BAND_PAD:  # it works there: a valve that is closed in cold weather
        return False
    return plant.far(rows, BEYOND_MV * beyond) or (
        beyond > FAR_BEYOND_BAND and plant.far(rows) and _is_long(plant, rows)
    )


def _without_feed(plant: _Plant, rows: Rows) -> bool:
    """Whether the feed is off in some rows while the MVs rest wherever they are, and all PVs are away."""
    away = plant.away(rows)
    if not all(t in away for t in plant.of("pv")) or not any(plant.off(t, rows) for t in plant.of("dv")):
        return False
    for tag in plant.of("mv"):
        u = plant.value[tag]
        v = u[slice(*rows)]
        if np.mean(np.abs(v - np.median(v)) <= AT_MV_END * float(np.ptp(u))) < MVS_STILL:
            return False
    return True


def _is_long(plant: _Plant, rows: Rows) -> bool:
    """Whether a rest is longer by far than the PVs took to get to where they stay in it: no test holds for so long."""
    took = 1
    for tag in plant.of("pv"):
        v = plant.value[tag][slice(*rows)]
        end = float(np.median(v[len(v) // 2 :]))
        way = max(abs(v[0] - end), *(abs(edge - end) for edge in plant.band[tag]))
        there = np.abs(v - end) <= ARRIVED_WAY * way
        took = max(took, int(np.argmax(there)))
    return rows[1] - rows[0] > LONG_REST * took


def _with_warm_up(plant: _Plant, rows: Rows) -> Rows:
    """The rest, from where the first signal leaves its band before it to where all are back in theirs for BACK rows."""
    first, last = rows
    n = len(next(iter(plant.value.values())))
    beyond = [plant.beyond(tag, (0, n)) for tag in plant.away(rows)]
    inside, wide = np.all([b == 0 for b in beyond], axis=0), np.all([b <= BAND_PAD for b in beyond], axis=0)
    while first > 0 and not wide[first - 1]:
        first -= 1
    run = np.convolve(np.r_[inside[last:], np.zeros(BACK)], np.ones(BACK), "valid") == BACK
    return first, last + int(np.argmax(run)) if run.any() else n
