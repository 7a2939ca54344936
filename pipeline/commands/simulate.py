"""A controller file in the real loop over its plant, live."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np

from loopwright.pipeline.cases import PLANTS, all_cases
from loopwright.pipeline.cases.operated_tests import operated_tests
from loopwright.pipeline.commands.arguments import positive, real, require_made_for, require_shipped, whole
from loopwright.pipeline.config.params import CaseParams, choose, parse, read_section
from loopwright.pipeline.errors import ParamsError, nearest
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.metric import METRICS
from loopwright.pipeline.evaluation.model_evidence import IDENTIFIED
from loopwright.pipeline.pictures.loop_picture import History, draw, summary, write_csv
from loopwright.pipeline.pictures.operated_summary import operated_lines
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.simulation.live import SimulatedPlant, view_of
from loopwright.pipeline.simulation.operator_changes import OperatedCourse
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.timetable import Timetable, parse_event, parse_manual, timetable
from loopwright.serving.clock import MonotonicClock, VirtualClock
from loopwright.serving.controller import Controller
from loopwright.serving.endpoint import Array
from loopwright.serving.guard import Sample
from loopwright.serving.loop import WARM_LEAD_S, Command, ControlLoop, Mode
from loopwright.serving.manifest import Manifest
from loopwright.serving.preview.course import Courses, Points
from loopwright.serving.preview.course_file import read_courses

LIVE_RECOVERY = 5  # good samples
P = ParamSpec("P")
T = TypeVar("T")


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""

    def events(option: str, form: str, words: str, switches: bool = False) -> None:
        parse = partial(_argument, partial(parse_event, form=form, switches=switches))
        add(option, metavar=form, type=parse, action="append", default=[], help=words)

    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help="a controller's .onnx file")
    events("--sp", "[NAME=]VALUE[@S]", "set point from time S on; of several set points with its name")
    add("--scenario", metavar="NAME", help="a test of the case (default, without --sp: its first one), or of operators")
    add("--from", metavar="CV", type=real("a finite number"), dest="start",
        help="start at the steady state of this CV")  # fmt: skip
    events("--disturbance", "NAME=VALUE[@S]", "measured disturbance or plant parameter from time S on")
    events(
        "--noise",
        "PV=STD",
        "standard deviation of a reading's noise, of a measured disturbance too, over the whole run",
    )
    events("--operate", "NAME=VALUE[@S]", "what operators change of the file's defaults, from time S on", switches=True)
    add("--course", metavar="FILE.csv", type=Path,
        help="set points and measured disturbances by time from the start, which the law knows before")  # fmt: skip
    add("--straight", metavar="NAME", action="append", default=[],
        help="a set point of the course that runs straight to each value")  # fmt: skip
    add("--manual", metavar="S..S[=MV,..]", type=partial(_argument, parse_manual), action="append", default=[],
        help="MANUAL between two times, with one value an MV")  # fmt: skip
    add("--duration", metavar="S", type=positive("s"), help="length of the run")
    add("--speed", metavar="X", type=positive(), help="times real time, 1 is real time (default: as fast as possible)")
    add("--seed", metavar="N", type=whole(0), default=0, help="of the noise (0)")
    add("--picture", metavar="FILE", type=Path, help="where the picture goes (<law>-simulation.png)")
    add("--csv", metavar="FILE", type=Path, help="write every sample there")


def _test_of(case: Case | None, name: str | None, manifest: Manifest) -> Scenario | None:
    """The first sequence of the case's test ``name``, or of its first test; None where the plant has no case.

    A test in which operators change what this file may be asked for has a name, too.
    """
    if case is None:
        return None
    tests = case.tests()
    if name is not None and name not in tests and manifest.operate:
        own = parse(CaseParams, read_section("cases", case.name), f"cases.{case.name}").operated
        tests |= {key: test.sequences for key, test in operated_tests(case, manifest.operate, own).items()}
    return choose(tests, next(iter(tests)) if name is None else name, "scenario", f"case {case.name!r}")[0]


def run(options: argparse.Namespace) -> None:
    """Run the loop, live, and leave a picture."""
    if options.sp and options.scenario is not None:
        raise ParamsError("give set points or a scenario, not both")
    require_shipped(options.file)
    controller = Controller(options.file)
    plant, case = _plant_of(controller.manifest)
    course = timetable(
        plant,
        None if options.sp else _test_of(case, options.scenario, controller.manifest),
        set_points=options.sp,
        disturbances=options.disturbance,
        noise=options.noise,
        manual=options.manual,
        operate=options.operate,
        start_cv=options.start,
        duration_s=options.duration,
        seed=options.seed,
    )
    plant = course.plant  # a scenario may have one of its own
    if case is not None and case.stand_in == IDENTIFIED and case.on_models and plant is case.plant:
        others = ", ".join(case.scenarios())
        print(
            "on the model that the law was designed on, which flatters it; tests on other models of the record: "
            f"--scenario {others}"
        )
    title = f"{controller.manifest.law} on {plant.title}"
    known = None
    if options.course is not None:
        known = KnownCourses(read_courses(options.course, time.time()), tuple(options.straight))
        course = known.happening(controller.manifest, course, {event.name for event in options.disturbance})
    elif options.straight:
        raise ParamsError("--straight says how a set point of a course runs; give the course by --course FILE.csv")
    history = close_loop(controller, plant, course, title=title, speed=options.speed, known=known)
    print(summary(plant, history, METRICS["mae"] if case is None else case.criterion))
    noise = np.zeros(len(plant.pv_signals)) if case is None else case.noise_std
    for line in operated_lines(plant, history, noise):
        print(line)
    picture = options.picture or Path(f"{controller.manifest.law}-simulation.png")
    draw(picture, plant, history, title, course.marks)
    print(f"picture: {picture}")
    if options.csv:
        write_csv(options.csv, plant, history)
        print(f"samples: {options.csv}")


def close_loop(
    controller: Controller,
    plant: Simulator,
    course: Timetable,
    *,
    title: str,
    speed: float | None = None,
    known: KnownCourses | None = None,
) -> History:
    """Run the controller's ControlLoop over the plant and show it; ``speed`` None is as fast as possible.

    ``known`` is what is known of the future; a set point with a course follows it, and not the timetable. ParamsError
    where the course changes what operators may not change of this file; LoopError where it has nothing that they may
    change, and for a wrong value of what is known.
    """
    simulated, history = SimulatedPlant(plant, course), History(mv0=course.mv0, entries=controller.manifest.operate)
    operated = {change.at: change.values for change in course.operate}
    if controller.manifest.operate and operated:
        OperatedCourse.of(controller.manifest.operate, course.operate, len(course.sp), "this run")
    # The loop outlives whatever raises, as a plant needs it to; a simulation that raised is over.
    failed: list[Exception] = []

    def ending(act: Callable[P, T]) -> Callable[P, T]:
        """``act`` that also keeps its exceptions."""

        def call(*arguments: P.args, **options: P.kwargs) -> T:
            try:
                return act(*arguments, **options)
            except Exception as error:
                failed.append(error)
                raise

        return call

    loop = ControlLoop(
        controller,
        _Endpoint(ending(simulated.read), ending(simulated.write)),
        sp=course.sp[0],
        mv=course.mv0,
        mode=Mode.AUTO,
        recover_after=LIVE_RECOVERY,
        clock=VirtualClock() if speed is None else MonotonicClock(speed),
        warm_lead_s=0.0 if speed is None else WARM_LEAD_S * speed,
        operate=operated.pop(0, None),
    )
    if known is not None:
        loop.set_course(known.points, known.straight)
    followed = np.array([known is not None and s.name in known.points for s in controller.manifest.sp])
    if operated and not controller.manifest.operate:
        loop.set_operate(next(iter(operated.values())))  # raises, before anything has run
    period, n = plant.period_s, len(course.sp)
    marks = {round(at / period): text for at, text in course.marks.items()}

    def before(k: int) -> None:
        # A period that a slow machine missed passed in the plant too, with the MV held.
        while simulated.k < k:
            simulated.write(simulated.mv)
        loop.set_sp(np.where(followed, loop.sp, course.sp[k]))
        if k in operated:
            loop.set_operate(operated[k])
        span = course.manual_at(k * period)
        if span is not None and loop.mode is not Mode.MANUAL:
            loop.set_mode(Mode.MANUAL)
            if span.mv is not None:
                loop.set_mv(span.mv)
        elif span is None and loop.mode is Mode.MANUAL:
            loop.set_mode(Mode.AUTO)
        history.pv.append(simulated.pv)

    def observe(sample: Sample | None, command: Command) -> None:
        k = simulated.k - 1
        assert sample is not None  # a simulated plant can always be read
        history.time_s.append(k * period)
        history.mode.append(command.mode.value)
        history.sp.append(command.sp)
        history.measured.append(sample.pv)
        history.mv.append(command.mv)
        if history.entries:
            history.operate.append(loop.operate)
        history.reason.append(command.fault)
        values = np.concatenate([command.sp, sample.pv, command.mv])
        show(k * period, command.mode.value, values, command.fault, marks.get(k))

    with view_of(plant, title, n * period, sys.stdout) as show:
        loop.run(n, before=ending(before), observe=ending(observe), until=lambda _: len(failed) > 0)
    if failed:
        raise failed[0]
    return history


@dataclass(frozen=True, slots=True)
class KnownCourses:
    """Courses by signal, times from the run's start, and the names of set points that run straight."""

    points: Mapping[str, Points]
    straight: tuple[str, ...] = ()

    def happening(self, manifest: Manifest, run: Timetable, others: Collection[str] = ()) -> Timetable:
        """The run in which measured disturbances become what is forecast, but for the ``others``.

        LoopError for a course that cannot be.
        """
        given = {course.signal: course for course in Courses(manifest).checked(self.points, self.straight)}
        n = len(run.sp)
        nominal = run.plant.dv_nominal
        dv = np.tile(nominal, (n, 1)) if run.dv is None else run.dv.copy()
        for i, s in enumerate(manifest.dv):
            if s.name in given and s.name not in others:
                times: Array = run.plant.period_s * np.arange(n, dtype=np.float64)
                dv[:, i] = given[s.name].begun(0.0, float(dv[0, i])).at(times, float(dv[0, i]))
        return replace(run, dv=dv)


@dataclass(frozen=True)
class _Endpoint:
    read: Callable[[], Sample]
    write: Callable[[Array], None]


def _plant_of(manifest: Manifest) -> tuple[Simulator, Case | None]:
    """The plant that the controller was made for, and its case if it has one."""
    cases = all_cases()
    case = cases.get(manifest.case)
    if case is None and manifest.case not in PLANTS:
        raise ParamsError(
            f"the controller is for {manifest.case!r}, which is neither a case nor a plant here"
            f"{nearest(manifest.case, {*cases, *PLANTS})}"
        )
    plant = PLANTS[manifest.case]() if case is None else case.plant
    require_made_for(manifest, plant)
    return plant, case


def _argument(parse: Callable[[str], object], text: str) -> object:
    """A parser of this package as argparse wants it."""
    try:
        return parse(text)
    except ParamsError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
