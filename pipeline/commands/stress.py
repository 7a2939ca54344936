"""``loopwright stress``: closed loops of a controller file over plants drawn at random."""

from __future__ import annotations

import argparse
import shlex
import time
from pathlib import Path

import numpy as np

from loopwright.pipeline.commands.arguments import case_of, real, require_shipped, whole
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.stress.batches import STRESS_BATCH, outcomes_of
from loopwright.pipeline.evaluation.stress.draws import Drawing
from loopwright.pipeline.evaluation.stress.loops import Stress, figures_of, opened
from loopwright.pipeline.evaluation.stress.summary import Summary
from loopwright.pipeline.export.plain_code.compiled_law import LAW_BY, law_stepping
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.report.stress import TABLE, StressRun, replay_loop, write_stress
from loopwright.pipeline.simulation.timetable import TimedValue, at_once, parse_event
from loopwright.serving.operating import Operate

# Loops, their seed, spread and faults [%].
STRESS_PLANTS, STRESS_SEED, STRESS_SPREAD, STRESS_FAULTS = 1000, 0, 2.0, 50.0
OPERATE = "NAME=VALUE"


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add = parser.add_argument
    percent = real("a percentage from 0 to 100", lambda value: 0 <= value <= 100)
    add("file", metavar="CONTROLLER", type=Path, help="a controller's .onnx file")
    add("--plants", metavar="N", type=whole(1), default=STRESS_PLANTS, help=f"closed loops ({STRESS_PLANTS})")
    add("--seed", metavar="N", type=whole(0), default=STRESS_SEED, help=f"of all draws ({STRESS_SEED})")
    add("--spread", metavar="PERCENT", type=percent, default=STRESS_SPREAD,
        help=f"of parameters for which the case states no range ({STRESS_SPREAD:g})")  # fmt: skip
    add("--faults", metavar="PERCENT", type=percent, default=STRESS_FAULTS,
        help=f"share of the loops with a fault of an actuator ({STRESS_FAULTS:g})")  # fmt: skip
    add("--operate", metavar=OPERATE, type=_operated, action="append", default=[],
        help="of what operators may change, another value than the file's default")  # fmt: skip
    add("--out", metavar="FOLDER", type=Path, help="where the report goes (CASE-LAW-stress)")
    loop_options(parser)
    add("--replay", metavar="INDEX", type=whole(0), help="run one loop again, and draw it")


def loop_options(parser: argparse.ArgumentParser) -> None:
    """Add what many closed loops run on: workers, batches, and what steps the law."""
    add = parser.add_argument
    add("--workers", metavar="N", type=whole(1), help="processes side by side (one a core)")
    add("--batch", metavar="N", type=whole(1), default=STRESS_BATCH, help=f"loops of a piece of work ({STRESS_BATCH})")
    add("--law-by", choices=LAW_BY, default=LAW_BY[0],
        help=f"steps of the law: c, its plain C; onnx, onnxruntime; auto, c where it can be ({LAW_BY[0]})")  # fmt: skip


def _operated(text: str) -> TimedValue:
    try:
        return parse_event(text, OPERATE, switches=True)
    except ParamsError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def run(options: argparse.Namespace) -> None:
    """Run the loops and write their report; or one of them again."""
    require_shipped(options.file)
    controller, content = opened(options.file)
    case = case_of(controller.manifest)
    drawing = Drawing(case, options.seed, options.spread / 100, options.faults / 100)
    operate = at_once(options.operate)
    Operate(controller.manifest.operate).with_values(operate)  # an error comes before any work
    for tests in drawing.tests.values():
        for test in tests:
            drawing.ranges(drawing.plant_of(test))
    stepping = law_stepping(controller, options.law_by)
    stress = Stress(drawing, content, tuple(operate.items()), stepping.compute)
    if options.replay is not None:
        picture = f"{case.name}-{options.file.stem}-stress-{options.replay}.png"
        print(*replay_loop(stress, options.replay, (options.out or Path()) / picture), sep="\n")
        print(f"law stepped by {stepping.words}")
        return
    out = options.out or Path(f"{case.name}-{options.file.stem}-stress")
    _check_folder(out)
    begun = time.perf_counter()
    outcomes = outcomes_of(stress, options.plants, options.batch, options.workers)
    taken = time.perf_counter() - begun
    summary = Summary(case, options.file.stem, drawing.draws(range(options.plants)), outcomes)
    write_stress(StressRun(options.file, stress, summary, _options(options), stepping.words), out)
    (spread, *_) = [s for s in summary.spreads() if not s.test and s.metric == case.metric]
    low, median, *_, worst = spread.values
    print(f"{options.plants} loops in {taken:.1f} s ({options.plants / taken:.3g} a second)")
    print(f"law stepped by {stepping.words}")
    errors = figures_of(outcomes, case.metric)
    print(
        f"{case.label(case.metric)}: median {number(median)}, 5 % below {number(low)}, worst {number(worst)} "
        f"(loop {outcomes[int(np.nanargmax(errors))].index})"
    )
    for words, count in summary.counts.items():
        print(f"{words}: {count} ({100 * count / options.plants:.3g} %)")
    print(f"report: {out / 'report.html'}")


def _check_folder(out: Path) -> None:
    """ParamsError where a report would take the place of something else."""
    if out.exists() and not out.is_dir():
        raise ParamsError(f"{out} is no folder; name one by --out")
    if (out / "report.html").exists() and not (out / TABLE).exists():
        raise ParamsError(f"{out} holds a report of something else; name another folder by --out")


def _options(options: argparse.Namespace) -> str:
    """The options of a draw that differ from their defaults, as a replay needs them."""
    given = {
        "seed": (options.seed, STRESS_SEED),
        "spread": (options.spread, STRESS_SPREAD),
        "faults": (options.faults, STRESS_FAULTS),
    }
    drawn = "".join(f" --{name} {value!r}" for name, (value, default) in given.items() if value != default)
    drawn += f" --law-by {options.law_by}" if options.law_by != LAW_BY[0] else ""
    return drawn + "".join(f" --operate {shlex.quote(f'{e.name}={e.value!r}')}" for e in options.operate)
