"""One export -> a clean record and the account of every reading and row; all faults at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RecordError
from pipeline.historian.cells import outliers, sentinels, unit_slips, usual
from pipeline.historian.character import clipped, quantum, runs_of, stuck
from pipeline.historian.excitation import judged, moves_of
from pipeline.historian.export import Export, Series
from pipeline.historian.findings import Finding, Screening, TagReport
from pipeline.historian.grid import Grid, Sampling, proposed_period, resampled, sampling
from pipeline.historian.linear import Linear, fitted
from pipeline.historian.reason import Reason
from pipeline.historian.remarks import of_models, of_series
from pipeline.historian.tags import Tag
from pipeline.metrics import Array
from pipeline.records.record import Record
from serving.manifest import Signal

SHORTEST_RUN = 20  # rows
RANGE_SLACK = 0.1  # of a PV's given range: noise at its ends
MOSTLY = 0.5  # of the readings outside the given range: then the range or its unit is wrong
CONFIRM_SD = 5.0  # residual of the model below which an outlier is an answer
PAD = 0.1  # of the span, beyond the values seen, in a range that was not given

Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Screened:
    """The clean record, the rows it was taken from, and the report."""

    record: Record
    grid: Grid
    code: NDArray[np.uint8]  # (n,) Reason of each row of the grid
    series: Mapping[str, Series]  # the readings of each tag, with their reasons
    report: Screening


def screened(
    plant: str,
    export: Export,
    tags: Sequence[Tag],
    period_s: float | None = None,
    hold_s: float | None = None,
    without_modes: Sequence[str] = (),
) -> Screened:
    """Screen, resample, screen again, and judge; ``tags`` have their names.

    RecordError where nothing of a signal is left, or its given range misses most of its readings.
    """
    own = {t.tag: export.series[t.tag] for t in tags}
    findings: list[Finding] = []
    for tag in tags:
        if tag.role != "mode":
            findings += clean(own[tag.tag], tag)
        if not own[tag.tag].good.any():
            raise RecordError(f"{tag.tag} has no good reading among {len(own[tag.tag])}: {_told(own[tag.tag])}")
    drawn = [own[t.tag] for t in tags if t.role in {"pv", "dv"}]
    held = [own[t.tag] for t in tags if t.role in {"mv", "sp", "mode"}]
    pvs = [own[t.tag] for t in tags if t.role == "pv"]
    period = period_s or proposed_period(pvs)
    findings += [f for s in own.values() for f in of_series(s, sampling(s, period, hold_s))]
    grid, rates = resampled(drawn, held, period, hold_s)
    signals = [t for t in tags if t.role in {"pv", "mv", "dv"}]
    findings += confirm(grid, own, signals)
    findings += stretches(grid, signals)
    code = row_codes(grid, signals, tags, own, without_modes)
    record = record_of(grid, code, signals)
    models = models_of(record)
    moved = max((len(moves_of(grid.value[t.tag][code == 0], record.run)) for t in tags if t.role == "sp"), default=0)
    findings += of_models(record, models)
    by_tag = {r.tag: r for r in rates}
    reports = tuple(_tag_report(t, own[t.tag], grid, record, by_tag[t.tag]) for t in tags)
    counts = np.bincount(code, minlength=len(Reason))
    lengths = np.bincount(record.run) if len(record) else np.zeros(1, dtype=np.int64)
    report = Screening(
        plant=plant,
        files=tuple({"file": f, "sha256": d} for f, d in export.files),
        layout=export.layout,
        file_rows=export.rows,
        unreadable_rows=export.unreadable_rows,
        timeless_rows=export.timeless_rows,
        period_s=period,
        gaps=int(grid.piece[-1]),
        gap_s=_gap_s(grid),
        grid_rows=len(grid),
        kept_rows=int(counts[0]),
        dropped_rows={r.name.lower(): int(counts[r]) for r in Reason if r and counts[r]},
        runs=int(record.run[-1]) + 1 if len(record) else 0,
        longest_run_rows=int(lengths.max()),
        tags=reports,
        modes={t.tag: _mode_rows(grid, own[t.tag]) for t in tags if t.role == "mode"},
        findings=merged(findings),
        verdict=judged(record, models, moved),
    )
    return Screened(record, grid, code, own, report)


# ---------------------------------------------------------------------- readings
def clean(series: Series, tag: Tag) -> list[Finding]:
    """Give every bad reading of one tag its reason; what was found."""
    found = []
    counts = series.counts()
    if series.texts:
        words = ", ".join(f"{t!r} {n} times" for t, n in series.texts.most_common(3))
        found.append(Finding("text", tag.tag, f"text where a number belongs: {words}", True))
    if counts.get("quality"):
        found.append(Finding("quality", tag.tag, f"quality is not good in {counts['quality']} readings", True))
    if counts.get("duplicate"):
        words = f"{counts['duplicate']} readings came a second time; the last good one of each stays"
        found.append(Finding("duplicate", tag.tag, words, True))
    if counts.get("clock"):
        words = f"the clock was set back: {counts['clock']} readings have an ambiguous time; export UTC"
        found.append(Finding("clock", tag.tag, words, True))
    where, codes = sentinels(np.where(series.good, series.value, np.nan))
    if series.flag(where, Reason.SENTINEL):
        words = ", ".join(f"{c} {n} times" for c, n in codes.most_common(3))
        found.append(Finding("sentinel", tag.tag, f"codes for a missing value: {words}", True))
    found += _out_of_range(series, tag)
    if tag.role in {"pv", "dv"}:
        found += _unlike_the_rest(series, tag)
    return found


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
    if n > MOSTLY * good:
        example = series.value[np.flatnonzero(outside)[0]]
        raise RecordError(
            f"{tag.tag}: {n} of {good} good readings, such as {example:.6g}, are outside its range {low:g} to {high:g} "
            f"{tag.unit}; correct the range or the unit"
        )
    words = f"{n} readings outside the range {low:g} to {high:g} {tag.unit} that was given"
    return [Finding("range", tag.tag, words, True)] if n else []


def _unlike_the_rest(series: Series, tag: Tag) -> list[Finding]:
    found = []
    place = np.flatnonzero(series.good)
    values = series.value[place]
    calm = ~outliers(values)
    slipped = np.zeros(len(values), dtype=bool)
    slipped[calm], kinds = unit_slips(values[calm])
    if slipped.any():
        series.code[place[slipped]] = Reason.UNIT_SLIP
        words = ", ".join(f"{k} in {n} readings" for k, n in kinds.most_common())
        found.append(Finding("unit_slip", tag.tag, f"the level jumps as if the unit had changed: {words}", True))
        place, values = place[~slipped], values[~slipped]
    alone = outliers(values)
    if alone.any():
        series.code[place[alone]] = Reason.OUTLIER
        words = f"{int(alone.sum())} readings stand alone, {_example(values[alone])}; usual are {_usual(values)}"
        found.append(Finding("outlier", tag.tag, words, True))
    return found


def _example(values: Array) -> str:
    return f"from {values.min():.5g} to {values.max():.5g}"


def _usual(values: Array) -> str:
    low, high = usual(values)
    return f"{low:.5g} to {high:.5g}"


def _told(series: Series) -> str:
    texts = ", ".join(repr(t) for t, _ in series.texts.most_common(2))
    reasons = ", ".join(f"{n} x {Reason[k.upper()].words}" for k, n in series.counts().items())
    return f"{reasons}{f' ({texts})' if texts else ''}; choose another tag or export it again"


# ---------------------------------------------------------------------- rows
def confirm(grid: Grid, own: Mapping[str, Series], signals: Sequence[Tag]) -> list[Finding]:
    """Put outliers back that a linear model explains: an answer to a move may be sharp.

    Only where rows are not thinned out; changes the grid's values in place.
    """
    found = []
    inputs = [t for t in signals if t.role != "pv"]
    u = np.column_stack([np.empty((len(grid), 0)), *(grid.value[t.tag] for t in inputs)])
    for tag in (t for t in signals if t.role == "pv"):
        s = own[tag.tag]
        bad = np.flatnonzero(s.code == Reason.OUTLIER)
        if not bad.size or not sampling(s).step_s > 0.7 * grid.period_s:
            continue
        y = grid.value[tag.tag]
        model = fitted(y, u, grid.piece)
        if model is None:
            continue
        row = np.searchsorted(grid.time_s, s.time_s[bad] - 0.5 * grid.period_s)
        ok = (row > 45) & (row < len(grid))
        row, bad = row[ok], bad[ok]
        expected = _predicted(model, y, u, row - 1)
        explained = np.abs(s.value[bad] - expected) < CONFIRM_SD * model.sd
        y[row[explained]] = s.value[bad[explained]]
        s.code[bad[explained]] = Reason.GOOD
        grid.code[tag.tag][row[explained]] = Reason.GOOD
        if explained.any():
            words = (
                f"{int(explained.sum())} readings that stand alone are answers to moves, by a linear model; they stay"
            )
            found.append(Finding("answer", tag.tag, words))
    return found


def _predicted(model: Linear, y: Array, u: Array, k: Rows) -> Array:
    """y(k+1) from the rows up to k; NaN where one is missing."""
    out = model.c + sum(a * y[k - i] for i, a in enumerate(model.a))
    for i, row in enumerate(model.b):
        centre = np.nanmean(u[:, i])
        for (first, last), b in zip(model.blocks, row, strict=True):
            out = out + b * (np.mean([u[k - lag, i] for lag in range(first, last)], axis=0) - centre)
    return np.asarray(out)


def stretches(grid: Grid, signals: Sequence[Tag]) -> list[Finding]:
    """Mask stuck and saturated rows of PVs and measured disturbances; changes the grid's codes in place."""
    found = []
    scaled = np.column_stack([_scaled(grid.value[t.tag]) for t in signals])
    together = grid.piece[1:] == grid.piece[:-1]
    for i, tag in enumerate(signals):
        if tag.role == "mv":
            continue
        values, code = grid.value[tag.tag], grid.code[tag.tag]
        for reason, where, words in (
            (Reason.SATURATED, *clipped(values, tag.low, tag.high)),
            (Reason.STUCK, stuck(values, np.delete(scaled, i, axis=1), together), ""),
        ):
            new = where & (code == 0)
            if new.any():
                code[new] = reason
                start, end = runs_of(where)
                own = f"repeats one value in {len(start)} stretches, the longest of {int((end - start).max())} rows"
                text = f"stands at the end of its range: {words}" if words else f"{own}, while others move"
                found.append(Finding(reason.name.lower(), tag.tag, text, True))
    return found


def _scaled(values: Array) -> Array:
    low, high = usual(values)
    return (values - low) / (high - low) if high > low else np.zeros(len(values))


def row_codes(
    grid: Grid, signals: Sequence[Tag], tags: Sequence[Tag], own: Mapping[str, Series], without: Sequence[str]
) -> NDArray[np.uint8]:
    """The first reason of each row over all signals, then of the modes, then of runs that are too short."""
    code = np.zeros(len(grid), np.uint8)
    for t in signals:
        code = np.where(code == 0, grid.code[t.tag], code)
    for t in (t for t in tags if t.role == "mode"):
        names = own[t.tag].categories
        unknown = [w for w in without if w not in names]
        if unknown and sum(x.role == "mode" for x in tags) == 1:
            raise RecordError(f"--without-mode {unknown[0]}: {t.tag} has the modes {', '.join(names)}")
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
    """The rows without a reason as a record: a run ends at a gap and at every row that was left out."""
    kept = np.flatnonzero(code == 0)
    if not kept.size:
        counts = np.bincount(code, minlength=len(Reason))
        words = ", ".join(f"{int(counts[r])} x {r.words}" for r in Reason if counts[r])
        raise RecordError(f"no row of {len(code)} is good in all signals: {words}; name fewer tags, or a longer --hold")
    fresh = np.r_[True, (np.diff(kept) > 1) | (np.diff(grid.piece[kept]) > 0)]
    run = np.cumsum(fresh) - 1
    values = {t.tag: grid.value[t.tag][kept] for t in signals}
    groups = {r: [t for t in signals if t.role == r] for r in ("pv", "mv", "dv")}
    columns = {r: np.column_stack([np.empty((len(kept), 0)), *(values[t.tag] for t in g)]) for r, g in groups.items()}
    own = {r: tuple(_signal(t, values[t.tag]) for t in g) for r, g in groups.items()}
    position = np.arange(len(run)) - np.maximum.accumulate(np.where(fresh, np.arange(len(run)), 0))
    time_s = position.astype(np.float64) * grid.period_s
    return Record(
        grid.period_s, own["pv"], own["mv"], own["dv"], run, time_s, columns["pv"], columns["mv"], columns["dv"]
    )


def _signal(tag: Tag, values: Array) -> Signal:
    """The tag's signal.

    A range that was not given is what the values show: of a percentage 0 to 100, of another MV what was seen, of a
    PV a tenth more.
    """
    low, high = float(values.min()), float(values.max())
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


def models_of(record: Record) -> dict[str, Linear | None]:
    """The quick linear model of each PV from all inputs."""
    u = np.hstack([record.mv, record.dv])
    return {s.name: fitted(y, u, record.run) for s, y in zip(record.pv_signals, record.pv.T, strict=True)}


def merged(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """One finding where several tags have the same."""
    tags: dict[tuple[str, str, bool], list[str]] = {}
    for f in findings:
        tags.setdefault((f.kind, f.words, f.drops), []).append(f.tag)
    return tuple(Finding(kind, ", ".join(own), words, drops) for (kind, words, drops), own in tags.items())


def _gap_s(grid: Grid) -> float:
    """Time without any reading, between the pieces [s]."""
    step = np.diff(grid.time_s)
    return float(np.sum(step[np.diff(grid.piece) > 0] - grid.period_s))


def _tag_report(tag: Tag, series: Series, grid: Grid, record: Record, rate: Sampling) -> TagReport:
    signal = next((s for s in (*record.pv_signals, *record.mv_signals, *record.dv_signals) if s.name == tag.name), None)
    lost = np.bincount(grid.code[tag.tag], minlength=len(Reason))
    low, high = (signal.low, signal.high) if signal else usual(series.value[series.good])
    return TagReport(
        tag=tag.tag,
        name=tag.name,
        role=tag.role,
        unit=tag.unit,
        low=low,
        high=high,
        readings=series.counts(),
        texts=dict(series.texts.most_common(10)),
        rows_lost={r.name.lower(): int(lost[r]) for r in Reason if r and lost[r]},
        rows_bridged=grid.bridged[tag.tag],
        step=quantum(series.value[series.good]) if tag.role != "mode" else 0.0,
        sampling=rate,
    )


def _mode_rows(grid: Grid, series: Series) -> dict[str, int]:
    values = grid.value[series.tag]
    return {name: int(np.count_nonzero(values == i)) for i, name in enumerate(series.categories)}
