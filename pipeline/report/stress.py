"""The pages of a stress test, its pictures, and its table for programs."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopwright.pipeline.evaluation.stress.draws import KINDS, MOST_SPAN, MOST_ZERO, STROKE, STUCK_FOR, Draw
from loopwright.pipeline.evaluation.stress.loops import REFUSED, Stress, StressOutcome
from loopwright.pipeline.evaluation.stress.summary import LOOP_QUANTILES, Summary, table
from loopwright.pipeline.files import draft_of
from loopwright.pipeline.pictures.drawing import save
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.pictures.stress_pictures import growth_canvas, loop_canvas, spread_canvas
from loopwright.pipeline.report.templating import render, write_pages
from loopwright.serving.manifest import Signal

TABLE = "plants.parquet"


@dataclass(frozen=True)
class StressRun:
    """A stress test that has been run: the file, how it was drawn, the loops."""

    file: Path
    stress: Stress
    summary: Summary
    options: str  # of the command, without the file: what a replay needs
    stepped_by: str  # what computed the steps of the law

    def replay(self, index: int) -> str:
        """The command that runs one loop again."""
        return f"loopwright stress {shlex.quote(str(self.file))} --replay {index}{self.options}"


def write_stress(run: StressRun, out: Path) -> list[Path]:
    """Write report.html, report.md, the table and the pictures into ``out``; their paths."""
    summary, drawing = run.summary, run.stress.drawing
    case = summary.case
    (out / "figures").mkdir(parents=True, exist_ok=True)
    for old in (out / "figures").glob("loop_*.png"):  # of a report that stood here before
        old.unlink()
    written = [out / "figures" / "spread.png"]
    save(spread_canvas(summary, case.label(case.metric)), written[0])
    growths = summary.growths()
    canvas = growth_canvas(growths)
    if canvas is not None:
        written.append(out / "figures" / "growth.png")
        save(canvas, written[-1])
    worst = []
    for place in summary.worst():
        index = summary.draws[place].index
        draw, loop, outcome = run.stress.loop(index)
        written.append(out / "figures" / f"loop_{index}.png")
        plant = drawing.plant_of(draw.scenario)
        save(loop_canvas(plant, draw, loop, f"Loop {index}: {draw.test}"), written[-1])
        worst.append(_loop_row(run, draw, outcome, float(summary.relative[place])))
    ranges = {
        name: ends for test in summary.draws for name, ends in drawing.ranges(drawing.plant_of(test.scenario)).items()
    }
    units = dict(case.plant.parameter_units())
    content = {
        "case": case,
        "name": summary.name,
        "file": str(run.file),
        "loops": len(summary.outcomes),
        "seed": drawing.seed,
        "faults": 100 * drawing.faults,
        "counts": summary.counts,
        "shares": {k: 100 * v / len(summary.outcomes) for k, v in summary.counts.items()},
        "quantiles": [f"{100 * q:g} %" if q < 1 else "worst" for q in LOOP_QUANTILES],
        "spreads": [(case.label(s.metric), s.test or "all", s.loops, s.values) for s in summary.spreads()],
        "requirements": [
            (case.label(need.metric), need.scenario, need.low, need.high, met.loops, 100 * met.share)
            for met in summary.requirements()
            for need in (met.requirement,)
        ],
        "growth": canvas is not None,
        "growths": [(g.name, g.size) for g in growths],
        "worst": worst,
        "ranges": [(name, low, high, units.get(name, "")) for name, (low, high) in ranges.items()],
        "kinds": ", ".join(KINDS),
        "zero": 100 * MOST_ZERO,
        "span": 100 * MOST_SPAN,
        "stroke": STROKE,
        "stuck": tuple(100 * s for s in STUCK_FOR),
        "table": TABLE,
        "stepped_by": run.stepped_by,
    }  # fmt: skip
    _write_table(out / TABLE, table(summary.draws, summary.outcomes), run)
    pages = write_pages(
        out, {name: render(f"stress.{name.partition('.')[2]}.j2", content) for name in ("report.html", "report.md")}
    )
    return [*pages, out / TABLE, *written]  # fmt: skip


def _loop_row(run: StressRun, draw: Draw, outcome: StressOutcome, relative: float) -> dict[str, Any]:
    case = run.summary.case
    return {
        "index": draw.index,
        "test": draw.test,
        "error": outcome.figures[case.metric],
        "relative": relative,
        "failed": failed_words(outcome),
        "drawn": drawn_words(draw, run.stress.drawing.plant_of(draw.scenario).mv_signals),
        "command": run.replay(draw.index),
    }


def failed_words(outcome: StressOutcome) -> str:
    """How a loop failed; empty where it did not."""
    return ", ".join(f"{name} ({outcome.refused})" if name == REFUSED else name for name in outcome.failures)


def drawn_words(draw: Draw, signals: Sequence[Signal]) -> str:
    """The draws, in a line."""
    words = [f"{name} = {number(value, 4)}" for name, value in draw.parameters.items()]
    words += [f"load {100 * draw.load:.0f} %", f"noise × {draw.noise:.2f}"]
    words += ["one more sample of dead time"] if draw.late else []
    words += [draw.fault.words(signals)] if draw.fault is not None else []
    return ", ".join(words)


def replay_loop(stress: Stress, index: int, picture: Path) -> list[str]:
    """Run one loop again and draw it into ``picture``; what was drawn at random and how it went, in lines."""
    drawing = stress.drawing
    draw, loop, outcome = stress.loop(index)
    case, plant = drawing.case, drawing.plant_of(draw.scenario)
    width = max(len(case.label(name)) for name in outcome.figures)
    picture.parent.mkdir(parents=True, exist_ok=True)
    save(loop_canvas(plant, draw, loop, f"Loop {draw.index}: {draw.test}"), picture)
    return [
        f"loop {draw.index} of seed {drawing.seed}, test {draw.test}: {draw.scenario.title}",
        f"drawn: {drawn_words(draw, plant.mv_signals)}",
        *(f"  {case.label(name):{width}}  {value:.6g}" for name, value in outcome.figures.items()),
        f"failed: {failed_words(outcome) or 'no'}",
        f"picture: {picture}",
    ]


def _write_table(path: Path, columns: Mapping[str, list[object]], run: StressRun) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    told = {"loopwright.stress": run.replay(-1).replace("--replay -1", "").replace("  ", " ")}
    told["loopwright.stepped_by"] = run.stepped_by
    told["loopwright.sha256"] = run.stress.controller.sha256
    with draft_of(path) as draft:
        pq.write_table(pa.table(dict(columns)).replace_schema_metadata(told), draft)
