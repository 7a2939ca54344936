"""How networks are learnt by a trainer: static maps and NNARX predictors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from pipeline.errors import ModelError
from pipeline.metrics import fit_percent, per_region, r2, rmse
from pipeline.models.base import Model
from pipeline.models.fit import TRAINERS, FitHistory, Trainer
from pipeline.models.mlp import MLP
from pipeline.models.nnarx import NNARX
from pipeline.models.objectives import Samples
from pipeline.models.parts import Array, Learnt, Part, Regions, StaticPart, predict
from pipeline.models.regressors import nnarx_pairs
from pipeline.params import choose, parse
from pipeline.plants.base import Plant
from pipeline.record import Record


def _trainer(options: Mapping[str, Any]) -> Trainer:
    rest = dict(options)
    return parse(choose(TRAINERS, rest.pop("kind", "lm"), "trainer", "trainer.kind"), rest, "trainer")


def _story(model: Model, history: FitHistory) -> dict[str, Any]:
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

    def learn(self, record: Record | None, plant: Plant, regions: Regions, seed: int) -> Learnt:
        """Train with early stopping on the validation pairs."""
        pairs = self.pairs(record, plant)
        train, validation = pairs.split(self.train_fraction, self.split, seed)
        residual = (self._column(plant),) if self.residual and self.task == "forward" else ()
        net = MLP.scaled_to(train.x, train.y, hidden=self.hidden, residual=residual)
        weights = [self._weights(p.x[:, 0], regions) for p in (train, validation)]
        sets = [Samples(p.x, p.y, w) for p, w in zip((train, validation), weights, strict=True)]
        history = _trainer(self.trainer).fit(net, sets[0], sets[1], seed=seed)
        metrics = self.scored(net.eval(), validation, plant, regions)
        metrics |= {"n_train": len(train), **_story(net, history)}
        return Learnt(net, metrics)

    def _column(self, plant: Plant) -> int:
        names = [s.name for s in plant.pv_signals]
        return names.index(self.target) if self.target is not None else 0

    def _weights(self, cv: Array, regions: Regions) -> Array | None:
        if self.balance == 0:
            return None
        weight = np.ones(len(cv))
        for low, high in regions.values():
            inside = (cv >= low) & (cv < high)
            if inside.any():
                weight[inside] = (len(cv) / inside.sum()) ** self.balance
        return weight


@dataclass(frozen=True, kw_only=True)
class NnarxPart(Part):
    """An NNARX predictor of ``target`` (None: the controlled variable) from lags.

    ``n_y``, ``n_u``, ``delay`` the lags; ``steps`` the prediction horizon that is trained on: 1 is the
    one-step error, more a free run of that many periods, begun from the one-step fit.
    """

    model: ClassVar[type[Model]] = NNARX
    n_y: int = 2
    n_u: int = 2
    delay: int = 1
    target: str | None = None
    hidden: tuple[int, ...] = (10,)
    residual: bool = True
    steps: int = 1
    train_fraction: float = 0.7
    trainer: Mapping[str, Any] = field(default_factory=lambda: {"kind": "lm"})

    def learn(self, record: Record | None, plant: Plant, regions: Regions, seed: int) -> Learnt:
        """Train with early stopping; figures are of one step (by the region of the target, too) and of a free run."""
        if record is None:
            raise ModelError("a part of kind 'nnarx' learns from a record; point `data:` of its set at one")
        names = [s.name for s in plant.pv_signals]
        target = names.index(self.target) if self.target is not None else 0
        pairs = nnarx_pairs(record, self.n_y, self.n_u, target, self.delay)
        train, validation = pairs.split(self.train_fraction, "time", seed)
        model = NNARX.scaled_to(
            train.x, train.y, n_y=self.n_y, n_u=self.n_u, delay=self.delay, hidden=self.hidden, residual=self.residual
        )
        trainer = _trainer(self.trainer)
        history = trainer.fit(model.net, Samples(train.x, train.y), Samples(validation.x, validation.y), seed=seed)
        if self.steps > 1:
            # From the one-step fit: a free run of random weights leads nowhere.
            windows = model.windows(record, self.steps, target)
            cut = round(self.train_fraction * len(windows))
            before, after = (windows.part(np.arange(a, b)) for a, b in ((0, cut), (cut, len(windows))))
            history = replace(trainer, restarts=0).fit(model.net, before, after, seed=seed)
        predicted = predict(model, validation.x)
        ahead, measured = model.k_step(record, max(self.steps, 2), target)
        late = slice(round(self.train_fraction * len(ahead)), None)
        metrics = {
            "free_run_rmse": rmse(measured[late], ahead[late]),
            "rmse": rmse(validation.y, predicted),
            "r2": r2(validation.y, predicted),
            "fit_percent": fit_percent(validation.y, predicted),
            "regions": {
                name: {"rmse": error}
                for name, error in per_region(rmse, validation.y, predicted, validation.x[:, 0], regions).items()
            },
            "n_train": len(train),
            **_story(model, history),
        }
        return Learnt(model.eval(), metrics)
