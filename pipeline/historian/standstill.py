"""Stops of the plant: MVs rest at an end, the other signals leave where they work; with the warm-up after each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.historian.character import runs_of
from pipeline.historian.export import Series
from pipeline.historian.findings import Finding
from pipeline.historian.pace import in_words
from pipeline.historian.tags import Tag
from pipeline.metrics import Array

Where = NDArray[np.bool_]

SAMPLES = 100_000  # of the time of the record
SHORTEST, BACK = 20, 10  # rows of a stop, and rows in a row that the signals work again
MOST_SHARE = 0.3  # of the rows: more is how the plant is run
OUTER = 0.02  # quantile at each end of the band where a signal works
AT_END, NONE = 0.01, 0.2  # of an MV's span at its end; of a disturbance's usual value, a flow that stopped
PAD, FAR = 0.25, 1.0  # widths of that band beyond it: away; far away, where no disturbance tells a stop
BEYOND_MV = 2.0  # how much farther than the MVs, in widths of the band each: no answer goes so far
MOSTLY = 0.5  # of a stop's rows


def stops(own: Mapping[str, Series], tags: Sequence[Tag]) -> tuple[list[tuple[float, float]], list[Finding]]:
    """Spans [s] of time in which the plant stood still and warmed up again, and a finding for them.

    A stop is a rest of all MVs, each at zero or at an end of its stated range, in which several signals leave the band
    where they work: a measured disturbance near zero and a PV, or else all PVs by more than MVs explain. The largest
    move of a record is no end of a range: such rows say most of the plant.
    The warm-up lasts until each of them is back in its band.
    """
    groups = {r: [t.tag for t in tags if t.role == r and own[t.tag].good.any()] for r in ("pv", "mv", "dv")}
    if not groups["pv"] or not groups["mv"]:
        return [], []
    time_s = own[groups["pv"][0]].time_s
    time_s = np.unique(time_s[:: max(1, len(time_s) // SAMPLES)])
    value = {tag: _held(own[tag], time_s) for group in groups.values() for tag in group}
    resting = np.ones(len(time_s), dtype=bool)
    stated = {t.tag: [end for end in (t.low, t.high) if end is not None] for t in tags}
    for tag in groups["mv"]:
        u = value[tag]
        near = AT_END * float(np.ptp(u))
        resting &= np.min([np.abs(u - end) for end in (0.0, *stated[tag])], axis=0) <= near
    start, end = runs_of(resting)
    long = end - start >= SHORTEST
    rests = list(zip(start[long].tolist(), end[long].tolist(), strict=True))
    stopped = _spread_over(len(time_s), rests)
    if not rests or stopped.mean() > MOST_SHARE:
        return [], []
    whole = stopped
    for _ in range(2):  # the warm-up is where no signal works: the second time it is left out of the bands
        bands = {tag: _band(v[~whole]) for tag, v in value.items()}
        found = [
            (a, b, away)
            for a, b in rests
            if (away := _away({t: v[a:b] for t, v in value.items()}, bands, groups, _usual(value, ~whole)))
        ]
        spans = [_with_warm_up(a, b, [value[t] for t in away], [bands[t] for t in away]) for a, b, away in found]
        whole = stopped | _spread_over(len(time_s), spans)
    if not found or _spread_over(len(time_s), spans).mean() > MOST_SHARE:
        return [], []
    step = float(np.median(np.diff(time_s)))
    times = [(float(time_s[a]) - 0.5 * step, float(time_s[b - 1]) + 0.5 * step) for a, b in spans]
    stood = in_words(float(sum(time_s[b - 1] - time_s[a] for a, b, _ in found)))
    lost = in_words(float(sum(b - a for a, b in times)))
    names = ", ".join(dict.fromkeys(t for *_, away in found for t in (*groups["mv"], *away)))
    many = f"{len(found)} stops" if len(found) > 1 else "a stop"
    words = f"{many} of the plant: the MVs rest for {stood}; with the warm-up after it {lost} are left out"
    return times, [Finding("stop", names, words, True)]


def _held(series: Series, at: Array) -> Array:
    """The values (n,) that hold at these times; the first one before it."""
    good = series.good
    place = np.searchsorted(series.time_s[good], at, "right") - 1
    return series.value[good][np.maximum(place, 0)]


def _usual(value: Mapping[str, Array], working: Where) -> dict[str, float]:
    return {tag: float(np.median(v[working])) for tag, v in value.items()}


def _spread_over(n: int, stretches: Sequence[tuple[int, int]]) -> Where:
    where = np.zeros(n, dtype=bool)
    for a, b in stretches:
        where[a:b] = True
    return where


def _band(working: Array) -> tuple[float, float]:
    low, high = np.quantile(working, [OUTER, 1 - OUTER])
    return float(low), float(high)


def _beyond(v: Array, band: tuple[float, float]) -> Array:
    """How far values (n,) are outside the band, in its widths."""
    width = max(band[1] - band[0], 1e-9 * max(abs(band[0]), abs(band[1]), 1e-300))
    return np.maximum(np.maximum(band[0] - v, v - band[1]), 0.0) / width


def _away(
    value: Mapping[str, Array],
    bands: Mapping[str, tuple[float, float]],
    groups: Mapping[str, Sequence[str]],
    usual: Mapping[str, float],
) -> list[str]:
    """The PVs and disturbances that have left their bands in a rest of the MVs; none where it is no stop."""
    beyond = {tag: _beyond(v, bands[tag]) for tag, v in value.items()}
    away = [tag for role in ("pv", "dv") for tag in groups[role] if np.mean(beyond[tag] > PAD) > MOSTLY]
    pvs = [tag for tag in groups["pv"] if tag in away]
    if pvs and any(abs(float(np.median(value[tag]))) < NONE * abs(usual[tag]) for tag in away if tag not in pvs):
        return away  # a load that is as large as never before is none
    explained = BEYOND_MV * max(float(np.median(beyond[tag])) for tag in groups["mv"])
    far = [tag for tag in pvs if float(np.median(beyond[tag])) > max(FAR, explained)]
    return away if far and far == list(groups["pv"]) else []


def _with_warm_up(
    first: int, last: int, values: Sequence[Array], bands: Sequence[tuple[float, float]]
) -> tuple[int, int]:
    """The rest, from where the first signal leaves its band before it to where all are back in theirs for BACK rows."""
    inside = np.all([_beyond(v, band) == 0 for v, band in zip(values, bands, strict=True)], axis=0)
    wide = np.all([_beyond(v, band) <= PAD for v, band in zip(values, bands, strict=True)], axis=0)
    while first > 0 and not wide[first - 1]:
        first -= 1
    run = np.convolve(inside[last:], np.ones(BACK), "valid") == BACK
    return first, last + int(np.argmax(run)) if run.any() else len(inside)
