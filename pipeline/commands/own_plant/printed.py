"""Lines that ``loopwright new`` prints of a screening: findings, what data say of the plant, verdict, next step."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from loopwright.pipeline.config.known import Known
from loopwright.pipeline.historian.cleaning.findings import Screening, counted
from loopwright.pipeline.historian.settling import in_words
from loopwright.pipeline.historian.step_test import StepTest
from loopwright.pipeline.pictures.drawing import axis_label
from loopwright.pipeline.report.screening import sayings
from loopwright.serving.words import plain


def tell(
    name: str,
    folder: Path,
    report: Screening,
    test: StepTest | None,
    known: Collection[Known] = (),
    *,
    added: bool,
    asked: bool,
) -> None:
    """Print the rows kept, what was found, the verdict, and where to look next; ``asked``: a question comes first.

    Statements of the engineer are not asked for again.
    """
    print(f"{name}: {report.summary}")
    takes = in_words(3600 * test.hours) if test else ""
    if report.gaps:
        length = f"{report.gap_s / 60:.4g} min together"
        print(f"  {counted(report.gaps, 'gap')} without any reading, {length}; a run ends at each")
    for reason, rows in report.dropped_rows.items():
        print(f"  {counted(rows, 'row').rjust(13 - (rows == 1))} dropped: {reason.replace('_', ' ')}")
    for finding in report.findings:
        print(plain(f"  {finding.tag}: {finding.words}"))
    for line in sayings(report.verdict, {tag.name: tag.unit for tag in report.tags}, known):
        print(plain(f"  {line}"))
    for loop in report.operated:
        print(plain(f"how it was run: {loop.words}"))
    for law in report.old_controllers:
        print(plain(f"the old controller: {law.words}"))
    print(f"can these data carry a model: {report.verdict.carries}")
    for reason in report.verdict.reasons:
        print(plain(f"  {reason}"))
    print(f"look at {folder}/screening.html: trends with every mask")
    if added:
        if report.verdict.carries != "yes":
            more = f"record more, as the {takes} of the step test below," if test else "record more"
            print(f"{name} was added in spite of this, and its models may be poor: look at their fit in the report, "
                  f"or {more} and give all files again with --replace")  # fmt: skip
        if not asked:
            print(f"then: loopwright run {name}")
    if test:
        moved = zip(test.names, test.units, test.sizes, strict=True)
        sizes = ", ".join(f"{mv} by up to {axis_label(f'{size:.3g}', unit)} to each side" for mv, unit, size in moved)
        print(f"{folder}/step_test.csv is the step test to run: {len(test.start_s)} steps, {takes}; "
              f"it moves {sizes}{test.reading}")  # fmt: skip
        if not all(i.certain for i in report.verdict.inputs if i.role == "mv"):
            print("  end a step where a PV nears an end of its range in the record, and go on with the next one: "
                  "a PV that does not rest by itself, such as a level, would run on")  # fmt: skip
            for loop in report.operated:
                print(plain(f"  or leave the loop of {loop.pv} in automatic and step its set point at these times, by "
                            "what production bears: its rows carry a model too, and nothing runs on"))  # fmt: skip
