"""Perfect-model NMPC and the offline optimum over one closed-loop test.

Both know the plant exactly, its parameters at every sample included, and its whole state; they
minimize the metric, absolute or squared errors, and keep the limits.

NMPC sees the set point of now and no later one, and thinks that it stays; likewise the parameters. Unforeseen ones it
knows of the period before instead, as a perfect observer tells them from what that period did: with those of now, a
disturbance would cost it nothing. The offline optimum takes each set point by itself, from the state where it left the
one before, with the whole course of parameters and ``Effort.tail`` samples more of the same set point, so that it ends
at rest. It does not see the next set point either: with that preview a test of steps gets a lower bound, which no
controller of the tests could use. It is the best of several locally best plans, and its figures are those of its own
prediction. It prepares for a change of parameters and not for the next set point, so that it may come to that one less
well than NMPC does.

A case whose set point follows a recipe is another matter: its controllers may know the course, so
NMPC sees it as far as it looks ahead, and the offline optimum is one plan for the whole test. The
same holds where tracking counts, of the reference in the set point's place.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.case import Effort
from loopwright.pipeline.evaluation.closed_loop import closed_loop_metrics
from loopwright.pipeline.evaluation.metric import METRICS, Metric
from loopwright.pipeline.optimal.nmpc_horizon import Horizon, NmpcPlan
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import noise_draws

Score = Callable[[Scenario, Array, Array], dict[str, float]]
"""Figures of a closed loop, from the test, PVs (n, n_pv) and MVs (n, n_mv): ``Case.score``."""
Limits = Mapping[str, tuple[float, float]]
"""State -> range to keep it in."""

DEFAULT = Effort()
MAE = METRICS["mae"]
CAME_TRUE = 1e-5  # of the states' ranges: how far a prediction may be off


class PerfectNmpc:
    """NMPC whose model is the plant: ``step`` gives the MV for one sample.

    A set point that the last step did not expect starts a fresh search from several rollouts,
    because plans that ignite the reaction at different samples are different local optima; every
    other sample continues the plan of the one before: as it is, for less than ``effort.every``
    samples and while nothing is other than it expected, or solved again from there. A sample at
    which nothing can be solved applies that plan's next move and counts in ``failures``.
    """

    def __init__(
        self, plant: EquationPlant, metric: Metric = MAE, effort: Effort = DEFAULT, limits: Limits | None = None
    ) -> None:
        self.plant, self._every = plant, effort.every
        self._reaches = effort.reaches
        fineness = {"elements": effort.elements, "degree": effort.degree}
        self._horizon = Horizon(plant, effort.periods, metric=metric, limits=limits, **fineness)
        self._simulate = plant.stepper()
        self._span = np.array([s.high - s.low for s in plant.state_signals])
        self.reset()

    def reset(self) -> None:
        """Forget the past: plan, set points and the count of failures."""
        self.failures = 0
        self.age = 0  # samples since the plan was solved
        self.moves: list[Array] = []  # every MV that ``step`` gave
        self._plan: NmpcPlan | None = None
        self._target: Array | None = None
        self._parameters: Array | None = None

    def step(self, x: Array, sp: Array, parameters: Array | None = None) -> Array:
        """The MV, shape (n_mv,), for state ``x`` (n_x,) and set point ``sp`` (n_sp,).

        ``sp`` may also be the course of the set point from the next sample on, shape (m, n_sp),
        whose last row stays. ``parameters`` (n_p,) are the plant's true ones at this sample; by
        default its nominal ones.
        """
        n = self._horizon.n
        course = np.atleast_2d(np.asarray(sp, dtype=np.float64))
        target = course[np.minimum(np.arange(n), len(course) - 1)]
        p = np.tile(self.plant.parameters() if parameters is None else parameters, (n, 1))
        plan, rest = None, None if self._plan is None else self._horizon.shifted(self._plan)
        if rest is not None and self._target is not None and np.array_equal(self._target[1:], target[:-1]):
            plan = rest if self._follow(x, rest, p[0]) else self._horizon.solve(x, target, p, rest)
        self.age = self.age + 1 if plan is not None and plan is rest else 0
        if plan is None or not plan.solved:
            plan = search(self._horizon, x, target, p, self._simulate, self._reaches)
            if not plan.solved:
                self.failures += 1
                plan = rest or plan
        self._plan, self._target, self._parameters = plan, target, p[0]
        self.moves.append(plan.mv[0])
        return plan.mv[0]

    def _follow(self, x: Array, rest: NmpcPlan, p: Array) -> bool:
        """Whether the rest of the last plan still stands: young, and neither state nor parameters surprise it."""
        young = self.age + 1 < self._every and rest.solved
        expected = self._parameters is not None and np.array_equal(self._parameters, p)
        return young and expected and bool(np.all(np.abs(x - rest.x[0]) <= CAME_TRUE * self._span))


def search(
    horizon: Horizon,
    x: Array,
    sp: Array,
    p: Array,
    simulate: Callable[..., Array],
    reaches: Sequence[int] = DEFAULT.reaches,
    moves: Array | None = None,
) -> NmpcPlan:
    """The best plan from several rollouts; the best rollout itself where none was solved.

    ``moves`` (m, n_mv) are one more start: what another controller did over the first m periods.
    """
    starts = [horizon.rollout(x, sp, p, reach, simulate) for reach in reaches]
    if moves is not None:
        replayed = horizon.rollout(x, sp, p, reaches[0], simulate, moves)
        starts += [replayed] if np.isfinite(replayed.values).all() else []
    plans = [horizon.solve(x, sp, p, start) for start in starts]
    return min([plan for plan in plans if plan.solved] or starts, key=lambda plan: plan.cost)


def run_nmpc(
    nmpc: PerfectNmpc,
    scenario: Scenario,
    noise_std: Sequence[float] | None = None,
    seed: int = 0,
    recipe: bool = False,
    unforeseen: bool = False,
    score: Score | None = None,
) -> dict[str, float]:
    """Closed-loop metrics of the NMPC, its failures and its processor time a step that solves anew.

    The noise, one standard deviation a PV, reaches only the NMPC, which has no filter. With
    ``recipe`` it sees the set points to come, or those of the reference where there is one;
    ``unforeseen`` parameters it knows one sample late, the first ones from the start. ``score``
    gives the metrics, those of ``closed_loop_metrics`` by default. Raises PlantError for noise on a
    plant whose PVs are not its states.
    """
    plant = nmpc.plant
    if noise_std is None:
        noise = np.zeros((scenario.samples, len(scenario.x0)))
    elif plant.measures_states:
        noise = noise_draws(plant, scenario.samples, noise_std, np.random.default_rng(seed))
    else:
        raise PlantError(f"plant {plant.name!r} measures other things than its states; its NMPC cannot be given noise")
    nmpc.reset()
    simulate, parameters = plant.stepper(), scenario.parameters(plant)
    known = parameters[np.maximum(np.arange(scenario.samples) - unforeseen, 0)]
    course = _course(scenario, recipe)
    x, states, mv, times = scenario.x0, [], [], []
    for k, (p, error) in enumerate(zip(parameters, noise, strict=True)):
        sp = course[min(k + 1, scenario.samples - 1) :] if recipe else course[k]
        states.append(x)
        begun = time.process_time()
        mv.append(nmpc.step(x + error, sp, known[k]))
        if not nmpc.age:
            times.append(1e3 * (time.process_time() - begun))
        x = simulate(x, mv[-1], plant.dv_nominal, p)
    figures = _figures(plant, scenario, np.array(states), np.array(mv), score) | {"failures": float(nmpc.failures)}
    return figures | {f"step_ms_p{q}": float(np.percentile(times, q)) for q in (50, 99)}


def run_offline(
    plant: EquationPlant,
    scenario: Scenario,
    metric: Metric = MAE,
    recipe: bool = False,
    effort: Effort = DEFAULT,
    score: Score | None = None,
    limits: Limits | None = None,
    moves: Array | None = None,
) -> dict[str, float]:
    """Closed-loop metrics of the offline optimum, and how many of its plans were not solved.

    There is one plan for every stretch of equal set points, or a single one for a ``recipe``, which ends with
    its last sample. Each is also searched from ``moves`` (n, n_mv), a controller's over the same test such as
    ``PerfectNmpc.moves``, so that it need not be worse than what is known to be feasible.
    """
    course = _course(scenario, recipe)
    edges = [0] if recipe else [0, *np.flatnonzero(np.any(np.diff(scenario.sp, axis=0) != 0, axis=1)) + 1]
    lengths = np.diff([*edges, scenario.samples])
    n = int(lengths.max()) + (0 if recipe else effort.tail)
    horizon = Horizon(plant, n, metric=metric, limits=limits, elements=effort.fine, degree=effort.degree)
    everything, simulate = scenario.parameters(plant), plant.stepper()
    x, states, mv, failures = scenario.x0, [], [], 0
    for k, length in zip(edges, lengths, strict=True):
        ahead = k + np.arange(horizon.n)
        target = course[np.minimum(ahead + 1, k + length - 1)]
        p = everything[np.minimum(ahead, scenario.samples - 1)]
        known = None if moves is None else moves[k : k + length]
        plan = search(horizon, x, target, p, simulate, effort.reaches, known)
        failures += not plan.solved
        states.append(plan.x[:length])
        mv.append(plan.mv[:length])
        x = plan.x[length]
    return _figures(plant, scenario, np.vstack(states), np.vstack(mv), score) | {"failures": float(failures)}


def _course(scenario: Scenario, recipe: bool) -> Array:
    """The course that the CV should take: the set point, or the reference where that is known in advance."""
    return scenario.sp if scenario.reference is None or not recipe else scenario.reference


def _figures(plant: EquationPlant, scenario: Scenario, x: Array, mv: Array, score: Score | None) -> dict[str, float]:
    pv, actual = plant.measured(x), plant.actual(mv)
    if score is not None:
        return score(scenario, pv, actual)
    span = plant.sp_signals[0].high - plant.sp_signals[0].low
    return closed_loop_metrics(scenario.sp, pv, actual, scenario.hold, plant.period_s, span, scenario.late_from)
