"""Trials of a file in tests in which operators steer it by more than set points: loops, figures, curves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from loopwright.pipeline.cases.operated_tests import OperatedTest, operated_tests
from loopwright.pipeline.cases.operator_asks import best_rest
from loopwright.pipeline.config.operator_tests import OperatedTestParams
from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.evaluation.closed_loop import RANGE_BAND
from loopwright.pipeline.evaluation.operated import ErrorResult, MvResult, OperatedLoop, OperatedResult, RangeResult
from loopwright.pipeline.evaluation.ranges_kept import (
    beyond,
    borne_by_last,
    gain_share,
    mv_travel_from,
    profit,
    rest_miss,
    share_clamped,
)
from loopwright.pipeline.evaluation.trials import close_loop
from loopwright.pipeline.optimal.economic import BestRest
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.simulation.operator_changes import OperatedCourse
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.serving.controller import Controller
from loopwright.serving.manifest import Signal

LATE_PART = (
    3  # of the time since anything last changed, the last such part is its end: two thirds are for getting there
)
OPERATED_NOISE = 200_000  # added to the noise's seed: other draws than those of the other tests

Curves = dict[str, Array]


def try_operated(
    case: Case, noise_seed: int, file: Path, own: Mapping[str, OperatedTestParams], label: str
) -> tuple[dict[str, OperatedResult], Curves]:
    """Results of a file by test, and the curves of the loop of each that was outside longest; empty without operate.

    Readings have noise; figures are of the true values. ParamsError for a test of params.yaml that cannot be.
    """
    trials = OperatedTrials(case, noise_seed, file, own)
    work = [(name, i) for name, test in trials.tests.items() for i in range(len(test.sequences))]
    if not work:
        return {}, {}
    samples = [float(trials.tests[name].sequences[i].samples) for name, i in work]
    ran = dict(zip(work, parallel_map(trials.run, work, label, samples, in_folder=True), strict=True))
    results, curves = dict[str, OperatedResult](), Curves()
    for name, test in trials.tests.items():
        loops = [ran[name, i] for i in range(len(test.sequences))]
        results[name] = OperatedResult(test.sequences[0].title, tuple(loop for loop, _ in loops), test.limits)
        worst = max(range(len(loops)), key=lambda i: max((r.outside for r in loops[i][0].ranges), default=0.0))
        curves |= {f"{name}/{field}": values for field, values in loops[worst][1].items()}
    return results, curves


@dataclass(frozen=True)
class OperatedTrials:
    """The closed loops of one file over the tests of operators' changes."""

    case: Case
    noise_seed: int
    file: Path
    own: Mapping[str, OperatedTestParams]

    @cached_property
    def controller(self) -> Controller:
        """The file, opened once a process."""
        return Controller(self.file)

    @cached_property
    def tests(self) -> dict[str, OperatedTest]:
        """The tests by name, made once a process: their rests take their time."""
        return operated_tests(self.case, self.controller.manifest.operate, self.own)

    def __getstate__(self) -> dict[str, object]:
        """All but what a process makes for itself."""
        kept = ("case", "noise_seed", "file", "own")
        return {name: value for name, value in vars(self).items() if name in kept}

    def run(self, piece: tuple[str, int]) -> tuple[OperatedLoop, Curves]:
        """The loop of one sequence of a test: its figures, and its curves."""
        name, place = piece
        test, case = self.tests[name].sequences[place], self.case
        plant = test.plant or case.plant
        loop = close_loop(self.controller, plant, test, case.noise_std, self.noise_seed + OPERATED_NOISE + place)
        course = test.operated(self.controller.manifest.operate)
        assert course is not None
        out = {s.name: _use(course, s) == 0 for s in plant.mv_signals}
        best = best_rest(test, course, loop.mv[-1])
        return figures_of(case, test, course, loop, best), curves_of(plant, course, loop, out)


def figures_of(
    case: Case, test: Scenario, course: OperatedCourse, loop: Trajectory, best: BestRest | None
) -> OperatedLoop:
    """All figures of one loop, each where operators asked for what it tells; see ``OperatedLoop``."""
    plant, n, period = test.plant or case.plant, test.samples, case.plant.period_s
    first, late = _first_and_late(test, course)
    noise = case.noise_std
    ranges = [
        found
        for i, s in enumerate(plant.pv_signals)
        if (found := _range(i, s, course, loop, first, late, float(noise[i]), best)) is not None
    ]
    mvs = [_mv(j, s, course, loop, test, first, late) for j, s in enumerate(plant.mv_signals)]
    y_cost, u_cost = (
        np.array([course.at(s.name, "cost", 0.0) for s in of]) for of in (plant.pv_signals, plant.mv_signals)
    )
    made = before = optimum = gain = None
    if np.any(y_cost) or np.any(u_cost):
        y0 = plant.measure(test.x0)
        made = profit(loop.pv[late:], loop.mv[late:], y_cost, u_cost, period)
        before = profit(y0[None], test.mv0[None], y_cost, u_cost, period)
        if best is not None:
            optimum = profit(best.y[None], best.mv[None], y_cost, u_cost, period)
            gain = gain_share(made, before, optimum)
    return OperatedLoop(
        n * period,
        late * period,
        tuple(ranges),
        tuple(mvs),
        _errors(case, test, course, loop, late, best),
        made,
        before,
        optimum,
        gain,
        _borne(plant, ranges, loop, course, late),
        int(loop.info[:, -1].sum()),
    )


def _first_and_late(test: Scenario, course: OperatedCourse) -> tuple[int, int]:
    """(sample of the first change by operators, sample from which the end of the test counts)."""
    courses = [test.sp, *test.changes.values(), *([] if test.dv is None else [test.dv])]
    moved = [np.flatnonzero(np.any(np.diff(of.reshape(test.samples, -1), axis=0), axis=1)) + 1 for of in courses]
    changed = course.changed()
    last = max((int(of[-1]) for of in (changed, *moved) if len(of)), default=0)
    return (int(changed[0]) if len(changed) else 0), last + math.ceil((test.samples - last) * (1 - 1 / LATE_PART))


def _range(
    i: int, s: Signal, course: OperatedCourse, loop: Trajectory, first: int, late: int, noise: float,
    best: BestRest | None,
) -> RangeResult | None:  # fmt: skip
    """A PV in its range; None where it has none narrower than the engineered one at the end, or is out of use."""
    low, high, use = (course.of_signal(s.name, what) for what in ("low", "high", "use"))
    if low is None or high is None or use is None or not use[-1]:
        return None
    ends = {e.what: (e.low, e.high) for e in course.entries if e.signal == s.name}
    if low[-1] <= ends["low"][0] and high[-1] >= ends["high"][1]:
        return None
    hidden = max(noise, RANGE_BAND * (s.high - s.low))
    out = beyond(loop.pv[:, i], low, high) * (use > 0)
    since = out[first:]
    return RangeResult(
        s.name,
        s.unit,
        float(low[-1]),
        float(high[-1]),
        course.at(s.name, "rank", 0.0),
        float(np.mean(since > hidden)),
        float(np.mean(out[late:] > hidden)),
        float(np.mean(since)),
        float(np.max(since)),
        hidden,
        None if best is None else float(best.outside[i]),
    )


def _use(course: OperatedCourse, s: Signal) -> Array:
    found = course.of_signal(s.name, "use")
    return np.ones(len(course.values)) if found is None else found


def _mv(j: int, s: Signal, course: OperatedCourse, loop: Trajectory, test: Scenario, first: int, late: int) -> MvResult:
    """An MV: travel, time at an operator's limit, moves while it is out, distance from its resting value."""
    mv, width = loop.mv[:, j], s.high - s.low
    low, high, rests, wanted = (course.of_signal(s.name, what) for what in ("low", "high", "rest_use", "rest"))
    out = _use(course, s) == 0
    moves = np.abs(np.diff(mv, prepend=test.mv0[j]))
    clamped = 0.0
    if low is not None and high is not None:
        clamped = share_clamped(mv[first:], low[first:], high[first:], (s.low, s.high))
    rest = float(wanted[-1]) if rests is not None and wanted is not None and rests[-1] and not out[-1] else None
    miss = None if rest is None else rest_miss(mv, rest, len(mv) - late)
    travel = float(mv_travel_from(mv, test.mv0[j])[0])
    return MvResult(
        s.name,
        s.unit,
        travel,
        travel / width,
        clamped,
        float(np.max(moves[out])) / width if out.any() else None,
        rest,
        miss,
        None if miss is None else miss / width,
    )


def _errors(
    case: Case, test: Scenario, course: OperatedCourse, loop: Trajectory, late: int, best: BestRest | None
) -> tuple[ErrorResult, ...]:
    """Each PV that follows a set point to the end: its mean distance from where the best steady state has it."""
    plant, found = test.plant or case.plant, []
    for i, s in enumerate(plant.sp_signals):
        if not (course.at(s.name, "track", 0.0) and course.at(s.name, "use", 0.0)):
            continue
        low, high = course.at(s.name, "low", s.low), course.at(s.name, "high", s.high)
        wanted = float(np.clip(test.sp[-1, i], low, high)) if best is None else float(best.y[i])
        error = abs(float(np.mean(loop.pv[late:, i])) - wanted)
        found.append(ErrorResult(s.name, s.unit, error, error / float(case.asked[i])))
    return tuple(found)


def _borne(
    plant: Simulator, ranges: list[RangeResult], loop: Trajectory, course: OperatedCourse, late: int
) -> float | None:
    """Share of the violation that the last rank bears; None unless even the best steady state violates a range."""
    if not any(one.least for one in ranges):
        return None
    widths = {s.name: (i, s.high - s.low) for i, s in enumerate(plant.pv_signals)}
    violations = {}
    for one in ranges:
        i, width = widths[one.signal]
        low, high = (course.of_signal(one.signal, end) for end in ("low", "high"))
        assert low is not None
        assert high is not None
        violations[one.signal] = float(np.mean(beyond(loop.pv[late:, i], low[late:], high[late:]))) / width
    return borne_by_last(violations, {one.signal: one.rank for one in ranges})


def curves_of(plant: Simulator, course: OperatedCourse, loop: Trajectory, out: Mapping[str, Array]) -> Curves:
    """The loop for a picture: arrays (n, ...) with the ranges of PVs and MVs; NaN where a signal has none."""

    def ends(signals: tuple[Signal, ...], end: str) -> Array:
        found = [course.of_signal(s.name, end) for s in signals]
        return np.column_stack([np.full(len(loop.pv), np.nan) if of is None else of for of in found])

    def of_pv(what: str) -> Array:
        found = [course.of_signal(s.name, what) for s in plant.pv_signals]
        return np.column_stack([np.zeros(len(loop.pv)) if of is None else of for of in found])

    rest = [
        None if (on := course.of_signal(s.name, "rest_use")) is None else np.where(on > 0, 1.0, np.nan)
        for s in plant.mv_signals
    ]
    wanted = [course.of_signal(s.name, "rest") for s in plant.mv_signals]
    rests = [
        np.full(len(loop.mv), np.nan) if a is None or b is None else a * b for a, b in zip(rest, wanted, strict=True)
    ]
    return {
        "time_s": loop.time_s,
        "sp": loop.sp,
        "pv": loop.pv,
        "mv": loop.mv,
        "low": ends(plant.pv_signals, "low"),
        "high": ends(plant.pv_signals, "high"),
        "use": of_pv("use"),
        "track": of_pv("track"),
        "mv_low": ends(plant.mv_signals, "low"),
        "mv_high": ends(plant.mv_signals, "high"),
        "out": np.column_stack([out[s.name].astype(np.float64) for s in plant.mv_signals]),
        "rest": np.column_stack(rests),
    }
