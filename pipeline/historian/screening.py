"""One export -> a clean record and the account of every reading and row; all faults at once."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import tzinfo

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.analyser_readings import Aligned, in_place, of_lateness
from loopwright.pipeline.historian.arx_model import Linear, believed
from loopwright.pipeline.historian.cleaning.findings import Finding, RecordJudgement, Screening, TagReport, counted
from loopwright.pipeline.historian.cleaning.new_readings import new_readings, put_analysers
from loopwright.pipeline.historian.cleaning.outliers_and_units import usual
from loopwright.pipeline.historian.cleaning.record_rows import (
    WINDOWED,
    check_modes,
    evenly,
    flag_readings,
    flag_rows,
    interval_text,
    mask_stuck_and_saturated,
    of_left_out,
    record_of,
    row_codes,
    spans_of,
)
from loopwright.pipeline.historian.cleaning.repeated_blocks import flag_copies
from loopwright.pipeline.historian.cleaning.response_consistency import contradict
from loopwright.pipeline.historian.cleaning.row_grid import Grid, resampled
from loopwright.pipeline.historian.cleaning.sampling import TagSampling, proposed_period, sampling
from loopwright.pipeline.historian.cleaning.tag_checks import flag_bad_readings, reasons_of, with_texts_of_one_side
from loopwright.pipeline.historian.cleaning.tags import SIGNAL_ROLES, Tag, commanded_range
from loopwright.pipeline.historian.drift import explained, of_levels, of_quick_models
from loopwright.pipeline.historian.excitation import SEEN_STRENGTH, judged, moves_of, with_rows_out_of_range
from loopwright.pipeline.historian.files.export import Export, Series
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import quantum
from loopwright.pipeline.historian.notices import (
    check_readings,
    of_files,
    of_grid,
    of_mode,
    of_models,
    of_notes,
    of_rows,
    on_off,
    with_levels,
)
from loopwright.pipeline.historian.old_loop_fit import old_controllers, operated
from loopwright.pipeline.historian.outlier_review import remove_pulses, review_outliers
from loopwright.pipeline.historian.settling import of_period, pace_of
from loopwright.pipeline.historian.standstill import of_zeros, stops
from loopwright.pipeline.historian.step_test import with_load_moves
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal


# ---------------------------------------------------------------------------------- process variables that no MV moves
def findings_of_answers(
    pvs: Sequence[str], verdict: RecordJudgement, constraints: Collection[str] = ()
) -> list[Finding]:
    """One finding for each PV that answers to no MV, and one where not every PV with a set point can be controlled.

    Empty where no PV answers at all: then the verdict says what is wrong with the MVs. ``pvs`` are names, in order.
    """
    mvs = [i for i in verdict.inputs if i.role == "mv"]
    unmoved = [n for n in pvs if not any(i.answers.get(n, 0.0) > SEEN_STRENGTH or n in i.first_answer_s for i in mvs)]
    found = []
    if len(unmoved) < len(pvs):
        found += [Finding("unmoved", n, "answers to no MV: leave its role empty, or make it dv") for n in unmoved]
    pvs = [name for name in pvs if name not in constraints]
    if len(pvs) > len(mvs):
        first, others = ", ".join(pvs[: len(mvs)]), ", ".join(pvs[len(mvs) :])
        words = (
            f"will be controlled, the first of {counted(len(pvs), 'PV')} for {counted(len(mvs), 'MV')}; {others} will "
            "not: to change it, put the PVs to control first"
        )
        found.append(Finding("controlled", first, words))
    return found


# ------------------------------------------------------------------------------------------------- the whole screening
LARGE_TAG = 1_000_000  # readings of a tag, of which only the remarkable ones are kept for the pictures


@dataclass(slots=True, eq=False)
class Screened:
    """The clean record, the rows it was taken from, and the report.

    ``record`` may give way to an excerpt once it is written: pages and pictures need no more.
    """

    record: Record
    grid: Grid
    code: NDArray[np.uint8]  # (n,) Reason of each row of the grid
    series: Mapping[str, Series]  # the readings of each tag, with their reasons
    report: Screening
    step_s: float = 0.0  # of the export's own readings, where the rows were resampled from some
    models: Mapping[str, Linear | None] = field(default_factory=dict)  # PV -> the quick one, of ``evenly(record)``
    local: tzinfo | None = None  # the zone that a person named for the export's dates


def screen_export(
    plant: str,
    export: Export,
    tags: Sequence[Tag],
    period_s: float | None = None,
    hold_s: float | None = None,
    without_modes: Sequence[str] = (),
    leave_out: Sequence[str] = (),
) -> Screened:
    """Screen, resample, screen again, and judge; ``tags`` have their names.

    RecordError where nothing of a signal is left, or its given range misses most of its readings.
    """
    own = {t.tag: replace(export.series[t.tag], between=t.between) for t in tags}
    listed, analysers = tags, [t for t in tags if t.analyser]
    tags = quick = [t for t in tags if not t.analyser]
    if not any(t.role == "pv" for t in tags):
        raise RecordError(
            f"{analysers[0].tag} is an analyser, and there is no other process variable; name one that is read in each "
            "row, or give the analyser the role pv: a row is then as long as its readings are apart"
        )
    check_modes(without_modes, tags, own)
    findings: list[Finding] = [*of_notes(export), *of_files(export, tags)]
    spans = spans_of(leave_out, export)
    flag_readings(own.values(), spans, Reason.LEFT_OUT)
    stopped, stop = stops(own, tags, lambda first_s, end_s: interval_text(first_s, end_s, export))
    flag_readings(own.values(), stopped, Reason.STOP)
    findings += stop
    findings += flag_copies(own, tags)
    for tag in tags:
        if tag.role != "mode":
            findings += flag_bad_readings(own[tag.tag], tag)
        if not own[tag.tag].good.any():
            raise RecordError(f"{tag.tag} has no good reading among {len(own[tag.tag])}: {reasons_of(own[tag.tag])}")
    drawn = [own[t.tag] for t in tags if t.role in {"pv", "dv"}]
    held = [own[t.tag] for t in tags if t.role in {"mv", "sp", "mode"}]
    pvs = [own[t.tag] for t in tags if t.role == "pv"]
    step = proposed_period(pvs, [own[t.tag] for t in tags if t.role == "mv"])
    pace = pace_of(own, tags, step)
    period = period_s or pace.period(step)
    findings += of_period(pace, period, step, given=period_s is not None)
    findings += of_rows(pvs, period, step)
    role_of = {t.tag: t.role for t in tags}
    findings += [
        f
        for t in tags
        for s in (own[t.tag],)
        for f in check_readings(s, sampling(s, period, hold_s), role_of[s.tag], period)
    ]
    steps = {t.tag: quantum(own[t.tag].value[own[t.tag].good]) if t.role != "mode" else 0.0 for t in listed}

    counts_of: dict[str, dict[str, int]] = {}

    def let_go(tag: str) -> None:
        """Count the readings of a tag; nothing but pictures needs them from here on."""
        counts_of[tag] = own[tag].counts()
        if len(own[tag]) > LARGE_TAG:
            own[tag].lighten()

    def resampled_one(tag: str) -> None:
        if role_of[tag] not in {"pv", "mv"}:
            let_go(tag)

    grid, rates = resampled(drawn, held, period, hold_s, resampled_one, sampled=pace.fed_back)
    by_tag = {r.tag: r for r in rates}
    signals = [t for t in tags if t.role in {"pv", "mv", "dv"}]
    findings += of_left_out(leave_out, flag_rows(grid, [t.tag for t in signals], spans, Reason.LEFT_OUT))
    flag_rows(grid, [t.tag for t in signals], stopped, Reason.STOP)
    findings += of_grid(grid)
    findings += remove_pulses(grid, own, signals)
    for t in (t for t in tags if t.role == "mv"):
        let_go(t.tag)
    findings += review_outliers(grid, own, signals, by_tag)
    for t in (t for t in tags if t.role == "pv"):
        let_go(t.tag)
    findings += mask_stuck_and_saturated(grid, signals, by_tag)
    findings += of_zeros(grid, signals)
    findings += mask_contradictions(grid, signals)
    for t in analysers:
        own[t.tag] = new_readings(own[t.tag], step)
        findings += flag_bad_readings(own[t.tag], t)
        counts_of[t.tag], by_tag[t.tag] = own[t.tag].counts(), sampling(own[t.tag], period)
    findings += put_analysers(grid, analysers, own)
    tags, signals = listed, [t for t in listed if t.role in SIGNAL_ROLES]
    findings += [f for t in tags if t.role == "mode" for f in of_mode(own[t.tag], grid.value[t.tag])]
    code = row_codes(grid, signals, tags, own, without_modes)
    record = replace(record_of(grid, code, signals), fed_back=pace.fed_back)
    excerpt = evenly(record)
    aligned = Aligned.of(excerpt, len(record.pv_signals))
    excerpt = in_place(excerpt, aligned)
    findings += of_lateness(aligned, {t.name: t.tag for t in signals})
    models = models_of(excerpt)
    moved = max(
        (len(moves_of(grid.value[t.tag][code == 0][:WINDOWED], record.run[:WINDOWED])) for t in tags if t.role == "sp"),
        default=0,
    )
    findings = of_quick_models(findings, excerpt, models, {t.name: t.tag for t in signals})
    findings += of_models(excerpt, models)
    drifts = {t.name for t in signals for f in findings if f.kind == "drift" and f.tag == t.tag}
    counts = np.bincount(code, minlength=len(Reason))
    verdict = with_load_moves(judged(excerpt, models, moved, len(record), drifts), excerpt, models)
    verdict = with_levels(verdict, excerpt, tags)
    verdict = with_rows_out_of_range(verdict, int(counts[Reason.RANGE]), len(code))
    verdict = with_texts_of_one_side(verdict, findings)
    constraints = {t.name for t in tags if t.constraint}
    findings += findings_of_answers([s.name for s in record.pv_signals], verdict, constraints)
    reports = tuple(
        _tag_report(t, own[t.tag], grid, record, by_tag[t.tag], counts_of[t.tag], steps[t.tag]) for t in tags
    )
    modes = {t.tag: own[t.tag].categories for t in tags if t.role == "mode"}
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
        findings=merged(spelt(findings, tags)),
        verdict=verdict,
        zone=export.zone,
        operated=operated(grid, code, quick, modes),
        old_controllers=old_controllers(grid, code, quick, modes),
    )
    return Screened(record, grid, code, own, report, step, models, export.local)


def mask_contradictions(grid: Grid, signals: Sequence[Tag]) -> list[Finding]:
    """Stretches in which PVs and inputs contradict each other are masked, slow motion without the inputs is named."""
    inputs = [t.tag for t in signals if t.role != "pv"]
    u = [grid.known(t) for t in inputs]
    pvs = [t.tag for t in signals if t.role == "pv"]
    answers = {tag: explained(grid.known(tag), u, grid.piece) for tag in pvs}
    expected = {tag: values for tag, (values, _) in answers.items()}
    settling = {tag: rows for tag, (_, rows) in answers.items()}
    found = contradict(grid, signals, expected, settling)
    for tag in pvs:
        y = grid.known(tag)
        found += of_levels(tag, y, expected[tag], float(np.ptp(usual(y))), settling[tag])
    return found


def models_of(record: Record) -> dict[str, Linear | None]:
    """The quick linear model of each PV from all inputs."""
    u = [*record.mv.T, *record.dv.T]
    return {s.name: believed(y, u, record.run) for s, y in zip(record.pv_signals, record.pv.T, strict=True)}


def spelt(findings: Sequence[Finding], tags: Sequence[Tag]) -> list[Finding]:
    """The findings, each signal by its name, as the verdict, the step test and the controller call it."""
    other = {t.tag: t.name for t in tags if t.name and t.name != t.tag}
    if not other:
        return list(findings)
    longest = sorted(other, key=len, reverse=True)
    found = re.compile(rf"(?<![\w.])(?:{'|'.join(map(re.escape, longest))})(?![\w])")

    def named(text: str) -> str:
        return found.sub(lambda match: other[match[0]], text)

    return [Finding(f.kind, other.get(f.tag, f.tag), named(f.words), f.drops) for f in findings]


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


def _tag_report(
    tag: Tag, series: Series, grid: Grid, record: Record, rate: TagSampling, counts: dict[str, int], step: float
) -> TagReport:
    signal = next((s for s in (*record.pv_signals, *record.mv_signals, *record.dv_signals) if s.name == tag.name), None)
    lost = np.bincount(grid.code[tag.tag], minlength=len(Reason))
    low, high = (signal.low, signal.high) if signal else usual(grid.value[tag.tag])
    return TagReport(
        tag=tag.tag,
        name=tag.name,
        role=tag.role,
        unit=tag.unit,
        low=low,
        high=high,
        readings=counts,
        texts=dict(series.texts.most_common(10)),
        rows_lost={r.name.lower(): int(lost[r]) for r in Reason if r and lost[r]},
        rows_bridged=grid.bridged[tag.tag],
        step=step,
        sampling=rate,
    )


def _mode_rows(grid: Grid, series: Series) -> dict[str, int]:
    values = grid.value[series.tag]
    return {name: int(np.count_nonzero(values == i)) for i, name in enumerate(series.categories)}


# ----------------------------------------------------------------------------------- why a screened record is not used
LEAST_SHARED = 0.05  # of the commanded or the visited range, the smaller one: what both must share


@dataclass(frozen=True, slots=True)
class Refusal:
    """Faults of a record, and the remedies."""

    why: str
    step_test: bool = False  # a step test gives a better one
    anyway: bool = False  # a person may use it all the same


def refusal(found: Screened, tags: Sequence[Tag], anyway: bool) -> Refusal | None:
    """Why the record is not used; None where it is."""
    record, verdict = found.record, found.report.verdict
    for signal, values in zip(record.mv_signals, record.mv.T, strict=True):
        if float(values.max() - values.min()) <= 1e-9 * (signal.high - signal.low):
            return Refusal(f"{signal.name} is {values[0]:g} {signal.unit} in every row", step_test=True)
        if words := unvisited(signal, values, tags):
            return Refusal(words)
    if (switched := on_off(record, tags)) and not anyway:
        return Refusal(switched[0], anyway=True)
    if verdict.rows < verdict.parameters:
        return Refusal(f"{verdict.reasons[0]}; with fewer rows than parameters --anyway does not help")
    if verdict.carries == "no" and not anyway:
        return Refusal(verdict.reasons[0], step_test=True, anyway=True)
    return None


def unvisited(signal: Signal, values: Array, tags: Sequence[Tag]) -> str:
    """Why an MV cannot be commanded as wished: its record (n,) hardly went there; empty where it can."""
    low, high = commanded_range(signal, tags)
    least, most = float(values.min()), float(values.max())
    if min(most, high) - max(least, low) >= LEAST_SHARED * min(most - least, high - low):
        return ""
    return (
        f"{signal.name} may be commanded from {low:g} to {high:g} {signal.unit}, but moved only from {least:g} to "
        f"{most:g} in the record, so nothing is known of the plant there; widen command_low or command_high, or add a "
        "record of that range"
    )
