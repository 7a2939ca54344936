"""Findings that are named while nothing is dropped: compression, repeated values, coarse steps, MVs of few values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from loopwright.pipeline.historian.answers import first_answer
from loopwright.pipeline.historian.arx_model import Linear, lead
from loopwright.pipeline.historian.cleaning.findings import Finding, RecordJudgement, counted
from loopwright.pipeline.historian.cleaning.outliers_and_units import noise_sd, usual
from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.sampling import TagSampling, sampling, whole_multiple
from loopwright.pipeline.historian.cleaning.tag_checks import VALVE_RANGE
from loopwright.pipeline.historian.cleaning.tags import SIGNAL_ROLES, Tag
from loopwright.pipeline.historian.files.export import Export, Series
from loopwright.pipeline.historian.files.signal_statistics import HELD_ROWS, quantum, staircase, straight_share
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record, levels_of, only_between

# ------------------------------------------------------------------------------------------ MVs of two or three values
END = 0.01  # of the range: so near is an end
SWITCHED = ((0.0, 1.0), (0.0, 100.0))  # what an on-off valve is often written as, whatever its range


def on_off(record: Record, tags: Sequence[Tag]) -> tuple[str, ...]:
    """For each MV that looks like an on-off valve: the finding, and the remedy; ``tags`` have the stated ranges."""
    return tuple(
        f"{s.name} is {levels[0]:.4g} or {levels[1]:.4g} {s.unit}".rstrip(" -")
        + " in all rows and looks like an on-off valve; predictive control and the PID move an MV continuously: give "
        "the share of time that it is open as the MV, or the output of the controller that switches it"
        for s, values in zip(record.mv_signals, record.mv.T, strict=True)
        if _ends(levels := levels_of(values), next((t for t in tags if s.name in {t.name, t.tag}), None))
    )


def with_levels(verdict: RecordJudgement, record: Record, tags: Sequence[Tag]) -> RecordJudgement:
    """The verdict, "no" where an MV looks like an on-off valve, and with what an MV of few values leaves unseen."""
    found = zip(record.mv_signals, map(levels_of, record.mv.T), strict=True)
    if switched := on_off(record, tags):
        return replace(verdict, carries="no", reasons=(*switched, *verdict.reasons))
    unseen = tuple(only_between(s.name, levels, s.unit) for s, levels in found if levels)
    return replace(verdict, reasons=(*verdict.reasons, *unseen))


def _ends(levels: Sequence[float], tag: Tag | None) -> bool:
    if len(levels) != 2:
        return False
    low, high = (None, None) if tag is None else (tag.low, tag.high)
    if tag is not None and tag.unit == "%":
        low, high = (VALVE_RANGE[0] if low is None else low), (VALVE_RANGE[1] if high is None else high)
    at_ends = low is not None and high is not None and _near(levels, (low, high))
    return at_ends or any(_near(levels, ends) for ends in SWITCHED)


def _near(levels: Sequence[float], ends: Sequence[float]) -> bool:
    slack = END * (ends[1] - ends[0])
    return all(abs(level - end) <= slack for level, end in zip(levels, ends, strict=True))


# --------------------------------------------------------------------------------------------------------- all notices
COARSE_STEP = 0.002  # of the usual span: a converter's step that a model feels
STRAIGHT = 0.3  # share of rows in straight lines, from which a signal was compressed
BRIDGED = 0.05  # of the rows, drawn or held because no reading is near
# readings of other files for each row of the file that lacks the tag: stored apart, by exception
READINGS_ELSEWHERE = 0.1
MOVES_AHEAD = 25.0  # strength of moves still to come


def check_readings(series: Series, rate: TagSampling, role: str, period_s: float) -> list[Finding]:
    """Compression, exception reporting, repeated values and coarse steps of one tag; ``period_s`` of the record."""
    if series.categories:
        return []
    found = []
    values = series.value[series.good]
    low, high = usual(values)
    span = high - low
    if rate.irregular:
        kind = "by exception, beyond a dead band" if rate.dead_band else "by exception, or compressed (swinging door)"
        line = series.between == "line" or (role in {"pv", "dv"} and not rate.dead_band)
        taken = "drawn on lines" if line else "held"
        went, word = ("in steps", "step") if line else ("on lines", "line")
        other = f"; if it went {went}, write {word} into column between" * (not series.between and role != "mode")
        words = (
            f"stored {kind}: a reading every {rate.step_s:.4g} s in the median; {taken} from one to the next{other}; "
            f"used for at most {rate.hold_s:.4g} s"
        )
        found.append(Finding("compression", series.tag, words))
    elif (share := straight_share(values)) > STRAIGHT:
        words = (
            f"{100 * share:.0f} % of the readings lie on straight lines: interpolated from compressed data (swinging "
            "door); what lies between was never stored, export raw data"
        )
        found.append(Finding("compression", series.tag, words))
    if (length := staircase(values)) > 1 and role == "pv":
        made_s = length * rate.step_s
        words = f"every value stands {length} times: made once in {made_s:.4g} s (a mean, or held), written more often"
        words += f"; give --period {made_s:.6g}" if period_s < 0.99 * made_s else f"; the rows are of {period_s:.6g} s"
        found.append(Finding("repeated", series.tag, words))
    step = quantum(values)
    if span > 0 and step > COARSE_STEP * span and role in {"pv", "dv"}:  # an MV is moved in steps
        noise = noise_sd(values)
        words = f"moves in steps of {step:.4g}, {100 * step / span:.2g} % of its span"
        words += ", more than its noise" if step > 2 * noise else ""
        found.append(Finding("quantization", series.tag, words))
    return found


def of_notes(export: Export) -> list[Finding]:
    """The assumptions made when the files were read: their times, qualities, sheets."""
    return [Finding("reading", note.column, note.words) for note in export.notes]


def of_rows(series: Sequence[Series], period_s: float, step_s: float) -> list[Finding]:
    """PVs whose rows lie between readings: stored as lines, or at a rate that is no whole part of the record's."""
    rate = sampling(series[0])
    if rate.irregular and not rate.dead_band and period_s == step_s < rate.step_s:
        words = f"rows of {period_s:g} s lie on the lines between stored readings; another --period changes that"
        return [Finding("drawn", series[0].tag, words)]
    if whole_multiple(period_s, step_s) or rate.irregular:
        return []
    better = max(1, round(period_s / step_s)) * step_s
    words = (
        f"a reading every {step_s:.9g} s and a row every {period_s:.9g} s: rows are drawn between readings, and the "
        f"MVs are held; --period {better:.9g} takes them as they are"
    )
    return [Finding("between", series[0].tag, words)]


def of_files(export: Export, tags: Sequence[Tag]) -> list[Finding]:
    """Tags that one of several files lacks, while no other file has them at its time."""
    found = []
    for tag in (t.tag for t in tags):
        times = export.series[tag].time_s
        for file in (f for f in export.contents if tag not in f.tags and f.rows):
            inside = np.count_nonzero((times >= file.first_s) & (times <= file.last_s))
            if inside < READINGS_ELSEWHERE * file.rows:
                role = next(t.role for t in tags if t.tag == tag)
                end = f": its {file.rows} rows are left out" if role in SIGNAL_ROLES else ""
                found.append(Finding("lacking", tag, f"{file.path} has no {tag}{end}", bool(end)))
    return found


def of_grid(grid: Grid) -> list[Finding]:
    """Tags whose rows are often drawn or held where no reading is near."""
    found = []
    for tag, rows in grid.bridged.items():
        if rows > BRIDGED * len(grid):
            words = (
                f"{counted(rows, 'row')} ({100 * rows / len(grid):.0f} %) between readings farther apart than the "
                f"period of {grid.period_s:g} s; a longer --period makes less of them up"
            )
            found.append(Finding("bridged", tag, words))
    return found


def of_mode(series: Series, values: Array) -> list[Finding]:
    """How often a loop was switched, of a mode's values (n,) on the grid; nothing where it never was."""
    known = values[np.isfinite(values)]
    switches = int(np.count_nonzero(np.diff(known)))
    if not switches:
        return []
    rows = ", ".join(f"{name} in {counted(int(np.sum(known == i)), 'row')}" for i, name in enumerate(series.categories))
    words = f"{counted(switches, 'switch', 'switches')}: {rows}; --without-mode leaves the rows of a mode out"
    return [Finding("mode", series.tag, words)]


def of_models(record: Record, models: Mapping[str, Linear | None]) -> list[Finding]:
    """Moves that a PV answers before they happen, by the quick linear models."""
    found = []
    inputs = [*record.mv.T, *record.dv.T]
    for i, signal in enumerate(record.mv_signals):
        span = max(float(np.ptp(record.mv[:, i])), 1e-300)
        held = float(np.mean(np.abs(np.diff(record.mv[:, i])) <= 1e-9 * span))
        if held < HELD_ROWS:  # in a loop the MV follows the PV at every row; an MV that holds does not know what comes
            continue
        leads = {
            name: lead(m, y, inputs, i)
            for (name, m), y in zip(models.items(), record.pv.T, strict=True)
            if m is not None
        }
        early = {name: rows for name, (strength, rows) in leads.items() if strength > MOVES_AHEAD}
        if early:
            answers = {
                n: first_answer(y, record.mv[:, i], record.run) for n, y in zip(models, record.pv.T, strict=True)
            }
            first = [k for n, k in answers.items() if k and not k.feedback]
            if not first:  # an operator moves it against the PV
                continue
            rows = max(max(leads[n] for n in early)[1], *(1 - k.last for k in first))
            words = (
                f"{', '.join(early)} answers about {counted(rows, 'row')} before {signal.name} moves: the "
                f"export stores {signal.name} late, or an operator moves it at once when the other changes"
            )
            found.append(Finding("shifted", signal.name, words))
    return found
