"""Rows of the grid: the reason of each row that is left out, and the record of those that have none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.config.exports import TimeSpan
from loopwright.pipeline.errors import RecordError, nearest
from loopwright.pipeline.historian.cleaning.findings import Finding, counted
from loopwright.pipeline.historian.cleaning.outliers_and_units import usual
from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.sampling import TagSampling
from loopwright.pipeline.historian.cleaning.tag_checks import VALVE_RANGE
from loopwright.pipeline.historian.cleaning.tags import GUESSED_PAD, KEEP, Tag
from loopwright.pipeline.historian.files.export import Export, Series
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import clipped, runs_of, stuck
from loopwright.pipeline.historian.files.time_stamps import SINCE_1970_S, UNSTATED
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal


# ----------------------------------------------------------------------------- modes of which a person leaves rows out
def check_modes(without: Sequence[str], tags: Sequence[Tag], own: Mapping[str, Series]) -> None:
    """RecordError for a mode ``without`` that no tag of role mode has, with those that they have."""
    known = {t.tag: own[t.tag].categories for t in tags if t.role == "mode"}
    if without and not known:
        raise RecordError(
            f"--without-mode {without[0]}: no tag has the role mode; name the tag of the mode with --mode TAG, or "
            "leave --without-mode out"
        )
    names = {name for of_tag in known.values() for name in of_tag}
    for mode in without:
        if mode not in names:
            has = "; ".join(f"{tag} has the modes {', '.join(of_tag)}" for tag, of_tag in known.items())
            raise RecordError(f"--without-mode {mode}: {has}{nearest(mode, names)}")


# ----------------------------------------------------------- windows of a long record, for what need not see every row
WINDOWED, RECORD_WINDOW = 200_000, 20_000  # rows
STRETCHES = 4  # of the readings of a long export


def evenly(record: Record) -> Record:
    """The record, or of one with more than WINDOWED rows windows of RECORD_WINDOW rows, each with runs of its own."""
    n = len(record)
    if n <= WINDOWED:
        return record
    starts = np.linspace(0, n - RECORD_WINDOW, WINDOWED // RECORD_WINDOW).astype(np.int64)
    rows = (starts[:, None] + np.arange(RECORD_WINDOW)).ravel()
    fresh = np.r_[True, (np.diff(rows) != 1) | (np.diff(record.run[rows]) != 0)]
    return record.at(rows, np.cumsum(fresh, dtype=np.int64) - 1)


def readings_of(clock: Sequence[Series], series: Sequence[Series], step_s: float) -> dict[str, Series]:
    """The series, of a long export STRETCHES parts of their time, each of WINDOWED / STRETCHES steps."""
    length = WINDOWED / STRETCHES * step_s
    first, last = (f(float(s.time_s[i]) for s in clock) for f, i in ((min, 0), (max, -1)))
    if last - first <= 1.5 * STRETCHES * length:
        return {s.tag: s for s in series}
    starts = np.linspace(first, last - length, STRETCHES)

    def cut(s: Series) -> Series:
        ends = [np.searchsorted(s.time_s, (a, a + length)) for a in starts]
        time_s, value, code = (np.concatenate([c[a:b] for a, b in ends]) for c in (s.time_s, s.value, s.code))
        return replace(s, time_s=time_s, value=value, code=code)

    return {s.tag: cut(s) for s in series}


# ------------------------------------------------------ times that a person leaves out: a stop, a test of another kind
Span = tuple[float, float]  # [s] as the export counts, from the first to before the second


def spans_of(texts: Iterable[str], export: Export) -> list[Span]:
    """The intervals [s] as the export counts. RecordError for another form, or for dates where the export has none.

    A date without a zone counts as the export writes its own: in the zone that a person named for them, if any.
    Seconds count from the first reading of an export with dates, unless they count from 1970 themselves; else as the
    export's do.
    """
    first_s = min((float(s.time_s[0]) for s in export.series.values() if len(s)), default=0.0)
    found = []
    for text in texts:
        try:
            interval = TimeSpan.of(text)
        except ValueError as error:
            raise RecordError(f"leave_out: {error}") from None
        found.append((_seconds(interval.first, text, export, first_s), _seconds(interval.end, text, export, first_s)))
    return found


def _seconds(moment: datetime | float, text: str, export: Export, first_s: float) -> float:
    if not isinstance(moment, datetime):
        return moment + first_s if export.zone and moment < SINCE_1970_S else moment
    if not export.zone:
        raise RecordError(f"leave_out: {text!r} has dates, and the times of the export are none; give its seconds")
    if moment.tzinfo is not None and export.zone == UNSTATED:
        raise RecordError(f"leave_out: {text!r} has a time zone, and the export states none; give its own times")
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=export.local or UTC)).timestamp()


def interval_text(first_s: float, end_s: float, export: Export) -> str:
    """An interval [s] as `--leave-out` takes it: dates as the export writes them, to the second, or seconds."""
    if not export.zone:
        return f"{first_s:.10g}..{end_s:.10g}"
    first, end = (datetime.fromtimestamp(t, export.local or UTC) for t in (np.floor(first_s), np.ceil(end_s)))
    return f"{first:%Y-%m-%dT%H:%M:%S}..{end:%Y-%m-%dT%H:%M:%S}"


def flag_readings(series: Iterable[Series], spans: Sequence[Span], reason: Reason) -> None:
    """Give the good readings within the spans their reason."""
    for one in series:
        for span in spans:
            one.flag(_inside(one.time_s, span), reason)


def flag_rows(grid: Grid, tags: Iterable[str], spans: Sequence[Span], reason: Reason) -> list[int]:
    """Give the rows within the spans their reason, and no value; how many each span has."""
    rows = [_inside(grid.time_s, span) for span in spans]
    for tag in tags:
        for inside in rows:
            grid.value[tag][inside] = np.nan
            grid.code[tag][inside] = reason
    return [int(inside.sum()) for inside in rows]


def of_left_out(texts: Sequence[str], rows: Sequence[int]) -> list[Finding]:
    """How many rows each interval left out; one that met none may be mistyped."""
    return [
        Finding(
            "left_out",
            text,
            f"{counted(n, 'row')} left out" if n else "met no row: compare it with the record's times",
            n > 0,
        )
        for text, n in zip(texts, rows, strict=True)
    ]


def _inside(time_s: NDArray[np.float64], span: Span) -> NDArray[np.bool_]:
    return np.asarray((time_s >= span[0]) & (time_s < span[1]))


# ----------------------------------------------------------------------- stuck and saturated stretches, and the record
OVERFLOWS = f"where the plant ends there, as a tank that overflows, {KEEP}"
SHORTEST_RUN = 20  # rows
RANGE_PAD = 0.1  # of the span, beyond the values seen, in a range that was not given


def mask_stuck_and_saturated(grid: Grid, signals: Sequence[Tag], rates: Mapping[str, TagSampling]) -> list[Finding]:
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
    return not (guessed or (tag.unit == "%" and (tag.low, tag.high) == VALVE_RANGE)) and all(
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
    record = Record(
        grid.period_s, own["pv"], own["mv"], own["dv"], run, time_s, columns["pv"], columns["mv"], columns["dv"]
    )
    if not grid.fresh:
        return record
    every_row = np.ones(len(kept), dtype=np.bool_)
    fresh = [grid.fresh[t.tag][kept] if t.tag in grid.fresh else every_row for t in groups["pv"]]
    return replace(record, fresh=np.column_stack(fresh))


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
        pad = RANGE_PAD * (high - low)
        low, high = (float(f"{v:.3g}") for v in (low - pad, high + pad))
    # A given end may lie on the wrong side of values that nothing forbids.
    if not (low if tag.low is None else tag.low) < (high if tag.high is None else tag.high):
        wide = max(1.0, 0.1 * abs(high))
        low, high = (low if tag.low is None else tag.low) - wide, (high if tag.high is None else tag.high) + wide
        tag = replace(tag, low=None, high=None)
    return tag.signal(low, high)
