"""Steps of a controller for a host to repeat: from the states of a chain of 300, cold, and with inputs to refuse.

A law that reads ``operate`` and ``fresh`` gets values of both that vary over the steps, and one that reads ``ahead``
steps and ramps to come.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from math import inf, nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Controller, Step
from loopwright.serving.errors import OutputError, SampleError
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.operating import Operate
from loopwright.serving.preview.ahead import AheadInput
from loopwright.serving.preview.differences import Differences

Array: TypeAlias = NDArray[np.float64]

OUTPUTS = ("mv", "state_next", "info")

COURSE_STEP = 0.03  # share of a range that an input moves at most from step to step while it follows a course
COLD_STARTS = 10  # cold starts that a host repeats, each with two steps after it
STEP_DRAWS = 40  # tried for a step whose MV lies inside its range
NUDGE = 1e-12  # share of an entry of the state by which a run beside the chain is off: far above rounding's 2e-16
AT_AN_END = 0.1  # share of the values drawn anywhere that lie at an end of the range
STEERED = 0.5  # share of the entries of `operate` that are not the default: at all others a loop would hardly move
STEERED_ANEW = 0.1  # probability a step of a course that operators change something
UNFRESH = 0.2  # share of the readings that are not fresh
NOTHING_TO_COME = 0.2  # share of the steps whose `ahead` is zeros, as of a host that gives none
STEPPED = 0.5  # share of the signals that step within the horizon; the others run straight


@dataclass(frozen=True, slots=True)
class StepInputs:
    """The inputs of one step without the state. ``cold``: it starts from a state of zeros, else from the last one."""

    part: str
    inputs: dict[
        str, Array
    ]  # sp (n_sp,), pv (n_pv,), dv (n_dv,), mv_applied (n_mv,); operate, fresh, ahead where they are read
    cold: bool = False


@dataclass(frozen=True, slots=True)
class StepResult:
    """The result of one step from ``state`` (n_state,); a step that is refused says why: input or output."""

    given: StepInputs
    state: Array
    step: Step | None
    refused: str = ""


def answered(controller: Controller) -> list[StepResult]:
    """All steps of the kit, as this runtime answers them; a refused step leaves the state as it was."""
    state, last, answers = controller.cold_state(), _middle(controller.manifest.mv), []
    drawn, steering = _drawn(controller.manifest), _Steering(controller.manifest)
    choices = next(drawn)
    while True:
        for given in map(steering.joined, choices):
            answer = _answer(controller, given, state)
            if answer.step is not None and _inside(controller.manifest.mv, answer.step.mv):
                break
        answers.append(answer)
        if answer.step is not None:
            state, last = answer.step.state, answer.step.mv
        try:
            choices = drawn.send((answer.given, last))
        except StopIteration:
            return answers


def beginnings(
    controller: Controller, answers: list[StepResult], scale: Mapping[str, Array], most: float
) -> list[bool]:
    """Whether a chained run takes the given state at each step: at the cold ones, and where last digits grew too far.

    A second run goes beside the answers and nudges each state that it carries on. Where it would part by more than
    ``most`` nudges of the entries' ``scale``, the chain begins again from the given state. So a host that is right in
    each step parts by about ``most`` times its difference at the most, whatever the law.
    """
    rng, state, begins = np.random.default_rng(2), controller.cold_state(), []
    divisors = np.concatenate([scale[name] for name in OUTPUTS])

    def beside(answer: StepResult, begin: Array) -> tuple[float, Array]:
        """How many nudges the step from about this state parts from the answer, and the state that follows."""
        step = _answer(controller, answer.given, _nudged(rng, begin)).step
        if answer.step is None or step is None:
            return (0.0 if step is answer.step else inf), begin
        shares = np.abs(np.concatenate(step) - np.concatenate(answer.step)) / divisors
        return float(shares.max()) / NUDGE, step.state

    for answer in answers:
        parted, after = beside(answer, state)
        begins.append(answer.given.cold or parted > most)
        state = beside(answer, answer.state)[1] if begins[-1] else after
    return begins


def _nudged(rng: np.random.Generator, state: Array) -> Array:
    """The state (n_state,) with other last digits; whole numbers stay, since flags and counters have none."""
    signs = rng.choice([-1.0, 1.0], state.shape)
    return np.where(state == np.rint(state), state, state * (1 + NUDGE * signs))


def _answer(controller: Controller, given: StepInputs, state: Array) -> StepResult:
    begin = controller.cold_state() if given.cold else state
    try:
        step = controller.step(**given.inputs, state=begin)
    except SampleError:
        return StepResult(given, begin, None, "input")
    except OutputError:
        return StepResult(given, begin, None, "output")
    return StepResult(given, begin, step)


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
    for name in (n for n in m.inputs if n in signals):
        for i in range(len(signals[name])):
            for bad in (nan, inf, -inf):
                spoilt = course[name].copy()
                spoilt[i] = bad
                yield [StepInputs("not finite", course | {name: spoilt})]
                course = moved(course)  # at a rest, a state that was lost would look like the one that was kept
                _, last = yield [StepInputs("after a refusal", course | {"mv_applied": last})]


WITHOUT_PAST = frozenset({"anywhere", "inside", "cold start"})  # parts whose steps have nothing to do with each other


@dataclass(slots=True)
class _Steering:
    """``operate`` and ``fresh`` of the steps, for a law that reads them: by default at first, then valid values.

    It draws from numbers of its own, so that the steps of all other laws stay as they were.
    """

    manifest: Manifest
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(3))
    known: np.random.Generator = field(default_factory=lambda: np.random.default_rng(4))
    at: Array | None = None

    def joined(self, given: StepInputs) -> StepInputs:
        """``given`` and the values of its step."""
        if "ahead" in self.manifest.inputs and self.manifest.ahead is not None:
            given = replace(given, inputs=given.inputs | {"ahead": self._to_come(self.manifest.ahead, given)})
        if not {"operate", "fresh"} & set(self.manifest.inputs):
            return given
        if self.at is None:
            self.at = np.array(self.manifest.usual("operate"))
        elif given.part in WITHOUT_PAST or self.rng.uniform() < STEERED_ANEW:
            self.at = Operate(self.manifest.operate).drawn(self.rng, STEERED)
        fresh = (self.rng.uniform(size=len(self.manifest.pv)) >= UNFRESH).astype(np.float64)
        values = {"operate": self.at, "fresh": fresh}
        return replace(given, inputs=given.inputs | {n: v for n, v in values.items() if n in self.manifest.inputs})

    def _to_come(self, ahead: AheadInput, given: StepInputs) -> Array:
        """Set points and disturbances that step or run straight to a value within their ranges; zeros by and by."""
        rng, n = self.known, len(ahead.signals)
        present = np.concatenate([given.inputs["sp"], given.inputs["dv"]])
        present = np.where(np.isfinite(present), present, 0.0)  # of a step that is refused for it
        target = np.array([rng.uniform(s.low, s.high) for s in ahead.signals])
        at, begin = np.arange(1, ahead.horizon + 1)[:, None], rng.integers(1, ahead.horizon + 1, n)
        share = np.where(rng.uniform(size=n) < STEPPED, at >= begin, at / ahead.horizon)
        change = share * (target - present) * (rng.uniform() >= NOTHING_TO_COME)
        return Differences(ahead).within(change, present)


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
