"""The readings of one tag: every bad one gets its reason, and every kind of fault a finding."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.findings import Finding, RecordJudgement, counted
from loopwright.pipeline.historian.cleaning.outliers_and_units import core, outliers, slips_of, usual
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.files.dialect import COMMA_DECIMAL, POINT_DECIMAL
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.files.numbers import loose_number
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import runs_of
from loopwright.pipeline.metrics import Array

# -------------------------------- codes in place of a missing value: -9999 and its like, and the zero of a dead sensor
Where = NDArray[np.bool_]

# values that systems write for a reading that they lack
CODES = (-9999.0, 9999.0, -999.0, -999.25, -99999.0, 99999.0, -999999.0, 32767.0, -32768.0, 65535.0, 2147483647.0)
ZERO_DISTANCE_SPANS = 0.25  # spans of the usual values between them and zero, from which zero is a dead sensor
CODE_DISTANCE_SPANS = 2.0  # spans of the usual values between them and a code
REPEATED, REPEATED_SHARE = 3, 2e-4  # readings of one value far outside, from which it is a code
MAINLY = 0.3  # of all values that far
ABRUPT = 1.5  # of the largest other changes from reading to reading: a change to zero that no plant makes
LARGEST_CHANGES = 0.999  # quantile: an outlier is no change that the plant makes
VALVE_RANGE = (0.0, 100.0)  # where a manipulated variable in % can stand, if no range is stated


def sentinels(values: Array, tag: Tag) -> tuple[Where, Counter[str]]:
    """Where (n,) codes for a missing value stand, and how often each.

    A code is one of CODES, zero, or a value that comes again exactly, farther from the usual ones than
    CODE_DISTANCE_SPANS of their spans. A value that an actuator can take is none: a manipulated variable may be zero,
    and often at an end of its range.
    """
    low, high = core(values[values != 0.0])  # zeros of a dead sensor must not widen it
    span = max(high - low, 1e-6 * max(abs(low), abs(high), 1e-9))
    out = (values < low - CODE_DISTANCE_SPANS * span) | (values > high + CODE_DISTANCE_SPANS * span)
    found: Counter[str] = Counter()
    zero = values == 0.0
    where = zero & (tag.role == "pv" and apart_zeros(values) > 0 and _dead(values, tag))
    if where.any():
        found["0"] = int(np.count_nonzero(where))
    lowest, highest = _possible(tag)
    far = values[out & ~zero]
    for value, times in zip(*np.unique(far, return_counts=True), strict=True):
        many = times >= max(REPEATED, REPEATED_SHARE * len(values), MAINLY * len(far))
        known = value in CODES or abs(value) > 1e15
        if known or (many and not lowest <= value <= highest):
            where |= values == value
            found[f"{value:g}"] = int(times)
    return where, found


def apart_zeros(values: Array) -> int:
    """How many of values (n,) are zero, where hardly one other lies between them and the usual ones; else 0."""
    zero = values == 0.0
    low, high = core(values[~zero])
    away = max(low, -high)  # from zero
    if away <= ZERO_DISTANCE_SPANS * max(high - low, 1e-6 * max(abs(low), abs(high), 1e-9)):
        return 0
    n = int(np.count_nonzero(zero))
    between = np.count_nonzero((np.abs(values) < 0.5 * away) & ~zero & np.isfinite(values))
    return n if between <= 0.2 * n else 0


def _dead(values: Array, tag: Tag) -> bool:
    """Whether zeros are a dead sensor's: the stated range is without them, or the variable never moves as abruptly."""
    low, high = (-np.inf if tag.low is None else tag.low), (np.inf if tag.high is None else tag.high)
    if (tag.low is None and tag.high is None) or not low <= 0.0 <= high:
        return True
    known = values[np.isfinite(values)]
    start, end = runs_of(known == 0.0)
    inner = (start > 0) & (end < len(known))
    entered = np.r_[known[start[start > 0] - 1], known[end[inner]]]
    others = known[known != 0.0]
    if not entered.size or len(others) < 2:
        return False
    usual = float(np.quantile(np.abs(np.diff(others)), LARGEST_CHANGES))
    return float(np.median(np.abs(entered))) > ABRUPT * usual


def _possible(tag: Tag) -> tuple[float, float]:
    """Where a value that comes again is no code: the range of a manipulated variable; (inf, -inf) for other tags.

    A set point is given and held, so that it comes again wherever it stands.
    """
    if tag.role == "sp":
        return (-np.inf if tag.low is None else tag.low), (np.inf if tag.high is None else tag.high)
    if tag.role != "mv":
        return np.inf, -np.inf
    low, high = VALVE_RANGE if tag.unit == "%" else (np.inf, -np.inf)
    return (low if tag.low is None else tag.low), (high if tag.high is None else tag.high)


# ------------------------------------------------------------------------------------------------- all checks of a tag
RANGE_SLACK = 0.1  # of a PV's given range: noise at its ends
ONE_SIDED = "one_sided"  # kind of a finding
FEW_TEXTS, MANY_TEXTS = 3, 0.01  # texts, and their share of the readings
LEAST_READINGS, FEW_NEIGHBOURS = 50, 8  # readings of the tag, and beside its texts, below which nothing is concluded
ONE_SIDE, END_SHARE = 0.9, 0.25  # of the texts, or of the readings beside them, at one end; the share that is an end
MOSTLY_OUT_OF_RANGE = 0.5  # of the readings outside the given range: then the range or its unit is wrong


def flag_bad_readings(series: Series, tag: Tag) -> list[Finding]:
    """Give every bad reading of one tag its reason; what was found."""
    found = []
    counts = series.counts()
    if series.texts:
        words = ", ".join(f"{t!r} {n} times" for t, n in series.texts.most_common(3))
        mixed = any(COMMA_DECIMAL.match(t) or POINT_DECIMAL.match(t) for t in series.texts)
        hint = "; decimal points and commas are mixed, write one of them" if mixed else ""
        found.append(Finding("text", tag.tag, f"text where a number belongs: {words}{hint}", True))
        if side := text_side(series):
            words = f"its readings that are text stand at the {side} end of what it reads, so that this end is lost"
            found.append(Finding(ONE_SIDED, tag.tag, words, True))
    if counts.get("quality"):
        found.append(
            Finding("quality", tag.tag, f"quality is not good in {counted(counts['quality'], 'reading')}", True)
        )
    if counts.get("duplicate"):
        words = f"{counted(counts['duplicate'], 'reading')} came a second time; the last good one of each stays"
        found.append(Finding("duplicate", tag.tag, words, True))
    if counts.get("clock"):
        words = (
            f"{counted(counts['clock'], 'reading has', 'readings have')} an ambiguous time: the clock was set back, or "
            "zones are mixed; export UTC, or name the zone with --time-zone"
        )
        found.append(Finding("clock", tag.tag, words, True))
    if series.rounded_s:
        words = f"stamps are rounded to {series.rounded_s:g} s: readings that share one were spread evenly over it"
        found.append(Finding("rounded", tag.tag, words))
    where, codes = sentinels(np.where(series.good, series.value, np.nan), tag)
    if series.flag(where, Reason.SENTINEL):
        words = ", ".join(f"{c} {n} times" for c, n in codes.most_common(3))
        found.append(Finding("sentinel", tag.tag, f"codes for a missing value: {words}", True))
    found += _out_of_range(series, tag)
    if tag.role in {"pv", "dv"}:
        found += _unlike_the_rest(series, tag)
    elif tag.role == "mv" and not tag.unit_certain:
        place = np.flatnonzero(series.good)
        found += _slipped(series, tag, place, *slips_of(series.value[place], tag.role))
    return found


def text_side(series: Series) -> str:
    """At which end of its readings a tag's texts stand, "low" or "high"; "" where at neither, or too few are known.

    The numbers that texts show, as (5.2) or < 0.5, lie nearly all outside the other readings; or texts are many, and
    the readings next to them are nearly all the lowest or the highest ones.
    """
    good = series.value[series.good]
    if good.size < LEAST_READINGS:
        return ""
    shown = [(v, n) for t, n in series.texts.items() if (v := loose_number(t)) is not None]
    total = sum(n for _, n in shown)
    if total >= FEW_TEXTS and 2 * total >= series.texts.total():
        low, high = float(good.min()), float(good.max())
        for side, n in (("low", sum(n for v, n in shown if v <= low)), ("high", sum(n for v, n in shown if v >= high))):
            if n >= ONE_SIDE * total:
                return side
    texts = np.flatnonzero(series.code == Reason.TEXT)
    if len(texts) < max(FEW_TEXTS, MANY_TEXTS * len(series)):
        return ""
    place = np.flatnonzero(series.good)
    after = np.searchsorted(place, texts)
    near = np.unique(np.r_[place[after[after < len(place)]], place[after[after > 0] - 1]])
    if len(near) < FEW_NEIGHBOURS:
        return ""
    rank = np.searchsorted(np.sort(good), series.value[near]) / len(good)
    share = max((np.mean(rank > 1 - END_SHARE), "high"), (np.mean(rank < END_SHARE), "low"))
    return share[1] if share[0] >= ONE_SIDE else ""


def with_texts_of_one_side(verdict: RecordJudgement, findings: Sequence[Finding]) -> RecordJudgement:
    """The verdict, "doubtful" at best where one end of a tag's readings was refused as text."""
    tags = [f.tag for f in findings if f.kind == ONE_SIDED]
    if not tags:
        return verdict
    words = f"one end of the readings of {', '.join(tags)} is text where a number belongs: export them as numbers"
    carries = verdict.carries if verdict.carries == "no" else "doubtful"
    return replace(verdict, carries=carries, reasons=(*verdict.reasons, words))


def _out_of_range(series: Series, tag: Tag) -> list[Finding]:
    if tag.low is None and tag.high is None:
        return []
    low, high = (-np.inf if tag.low is None else tag.low), (np.inf if tag.high is None else tag.high)
    span = high - low if np.isfinite(high - low) else abs(high if np.isfinite(high) else low)
    slack = span * (1e-9 if tag.role == "mv" else RANGE_SLACK)
    with np.errstate(invalid="ignore"):
        outside = (series.value < low - slack) | (series.value > high + slack)
    good = int(series.good.sum())
    n = series.flag(outside, Reason.RANGE)
    if n > MOSTLY_OUT_OF_RANGE * good:
        example = series.value[np.flatnonzero(outside)[0]]
        raise RecordError(
            f"{tag.tag}: {n} of {good} good readings, such as {example:.6g}, are outside its range {low:g} to {high:g} "
            f"{tag.unit}; correct the range or the unit"
        )
    # A table that `new` wrote holds guessed ranges, and nobody can tell which of them a person has confirmed.
    some = counted(n, "reading")
    words = f"{some} outside the range {low:g} to {high:g} {tag.unit} that was given, or guessed in the tag table"
    return [Finding("range", tag.tag, words, True)] if n else []


def _unlike_the_rest(series: Series, tag: Tag) -> list[Finding]:
    found = []
    place = np.flatnonzero(series.good)
    values = series.value[place]
    calm = ~outliers(values)
    slipped = np.zeros(len(values), dtype=bool)
    kinds = Counter[str]()
    if not tag.unit_certain:
        slipped[calm], kinds = slips_of(values[calm], tag.role)
    found += _slipped(series, tag, place, slipped, kinds)
    place, values = place[~slipped], values[~slipped]
    alone = outliers(values) if slipped.any() else ~calm
    if alone.any():
        series.code[place[alone]] = Reason.OUTLIER
        some = counted(int(alone.sum()), "reading stands", "readings stand")
        words = f"{some} alone, {_example(values[alone])}; usual are {_usual(values)}"
        found.append(Finding("outlier", tag.tag, words, True))
    return found


def _slipped(
    series: Series, tag: Tag, place: NDArray[np.int64], where: NDArray[np.bool_], kinds: Counter[str]
) -> list[Finding]:
    """Readings of ``place`` (m,) that are in another unit ``where`` (m,) get their reason."""
    if not where.any():
        return []
    series.code[place[where]] = Reason.UNIT_SLIP
    words = ", ".join(f"{k} in {counted(n, 'reading')}" for k, n in kinds.most_common())
    return [Finding("unit_slip", tag.tag, f"the level jumps as if the unit had changed: {words}", True)]


def _example(values: Array) -> str:
    return f"from {values.min():.5g} to {values.max():.5g}"


def _usual(values: Array) -> str:
    low, high = usual(values)
    return f"{low:.5g} to {high:.5g}"


def reasons_of(series: Series) -> str:
    """The end of a message about a tag without a good reading: its reasons and texts."""
    texts = ", ".join(repr(t) for t, _ in series.texts.most_common(2))
    reasons = ", ".join(f"{n} x {Reason[k.upper()].words}" for k, n in series.counts().items())
    return f"{reasons}{f' ({texts})' if texts else ''}; choose another tag or export it again"
