"""What `loopwright new` tells a person of a screened export, and why it does not add a plant."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.commands.new_commands import unvisited
from pipeline.historian.findings import Screening, Verdict
from pipeline.historian.screening import Screened
from pipeline.historian.step_test import StepTest
from pipeline.historian.tags import Tag


def refusal(found: Screened, tags: Sequence[Tag], anyway: bool) -> str:
    """Why the plant is not added; empty where it is."""
    record, verdict = found.record, found.report.verdict
    for signal, values in zip(record.mv_signals, record.mv.T, strict=True):
        if float(values.max() - values.min()) <= 1e-9 * (signal.high - signal.low):
            return f"{signal.name} is {values[0]:g} {signal.unit} in every row; run the step test in step_test.csv"
        if words := unvisited(signal, values, tags):
            return words
    if verdict.rows < verdict.parameters:
        return f"{verdict.reasons[0]}; with fewer rows than parameters --anyway does not help"
    if verdict.carries == "no" and not anyway:
        return f"{verdict.reasons[0]}; run the step test in step_test.csv, or give --anyway"
    return ""


def tell(name: str, folder: Path, report: Screening, test: StepTest | None, added: bool) -> None:
    """Print the account of rows, the findings, the verdict, and what to do next."""
    kept = 100 * report.kept_rows / report.grid_rows
    print(f"{name}: {report.file_rows} rows of {len(report.files)} file(s) -> {report.grid_rows} rows of "
          f"{report.period_s:g} s, {report.kept_rows} kept ({kept:.1f} %) in {report.runs} run(s)")  # fmt: skip
    for reason, rows in report.dropped_rows.items():
        print(f"  {rows:8} rows dropped: {reason.replace('_', ' ')}")
    for finding in report.findings:
        print(f"  {finding.tag}: {finding.words}")
    for line in sayings(report.verdict):
        print(f"  {line}")
    print(f"can these data carry a model: {report.verdict.carries}")
    for reason in report.verdict.reasons:
        print(f"  {reason}")
    print(f"look at {folder}/screening.html: trends with every mask")
    if added:
        if report.verdict.carries != "yes":
            print(f"{name} was added in spite of this, and its models may be poor: look at their fit in the report, "
                  f"or record more and give all files again with --replace")  # fmt: skip
        print(f"then: loopwright run {name}")
    if test:
        print(f"{folder}/step_test.csv is the step test to run: {len(test.start_s)} steps, {test.hours:.1f} h")


def sayings(verdict: Verdict) -> list[str]:
    """What the data say of the plant, a line a pair, for a person to compare with what is known of it."""
    lines = []
    for i in verdict.inputs:
        for pv, gain in i.gain.items():
            first = i.first_answer_s.get(pv)
            if not gain and first is None:
                continue
            words = [f"gain {gain:.3g}"] if gain else ["gain not clear"]
            words += [f"first answer after {first:g} s"] if first is not None else []
            words += [f"the slowest settles in {i.settling_s:g} s"] if i.settling_s and gain else []
            lines.append(f"{i.name} -> {pv}: {', '.join(words)}; is it so on the plant?")
    return lines
