"""Steps of a controller for a host to repeat: a chain of 300, cold starts, and inputs to refuse."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from math import inf, nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Controller, Step
from loopwright.serving.errors import OutputError, SampleError
from loopwright.serving.manifest import SENSITIVE, Manifest, Signal

Array: TypeAlias = NDArray[np.float64]

COURSE_STEP = 0.03  # share of a range that an input moves at most from step to step while it follows a course
COLD_STARTS = 10  # cold starts that a host repeats, each with two steps after it
STEP_DRAWS = 40  # tried for a step whose MV lies inside its range
AT_AN_END = 0.1  # share of the values drawn anywhere that lie at an end of the range


@dataclass(frozen=True, slots=True)
class StepInputs:
    """The inputs of one step without the state. ``cold``: it starts from a state of zeros, else from the last one."""

    part: str
    inputs: dict[str, Array]  # sp (n_sp,), pv (n_pv,), dv (n_dv,), mv_applied (n_mv,)
    cold: bool = False


@dataclass(frozen=True, slots=True)
class StepResult:
    """The result of one step; where it is refused, ``refused`` says because of the input or of the output."""

    given: StepInputs
    step: Step | None
    refused: str = ""


def answered(controller: Controller) -> list[StepResult]:
    """All steps of the kit, as this runtime answers them; a refused step leaves the state as it was.

    A law that amplifies rounding starts from zeros again long before two right hosts part.
    """
    state, last, answers = controller.cold_state(), _middle(controller.manifest.mv), []
    parts_after = controller.manifest.provenance.get(SENSITIVE)
    longest = max(int(parts_after) // 4, 1) if isinstance(parts_after, int) else None
    since = 0
    drawn = _drawn(controller.manifest)
    choices = next(drawn)
    while True:
        again = longest is not None and since >= longest
        for choice in choices:
            given = replace(choice, cold=True) if again else choice
            answer = _answer(controller, given, state)
            if answer.step is not None and _inside(controller.manifest.mv, answer.step.mv):
                break
        answers.append(answer)
        if answer.step is not None:
            state, last = answer.step.state, answer.step.mv
            since = 1 if answer.given.cold else since + 1
        try:
            choices = drawn.send((answer.given, last))
        except StopIteration:
            return answers


def _answer(controller: Controller, given: StepInputs, state: Array) -> StepResult:
    try:
        step = controller.step(**given.inputs, state=controller.cold_state() if given.cold else state)
    except SampleError:
        return StepResult(given, None, "input")
    except OutputError:
        return StepResult(given, None, "output")
    return StepResult(given, step)


def _inside(signals: tuple[Signal, ...], mv: Array) -> bool:
    """Whether each continuous MV (n_mv,) lies inside its range: at an end, a wrong digit would not show."""
    return all(s.values is not None or s.low < value < s.high for s, value in zip(signals, mv.tolist(), strict=True))


def _drawn(m: Manifest) -> Generator[list[StepInputs], tuple[StepInputs, Array], None]:
    """Choices of inputs for each step: the first with an MV inside its range is taken, or the last.

    ``send`` takes what was taken and the last MV (n_mv,), which is the applied one of most steps.
    """
    rng = np.random.default_rng(0)
    signals = {name: m.signals(name) for name in ("sp", "pv", "dv", "mv_applied")}

    def anywhere() -> dict[str, Array]:
        return {name: _anywhere(rng, of) for name, of in signals.items()}

    def moved(old: dict[str, Array]) -> dict[str, Array]:
        return {name: _moved(rng, old[name], of) for name, of in signals.items()}

    last = _middle(m.mv)
    for k in range(60):
        _, last = yield [StepInputs("anywhere", anywhere() | ({"mv_applied": last} if k % 3 else {}), cold=k == 0)]
    for _ in range(60):
        taken, last = yield [StepInputs("inside", anywhere() | {"mv_applied": last}) for _ in range(STEP_DRAWS)]
    course = taken.inputs
    for k in range(80):
        course = moved(course) | {"sp": course["sp"]}
        if k % 20 == 19:
            course["sp"] = _anywhere(rng, m.sp)
        _, last = yield [StepInputs("course", course | {"mv_applied": last})]
    low, high = ({name: _ends(of)[end] for name, of in signals.items()} for end in (0, 1))
    for k in range(50):
        one, other = (low, high) if k < 25 else (high, low)
        _, last = yield [StepInputs("saturation", {**low, "sp": one["sp"], "pv": other["pv"], "mv_applied": last})]
    stuck = _anywhere(rng, m.mv)
    for _ in range(50):
        course = moved(course)
        _, last = yield [StepInputs("stuck actuator", course | {"mv_applied": stuck})]
    for k in range(3 * COLD_STARTS):
        _, last = yield [StepInputs("cold start", anywhere(), cold=k % 3 == 0) for _ in range(STEP_DRAWS)]
    for name in (n for n in m.inputs if n != "state"):
        for i in range(len(signals[name])):
            for bad in (nan, inf, -inf):
                spoilt = course[name].copy()
                spoilt[i] = bad
                yield [StepInputs("not finite", course | {name: spoilt})]
                _, last = yield [StepInputs("after a refusal", course | {"mv_applied": last})]


def _anywhere(rng: np.random.Generator, signals: tuple[Signal, ...]) -> Array:
    """A value anywhere in each range (n,), some at its ends; of a discrete signal one of its values."""
    values = []
    for s in signals:
        value = rng.choice([s.low, s.high]) if rng.uniform() < AT_AN_END else rng.uniform(s.low, s.high)
        values.append(value if s.values is None else rng.choice(s.values))
    return np.array(values, dtype=np.float64)


def _moved(rng: np.random.Generator, old: Array, signals: tuple[Signal, ...]) -> Array:
    """``old`` (n,) moved a little within each range; a discrete signal stays."""
    moved = [
        min(max(value + COURSE_STEP * rng.uniform(-1, 1) * (s.high - s.low), s.low), s.high)
        if s.values is None
        else value
        for value, s in zip(old.tolist(), signals, strict=True)
    ]
    return np.array(moved, dtype=np.float64)


def _middle(signals: tuple[Signal, ...]) -> Array:
    return np.array([s.middle for s in signals], dtype=np.float64)


def _ends(signals: tuple[Signal, ...]) -> tuple[Array, Array]:
    """Both ends (n,) of each range; of a discrete signal its first and last value."""
    ends = [(s.low, s.high) if s.values is None else (s.values[0], s.values[-1]) for s in signals]
    low, high = np.array(ends, dtype=np.float64).reshape(-1, 2).T
    return low.copy(), high.copy()
