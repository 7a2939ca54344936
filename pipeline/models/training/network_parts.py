"""How networks are learnt by a trainer, and static maps among them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from loopwright.pipeline.config.params import choose, parse
from loopwright.pipeline.metrics import fit_percent, rmse
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.part import Learnt, Regions, Source, StaticPart
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.fit import TRAINERS, FitHistory, Trainer
from loopwright.pipeline.models.training.objectives import Objective, Samples
from loopwright.pipeline.plants.simulator import Array

TRAINED = ("one_step_trained", "free_run_trained")
"""Names of the network after the first training and after the second, in metrics and curves."""


@dataclass(frozen=True, slots=True, eq=False)
class LongRun:
    """Free runs of a network beside the measurement: (N, k, n_pv) each, N runs of k periods.

    ``one_step`` holds (measured, predicted) one period ahead, (M, n_pv) each.
    """

    one_step: tuple[Array, Array]
    measured: Array
    predicted: Array

    def figures(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """For each PV: RMSE one step ahead, RMSE [unit of the PV] and fit [%] of the free runs."""
        return {
            name: {
                "one_step_rmse": rmse(*(side[:, i] for side in self.one_step)),
                "free_run_rmse": rmse(self.measured[..., i], self.predicted[..., i]),
                "free_run_fit": fit_percent(self.measured[..., i].ravel(), self.predicted[..., i].ravel()),
            }
            for i, name in enumerate(names)
        }


def curves(runs: Mapping[str, LongRun], period_s: float) -> dict[str, Array]:
    """The first PV over the first of the runs: ``time_s``, ``measured``, and each network's course by its name."""
    measured = next(iter(runs.values())).measured[0, :, 0]
    time_s: Array = period_s * np.arange(1, len(measured) + 1, dtype=np.float64)
    return {"time_s": time_s, "measured": measured, **{name: run.predicted[0, :, 0] for name, run in runs.items()}}


def trainer_of(options: Mapping[str, Any]) -> Trainer:
    """The trainer that a part's options {kind: lm | lbfgs | adam, ...} describe; raises ParamsError."""
    rest = dict(options)
    return parse(choose(TRAINERS, rest.pop("kind", "lm"), "trainer", "trainer.kind"), rest, "trainer")


def fit_in_two(
    net: MLP,
    trainer: Trainer,
    *,
    one_step: Sequence[Objective],
    free_run: Sequence[Objective] | None,
    free_run_iterations: int | None,
    seed: int,
    long_run: Callable[[], LongRun] | None,
) -> tuple[FitHistory, dict[str, LongRun]]:
    """Train one step ahead, then go on from those weights with a free run: one of random weights leads nowhere.

    ``one_step`` and ``free_run`` hold the objectives of training and validation; without ``free_run`` the one-step
    fit is the last. ``free_run_iterations`` limit the second training; None: as the first. ``long_run`` judges the
    network after each of the two; its results have the names TRAINED.
    """
    history = trainer.fit(net, *one_step, seed=seed)
    runs = {TRAINED[0]: long_run()} if long_run else {}
    if free_run:
        iterations = trainer.iterations if free_run_iterations is None else free_run_iterations
        history = replace(trainer, restarts=0, iterations=iterations).fit(net, *free_run, seed=seed)
        if long_run:
            runs[TRAINED[1]] = long_run()
    return history, runs


def fit_figures(model: Model, history: FitHistory) -> dict[str, Any]:
    """How a fit went, for the metrics: the model's size, its iterations and their validation errors."""
    return {
        "parameters": sum(p.numel() for p in model.parameters()),
        "iterations": len(history.validation),
        "stopped": history.stopped,
        "history": list(history.validation),
    }


@dataclass(frozen=True, kw_only=True)
class MlpPart(StaticPart):
    """A multilayer perceptron.

    ``hidden`` widths; ``residual``: the network gives the change of the target, not the target;
    ``balance`` 0..1: 0 weighs all rows alike, 1 all regions of the controlled variable;
    ``trainer`` {kind: lm | lbfgs | adam, and its options}.
    """

    model: ClassVar[type[Model]] = MLP
    hidden: tuple[int, ...] = (20,)
    residual: bool = True
    balance: float = 0.0
    train_fraction: float = 0.85
    trainer: Mapping[str, Any] = field(default_factory=lambda: {"kind": "lm"})

    def learn(self, source: Source) -> Learnt:
        """Train with early stopping on the validation pairs."""
        train, validation = self.pairs(source).split(self.train_fraction, self.split, source.seed)
        residual = (source.pv_index(self.target),) if self.residual and self.task == "forward" else ()
        net = MLP.scaled_to(train.x, train.y, hidden=self.hidden, residual=residual)
        sets = [Samples(p.x, p.y, self._weights(p.x[:, 0], source.regions)) for p in (train, validation)]
        history = trainer_of(self.trainer).fit(net, *sets, seed=source.seed)
        metrics = self.scored(net.eval(), validation, source)
        return Learnt(net, metrics | {"n_train": len(train), **fit_figures(net, history)})

    def _weights(self, cv: Array, regions: Regions) -> Array | None:
        if self.balance == 0:
            return None
        weight = np.ones(len(cv))
        for low, high in regions.values():
            inside = (cv >= low) & (cv < high)
            if inside.any():
                weight[inside] = (len(cv) / inside.sum()) ** self.balance
        return weight
