"""A screening for a person: lines on the plant by its data, and a page, one HTML file with its pictures inside."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.config.known import Known, span_words
from loopwright.pipeline.files import write_text
from loopwright.pipeline.historian.cleaning.findings import InputReport, RecordJudgement, Screening, counted
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import HELD_ROWS
from loopwright.pipeline.historian.screening import Screened
from loopwright.pipeline.historian.settling import in_words
from loopwright.pipeline.historian.stated_answers import Beside
from loopwright.pipeline.historian.step_test import StepTest
from loopwright.pipeline.pictures.drawing import axis_label, png, ratio_unit
from loopwright.pipeline.pictures.excitation_pictures import inputs, verdict
from loopwright.pipeline.pictures.screening_pictures import details, readings, times_of, trends
from loopwright.pipeline.report.templating import render
from loopwright.serving.words import plain

VERDICTS = {
    "yes": "These data can carry a model.",
    "doubtful": "A model of these data is doubtful.",
    "no": "These data cannot carry a model.",
}


def write_page(path: Path, found: Screened, test: StepTest | None, known: Sequence[Beside] = ()) -> None:
    """Write the page of a screening, whole or not at all; ``known`` are an engineer's statements beside the record."""
    report = found.report
    pictures = {
        "trends": trends(found),
        "details": details(found),
        "readings": readings(found),
        "inputs": inputs(found),
        "verdict": verdict(found),
    }
    content = {
        "r": report,
        "verdict": VERDICTS[report.verdict.carries],
        "words": {r.name.lower(): r.words for r in Reason},
        "pictures": {name: _inline(canvas) for name, canvas in pictures.items() if canvas is not None},
        "kept_percent": 100.0 * report.kept_rows / report.grid_rows,
        "when": times_of(found).words,
        "test": test,
        "known": known_lines(known),
    }
    write_text(path, render("screening.html.j2", content))


def _inline(canvas: Canvas) -> str:
    return "data:image/png;base64," + base64.b64encode(png(canvas)).decode()


# ------------------------------------------------------------------------------ lines on the plant by its data
def sayings(verdict: RecordJudgement, units: Mapping[str, str], known: Collection[Known] = ()) -> list[str]:
    """Lines on the plant by its data, one a pair, for a person to compare with what is known of it.

    ``units`` are those of the signals by name; of the pairs that are ``known`` nothing is asked.
    """
    lines, said = [], {(one.pv, one.input): one.says for one in known}
    for i in verdict.inputs:
        for pv, gain in i.gain.items():
            first = i.first_answer_s.get(pv)
            rate = i.rate.get(pv)
            if not gain and first is None and rate is None:
                open_question = "does it move it on the plant, and which way?"
                if i.role == "mv":
                    further = f"you say {said[pv, i.name]}" if (pv, i.name) in said else open_question
                    lines.append(f"{i.name} -> {pv}: not clear from the record; {further}")
                continue
            # The report has the gain at the middle of the record, by the models that are fitted later.
            by_one = axis_label(f"gain {gain:.3g}", ratio_unit(units.get(pv, ""), i.unit)) + " by one linear model"
            words = [by_one if gain else "gain not clear" if rate is None else _ramp(rate, units.get(pv, ""), i.unit)]
            hidden = f"or settles slowly: {i.name} follows {pv}, which hides the difference"
            words += [hidden] if rate is not None and not gain and pv in i.against else []
            seldom = ", as it seldom rests" * (i.held_share < HELD_ROWS)
            words += [f"first answer not seen{seldom}" if first is None else _after(first, i.first_possible_s[pv])]
            words += [_settles(i, pv)] if gain else []
            words += ["gain and settling unreliable: drift or loads"] if gain and pv in verdict.unsure else []
            unknown = first is None and i.role == "mv" and (pv, i.name) not in said
            stated = f' If you know the dead time, state it in s, as --known "{pv}/{i.name}=dead FROM..TO".' * unknown
            lines.append(f"{i.name} -> {pv}: {', '.join(words)}; is it so on the plant?{stated}")
    return lines


def _settles(report: InputReport, pv: str) -> str:
    """How long the slowest PV takes to settle, where that is certain."""
    return f"the slowest settles in {report.settling_s:g} s" if pv in report.certain else "settling time not certain"


def _ramp(rate: float, top: str, bottom: str) -> str:
    """Change of a PV that integrates, in a minute, with its unit and that of the input."""
    per = f"per {axis_label('', bottom).strip() or 'unit'}"
    return f"integrates: {axis_label(f'{rate:.3g}', top)} {per} and minute"


def _after(first_s: float, possible_s: float) -> str:
    """When a PV answers first, as a range where the noise hides how early."""
    if possible_s <= 0 < first_s:
        return f"first answer after {first_s:g} s at most"
    return f"first answer after {f'{possible_s:g} to ' if possible_s < first_s else ''}{first_s:g} s"


def known_lines(known: Sequence[Beside]) -> list[str]:
    """A line for each statement of an engineer, with the dead times that the record leaves; then the questions."""
    lines = []
    for one in known:
        words = f"you know of {one.known.pair}: {one.known.says}"
        if one.dead is not None:
            words += f"; the record by itself leaves {span_words(*one.dead_s)} of dead time"
        elif one.known.dead_s is not None:
            words += "; the dead time is not compared: the rows are too few, or more periods are said than can be"
        lines.append(words)
    return [*lines, *(question for one in known for question in one.questions)]


# -------------------------------------------------------------------------------- lines that are printed of a screening
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
