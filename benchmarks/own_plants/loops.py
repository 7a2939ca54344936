"""The tests of a plant, and closed loops of laws over it, all tests side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from plant import OwnPlant
from torch import Tensor

from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.scenario import Scenario

HELD_OUT = (71, 72, 73)
LEVELS = 8
LOAD = 10.0  # [%] of an MV's range
UPSET = 0.1  # of a set point's range
UPSET_LAG = 0.1  # of a hold: time constant with which an upset reaches its output


@dataclass(frozen=True, slots=True)
class Score:
    """Of loops: error [% of the set points' range], error at the end of each hold, and MV travel [% a sample]."""

    nmae: float
    end: float
    travel: float


@dataclass(frozen=True, slots=True)
class LoopTest:
    """A scenario, and what is added to the outputs (n, n_cv) beside the plant."""

    scenario: Scenario
    upset: Array


def tests_of(plant: OwnPlant) -> dict[str, list[LoopTest]]:
    """Random set points; and at each of three set points, loads that come and go, one after another.

    ``loads`` are 10 % of each MV's range, at the MV. ``upsets`` are 10 % of each set point's range, and reach the
    output through a lag of their own, which neither the model nor the law knows.
    """
    hold = plant.hold
    sequences, loads, upsets = [], [], []
    for seed in HELD_OUT:
        rng = np.random.default_rng(seed)
        levels = plant.set_points(rng, LEVELS)
        sequences.append(_test(plant, "set points", np.repeat(levels, hold, axis=0), {}, rng, seed))
        level = plant.set_points(rng, 1, inner=0.2)
        names, changes = plant.load_names(), {}
        for i, name in enumerate(names):
            course = [0.0] * 5
            for j in range(len(names)):
                course += [LOAD * (i == j)] * hold + [0.0] * hold + [-LOAD * (i == j)] * hold
            changes[name] = np.array(course)
        n = len(changes[names[0]])
        loads.append(_test(plant, "loads", np.repeat(level, n, axis=0), changes, rng, seed))
        course = _upset(plant)
        still = np.repeat(level, len(course), axis=0)
        upset = _test(plant, "upsets", still, {}, rng, seed)
        upsets.append(LoopTest(upset.scenario, course))
    return {"set points": sequences, "loads": loads, "upsets": upsets}


def _upset(plant: OwnPlant) -> Array:
    """Up, back, down and back again of one output after the other, each step through a lag (n, n_cv)."""
    hold, span = plant.hold, np.array([s.high - s.low for s in plant.sp_signals])
    levels = [size * span * each for each in np.eye(len(span)) for size in (UPSET, 0.0, -UPSET, 0.0)]
    steps = np.concatenate([np.zeros((5, len(span))), np.repeat(np.array(levels), hold, axis=0)])
    lag = 1 - np.exp(-1 / (UPSET_LAG * hold))
    course = np.zeros_like(steps)
    for k in range(1, len(steps)):
        course[k] = course[k - 1] + lag * (steps[k] - course[k - 1])
    return course


def _test(
    plant: OwnPlant, name: str, sp: Array, changes: dict[str, Array], rng: np.random.Generator, seed: int
) -> LoopTest:
    drift = plant.drift(len(sp), rng)
    first = plant.with_parameters({key: float(values[0]) for key, values in drift.items()})
    scenario = Scenario(name, "", sp, *first.rest(sp[0]), changes=changes | drift, hold=plant.hold, seed=seed)
    return LoopTest(scenario, np.zeros_like(sp))


def noise_of(plant: OwnPlant, scenario: Scenario) -> Array:
    """The measurement noise (n, n_pv) of a test, by its seed."""
    draws = np.random.default_rng((scenario.seed or 0) + 1).standard_normal((scenario.samples, len(plant.pv_signals)))
    return draws * plant.noise_std


class Steps(Protocol):
    """What closes a loop: a law, or what steps as one."""

    n_state: int

    def __call__(self, sp: Tensor, pv: Tensor, dv: Tensor, mv: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""


@torch.no_grad()
def closed(laws: Steps, plant: OwnPlant, tests: list[LoopTest], count: int | None = None) -> tuple[Array, Array]:
    """True outputs (count, tests, n, n_cv) and MVs (count, tests, n, n_mv); without a count those of one law.

    ``laws`` are ``count`` laws side by side. Measurement noise by each test's seed, the same for all laws.
    """
    scenarios = [t.scenario for t in tests]
    c, b, n = count or 1, len(tests), scenarios[0].samples
    n_pv, n_mv = len(plant.pv_signals), len(plant.mv_signals)
    noise = np.stack([noise_of(plant, t) for t in scenarios])
    p = np.stack([t.parameters(plant) for t in scenarios])  # (b, n, n_p)
    advance = plant.transition.map(c * b)
    x = np.tile(np.stack([t.x0 for t in scenarios]), (c, 1))  # (c b, n_x)
    mv = torch.from_numpy(np.tile(np.stack([t.mv0 for t in scenarios]), (c, 1, 1)))
    state = torch.zeros(c, b, laws.n_state, dtype=torch.float64)
    dv = torch.from_numpy(np.stack([plant.known(t) for t in scenarios]))
    sp = torch.from_numpy(np.stack([t.sp for t in scenarios]))
    upset = np.stack([t.upset for t in tests])
    y, u = np.empty((c, b, n, n_pv)), np.empty((c, b, n, n_mv))
    for k in range(n):
        y[:, :, k] = plant.measured(x).reshape(c, b, n_pv) + upset[:, k]
        pv = torch.from_numpy(y[:, :, k] + noise[:, k])
        wanted, known = (v[:, k].expand(c, -1, -1) for v in (sp, dv))
        if count is None:
            one, after, _ = laws(wanted[0], pv[0], known[0], mv[0], state[0])
            mv, state = one[None], after[None]
        else:
            mv, state, _ = laws(wanted, pv, known, mv, state)
        u[:, :, k] = mv.numpy()
        table = np.tile(p[:, k], (c, 1))
        x = np.array(advance(x.T, u[:, :, k].reshape(c * b, n_mv).T, np.zeros((0, c * b)), table.T)).T
    return y, u


def scores(plant: OwnPlant, tests: list[LoopTest], y: Array, u: Array) -> Score:
    """Of loops with outputs y (tests, n, n_cv) and MVs u (tests, n, n_mv)."""
    span = np.array([s.high - s.low for s in plant.sp_signals])
    error = np.abs(y - np.stack([t.scenario.sp for t in tests])) / span
    late = np.arange(error.shape[1]) % plant.hold >= plant.hold - 5
    reach = np.array([s.high - s.low for s in plant.mv_signals])
    travel = np.abs(np.diff(u, axis=1)) / reach
    return Score(*(100 * float(part.mean()) for part in (error, error[:, late], travel)))


def scored(law: Steps, plant: OwnPlant) -> dict[str, Score]:
    """The scores of one law, by test."""
    found = {}
    for name, tests in tests_of(plant).items():
        y, u = closed(law, plant, tests)
        found[name] = scores(plant, tests, y[0], u[0])
    return found
