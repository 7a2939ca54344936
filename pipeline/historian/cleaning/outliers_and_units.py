"""Readings that are no measurements: values in another unit, and single outliers.

Each function takes the series of one tag and returns where they are; the values of what it saw go into the report.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.files.signal_statistics import runs_of
from loopwright.pipeline.metrics import Array

Where = NDArray[np.bool_]

RANGE_SAMPLE = 200_000  # readings that a distribution is estimated from
MEDIAN_OF = 9  # readings of the running median
SPIKE_SD, SPIKE_SPAN = 8.0, 0.03  # of the residual's robust sd, and of the usual span
LONGEST_SPIKE = 4  # readings
CONVERSIONS: dict[str, tuple[float, float]] = {
    "turned sign": (-1.0, 0.0),
    "degC to degF": (1.8, 32.0),
    "degF to degC": (1 / 1.8, -32 / 1.8),
    "degC to K": (1.0, 273.15),
    "K to degC": (1.0, -273.15),
    "x 1000": (1e3, 0.0),
    "/ 1000": (1e-3, 0.0),
    "x 100": (1e2, 0.0),
    "/ 100": (1e-2, 0.0),
    "x 10": (10.0, 0.0),
    "/ 10": (0.1, 0.0),
    "bar to psi": (14.5038, 0.0),
    "psi to bar": (1 / 14.5038, 0.0),
    "x 60": (60.0, 0.0),
    "/ 60": (1 / 60, 0.0),
    "x 3.6": (3.6, 0.0),
    "/ 3.6": (1 / 3.6, 0.0),
}
TEMPERATURES = frozenset({"degc", "°c", "c", "deg c", "celsius", "k", "kelvin", "degf", "°f", "f", "deg f", "grd", "°"})
"""Units of temperatures, in small letters: their zero is no nothing."""
MV_CONVERSIONS = ("x 100", "/ 100", "x 1000", "/ 1000")  # of a value that jumps whenever it is moved
JUMP_SD, JUMP_SPAN = 15.0, 0.5  # a change of unit moves the value by more than these
MATCH_SD, MATCH_SHARE = 6.0, 0.05  # how near the conversion must come: noise, and share of the jump


def usual(values: Array) -> tuple[float, float]:
    """1 % and 99 % quantile of finite values; (0, 0) where there are none."""
    step = max(1, len(values) // RANGE_SAMPLE)
    sample = values[::step]
    sample = sample[np.isfinite(sample)]
    if not sample.size:
        return 0.0, 0.0
    low, high = np.quantile(sample, [0.01, 0.99])
    return float(low), float(high)


def core(values: Array) -> tuple[float, float]:
    """Where the middle 90 % lie after values that are more than ten of their spans away have gone."""
    sample = values[:: max(1, len(values) // RANGE_SAMPLE)]
    sample = sample[np.isfinite(sample)]
    if not sample.size:
        return 0.0, 0.0
    q1, q3 = np.quantile(sample, [0.25, 0.75])
    spread = max(float(q3 - q1), 1e-9 * max(abs(float(q1)), abs(float(q3)), 1e-300))
    near = sample[np.abs(sample - np.median(sample)) <= 10 * spread]
    low, high = np.quantile(near, [0.01, 0.99]) if near.size else (q1, q3)
    return float(low), float(high)


def noise_sd(values: Array) -> float:
    """Standard deviation of white noise on a slow signal: robust, from second differences / sqrt 6."""
    second = np.diff(values, 2)
    second = second[np.isfinite(second)]
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0)) if second.size else 0.0


def slips_of(values: Array, role: str) -> tuple[Where, Counter[str]]:
    """``unit_slips`` of finite readings (n,) of a tag with a role.

    For an MV few conversions count, and its zeros do not, nor those of a measured disturbance: a closed valve and a
    flow that stopped are 0 in every unit.
    """
    counts = values != 0.0 if role in {"mv", "dv"} else np.ones(len(values), dtype=bool)
    where = np.zeros(len(values), dtype=bool)
    where[counts], found = unit_slips(values[counts], MV_CONVERSIONS if role == "mv" else ())
    return where, found


def unit_slips(values: Array, kinds: Sequence[str] = ()) -> tuple[Where, Counter[str]]:
    """Where (n,) the values are in another unit for a while: a jump by a known conversion, and the jump back.

    values (n,) must be finite; ``kinds`` names the conversions that count, all of them where it is empty. A jump counts
    where the conversion of the value before it meets the value after it within the noise; the shorter of the two
    stretches is the one in the other unit.
    """
    n = len(values)
    where, found = np.zeros(n, dtype=bool), Counter[str]()
    if n < 20:
        return where, found
    step = np.diff(values)
    low, high = core(values)
    noise = max(noise_sd(values), 1e-12)
    jumps = np.flatnonzero(np.abs(step) > max(JUMP_SD * noise, JUMP_SPAN * (high - low) * 0.5))
    slack = MATCH_SD * noise + float(np.quantile(np.abs(step[:: max(1, n // RANGE_SAMPLE)]), 0.99))
    matched = [
        (int(k), _conversion(values[k], values[k + 1], slack, kinds or tuple(CONVERSIONS))) for k in jumps[:2000]
    ]
    stretches = _stretches([(k, kind) for k, kind in matched if kind], n)
    others = np.ones(n, dtype=bool)
    for a, b, _ in stretches:
        others[a:b] = False
    usual_range = (
        np.quantile(values[others][:: max(1, n // RANGE_SAMPLE)], [0.05, 0.95]) if others.any() else (0.0, 0.0)
    )
    for a, b, kind in stretches:
        if LONGEST_SPIKE < b - a <= n // 2 and others.sum() >= n // 3 and _plausible(values[a:b], usual_range, kind):
            where[a:b] = True
            found[kind] += b - a
    return where, found


def _stretches(jumps: Sequence[tuple[int, str]], n: int) -> list[tuple[int, int, str]]:
    """(first row, row after the last, conversion) between each jump and the next one that takes it back."""
    found: list[tuple[int, int, str]] = []
    taken = -1
    for i, (k, kind) in enumerate(jumps):
        if k < taken:
            continue
        back = next((j for j, other in jumps[i + 1 :] if _returns(kind, other)), None)
        if back is not None:
            found.append((k + 1, back + 1, kind))
            taken = back + 1
        elif n - k - 1 <= k + 1:  # it never comes back: the shorter side is the other unit
            found.append((k + 1, n, kind))
            taken = n
        elif not found:
            found.append((0, k + 1, _inverse(kind)))
    return found


def _plausible(stretch: Array, usual_range: tuple[float, float] | Array, kind: str) -> bool:
    """Whether a stretch, converted back, lies where the other values are, and does not as it stands."""
    factor, offset = CONVERSIONS[kind]
    low, high = usual_range
    span = high - low

    def inside(v: Array, pad: float) -> float:
        return float(np.mean((v >= low - pad * span) & (v <= high + pad * span)))

    # Values around a small fraction of the others' lie just outside their range.
    return inside((stretch - offset) / factor, 0.5) > 0.9 > 0.5 > inside(stretch, 0.0)


def _inverse(kind: str) -> str:
    return next(k for k in CONVERSIONS if _returns(kind, k))


def _conversion(before: float, after: float, slack: float, kinds: Sequence[str]) -> str:
    best, best_error = "", np.inf
    for name in kinds:
        factor, offset = CONVERSIONS[name]
        error = abs(after - factor * before - offset)
        allowed = min(slack * (1 + abs(factor)), MATCH_SHARE * abs(after - before)) + 1e-9 * abs(after)
        if error <= allowed and error < best_error:
            best, best_error = name, error
    return best


def _returns(kind: str, other: str) -> bool:
    if not other:
        return False
    (f, o), (g, p) = CONVERSIONS[kind], CONVERSIONS[other]
    return abs(f * g - 1) < 0.01 and abs(g * o + p) < 0.5


def outliers(values: Array) -> Where:
    """Where (n,) a reading stands alone: far from the running median of MEDIAN_OF readings, for at most LONGEST_SPIKE.

    values (n,) finite. Far is more than 8 robust standard deviations of such residuals and 3 % of the usual span, so
    that a smooth peak without noise is none.
    """
    if len(values) < MEDIAN_OF:
        return np.zeros(len(values), dtype=bool)
    from scipy.ndimage import median_filter  # half a second to load

    residual = np.abs(values - median_filter(values, MEDIAN_OF, mode="nearest"))
    sample = residual[:: max(1, len(residual) // RANGE_SAMPLE)]
    low, high = core(values)
    limit = max(SPIKE_SD * 1.4826 * float(np.median(sample)), SPIKE_SPAN * (high - low), SPIKE_SD * noise_sd(values))
    limit = max(limit, 1e-12 * max(abs(low), abs(high)))
    where = residual > limit
    for a, b in zip(*runs_of(where), strict=True):
        if b - a > LONGEST_SPIKE:
            # On a slope an outlier moves the median of its neighbours; what goes on is a new level, and stays.
            peak = residual[a:b] > 0.5 * residual[a:b].max()
            where[a:b] = peak if peak.sum() <= LONGEST_SPIKE else False
    for a, b in zip(*runs_of(where), strict=True):
        # What goes on from the left or the right is the edge of a step, not an outlier.
        first, last = int(a), int(b) - 1
        while first <= last and first > 1 and _goes_on(values, first, -1, limit):
            first += 1
        while last >= first and last < len(values) - 2 and _goes_on(values, last, 1, limit):
            last -= 1
        where[a:first] = where[last + 1 : b] = False
    return where


def _goes_on(values: Array, k: int, way: int, limit: float) -> bool:
    """Whether reading k lies on the line through its two neighbours on one side."""
    return abs(float(values[k] - 2 * values[k + way] + values[k + 2 * way])) <= limit
