"""How params.yaml asks for a local model network, and how well it follows its plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.metrics import fit_percent
from loopwright.pipeline.models.base import Model, simulate
from loopwright.pipeline.models.local_models import LocalModels
from loopwright.pipeline.models.part import Learnt, Part, Source
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.plants.steady import Linearization
from loopwright.pipeline.simulation.simulate import simulate_open

STEADY_POINTS = 121  # MVs at which the network's steady state is compared with the plant's
REST_PERIODS = 1_500  # simulated until it counts as steady


@dataclass(frozen=True, kw_only=True)
class LocalModelsPart(Part):
    """The plant's own equations, linearized at some steady states; needs no data.

    ``points`` are the operating points, each by the value of one signal, an MV or a PV.
    ``overlap`` is the width of a validity function over the mean distance to its neighbours.
    The network's free runs are compared with the plant under three courses of the MV between
    ``mv_low`` and ``mv_high``, from rest: a staircase in steps of ``mv_step`` held ``hold`` samples
    each, the same up and down again, and ``random_steps`` random levels held half as long.
    ``sizes`` are other numbers of models, at equal distances of the MV, to compare with.
    """

    model: ClassVar[type[Model]] = LocalModels
    points: tuple[Mapping[str, float], ...]
    overlap: float = 0.3
    mv_low: float
    mv_high: float
    mv_step: float
    hold: int = 500
    random_steps: int = 28
    sizes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not (self.points and self.overlap > 0 and self.mv_low < self.mv_high and self.mv_step > 0):
            raise ValueError(
                f"points is {list(self.points)}, overlap {self.overlap}, mv_low..mv_high {self.mv_low}..{self.mv_high} "
                f"in steps of {self.mv_step}; give one or more points, an overlap and a step above 0, "
                "and mv_low < mv_high"
            )
        if self.hold < 2 or self.random_steps < 1 or any(n < 2 for n in self.sizes):
            raise ValueError(
                f"hold is {self.hold}, random_steps {self.random_steps}, sizes {list(self.sizes)}; a hold and "
                "every size must be at least 2, and there must be a random step"
            )

    def learn(self, source: Source) -> Learnt:
        """The network and its free runs; the seed draws the random course."""
        known = equations(source.plant, "a part of kind 'local_models'")
        model = LocalModels.at_set_points(known, [operating_cv(known, p) for p in self.points], self.overlap)
        courses = {name: (mv, _plant_run(known, mv)) for name, mv in self._courses(source.seed).items()}
        runs = {name: free_run(model, x[0], mv) for name, (mv, x) in courses.items()}
        metrics: dict[str, Any] = {
            "operating_points": {str(i): _point(known, p) for i, p in enumerate(model.linearizations(), start=1)},
            "widths": [float(v) for v in model.width],
            **{name: _figures(known, x, runs[name]) for name, (_, x) in courses.items()},
            "steady_error": self._steady_error(model, known),
        }
        mv, x = courses["staircase"]
        if self.sizes:
            metrics["sizes"] = {str(n): self._of_size(known, n, x, mv) for n in self.sizes}
        time_s = np.arange(len(mv), dtype=np.float64) * source.signals.period_s
        curves = {"time_s": time_s, "mv": mv, "actual": x, "predicted": runs["staircase"]}
        return Learnt(model, metrics, predictions=curves)

    def _courses(self, seed: int) -> dict[str, Array]:
        """MVs (n, 1) of each course."""
        up = np.arange(self.mv_low, self.mv_high + 0.5 * self.mv_step, self.mv_step)
        levels = np.random.default_rng(seed).uniform(self.mv_low, self.mv_high, self.random_steps)
        return {
            "staircase": np.repeat(up, self.hold)[:, None],
            "up_down": np.repeat(np.append(up, up[-2::-1]), self.hold)[:, None],
            "random": np.repeat(levels, self.hold // 2)[:, None],
        }

    def _steady_error(self, model: LocalModels, plant: EquationPlant) -> float:
        """The relative error of the network's steady controlled variable that is largest in size, its sign kept."""
        mvs = np.linspace(self.mv_low, self.mv_high, STEADY_POINTS)
        starts = np.array([_rest(plant, float(mv)) for mv in mvs])
        u, x = torch.from_numpy(mvs)[:, None], torch.from_numpy(starts)
        with torch.no_grad():
            for _ in range(REST_PERIODS):
                x = model(torch.cat([x, u], dim=-1))
        error = x[:, 0].numpy() / starts[:, 0] - 1
        return float(error[np.argmax(np.abs(error))])

    def _of_size(self, plant: EquationPlant, n: int, x: Array, mv: Array) -> float:
        """Staircase fit [%] of the controlled variable with ``n`` models at equal distances of the MV."""
        cvs = [float(_rest(plant, float(v))[0]) for v in np.linspace(self.mv_low, self.mv_high, n)]
        model = LocalModels.at_set_points(plant, cvs, self.overlap)
        return fit_percent(x[:, 0], free_run(model, x[0], mv)[:, 0])


def operating_cv(plant: EquationPlant, point: Mapping[str, float]) -> float:
    """The controlled variable of the steady state at which one signal, a state or the MV, has a given value.

    Raises ModelError unless the point names one signal, and that value is met once over the set point's range.
    """
    cvs, xs, mvs = plant.steady_curve
    known = {s.name: xs[:, i] for i, s in enumerate(plant.state_signals)} | {plant.mv_signals[0].name: mvs}
    if len(point) != 1 or not set(point) <= set(known):
        raise ModelError(
            f"an operating point is one signal and its value; got {dict(point)}, known: {', '.join(known)}"
        )
    ((name, value),) = point.items()
    names = [s.name for s in plant.state_signals]

    def miss(cv: float) -> float:
        x, mv = plant.steady_state_at(cv)
        return float(x[names.index(name)] if name in names else mv[0]) - value

    at = np.nonzero(np.diff(np.sign(known[name] - value)))[0]
    if len(at) != 1:
        raise ModelError(
            f"plant {plant.name!r} has {len(at)} steady states with {name} = {value:g} over its set point's range; "
            "an operating point needs exactly one"
        )
    from scipy import optimize  # loads for long, for whoever only reads what a model's parameters are

    return float(optimize.brentq(miss, cvs[at[0]], cvs[at[0] + 1], xtol=1e-14))


def free_run(model: LocalModels, x0: Array, mv: Array) -> Array:
    """States (n, n_x) of the network alone, from x0 (n_x,) under mv (n, 1)."""
    with torch.no_grad():
        later = simulate(model, torch.from_numpy(x0), torch.from_numpy(mv[:-1]))
    return np.vstack([x0, later.numpy()])


def _rest(plant: EquationPlant, mv: float) -> Array:
    return plant.steady_state_at(operating_cv(plant, {plant.mv_signals[0].name: mv}))[0]


def _plant_run(plant: EquationPlant, mv: Array) -> Array:
    return simulate_open(plant, _rest(plant, float(mv[0, 0])), mv)[:-1]


def _figures(plant: EquationPlant, actual: Array, predicted: Array) -> dict[str, float]:
    """Fit [%] of each state, and the largest error of the controlled variable."""
    fits = {f"fit_{s.name}": fit_percent(actual[:, i], predicted[:, i]) for i, s in enumerate(plant.state_signals)}
    return {**fits, "largest_error": float(np.abs(actual[:, 0] - predicted[:, 0]).max())}


def _point(plant: EquationPlant, point: Linearization) -> dict[str, float]:
    names = [s.name for s in (*plant.state_signals, *plant.mv_signals)]
    return dict(zip(names, map(float, (*point.x, *point.mv)), strict=True))
