"""How networks are learnt by a trainer, and static maps among them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from pipeline.config.params import choose, parse
from pipeline.models.base import Model
from pipeline.models.part import Array, Learnt, Regions, StaticPart
from pipeline.models.static.mlp import MLP
from pipeline.models.training.fit import TRAINERS, FitHistory, Trainer
from pipeline.models.training.objectives import Samples
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.records.record import Record


def trainer_of(options: Mapping[str, Any]) -> Trainer:
    """The trainer that a part's options {kind: lm | lbfgs | adam, ...} describe; raises ParamsError."""
    rest = dict(options)
    return parse(choose(TRAINERS, rest.pop("kind", "lm"), "trainer", "trainer.kind"), rest, "trainer")


def going_on(trainer: Trainer, iterations: int | None) -> Trainer:
    """The same trainer, continuing from the weights that are there, for at most ``iterations``; None: as many."""
    return replace(trainer, restarts=0, iterations=trainer.iterations if iterations is None else iterations)


def story(model: Model, history: FitHistory) -> dict[str, Any]:
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

    def learn(
        self, record: Record | None, signals: Signals, regions: Regions, seed: int, plant: Simulator | None = None
    ) -> Learnt:
        """Train with early stopping on the validation pairs."""
        pairs = self.pairs(record, signals)
        train, validation = pairs.split(self.train_fraction, self.split, seed)
        residual = (self._column(signals),) if self.residual and self.task == "forward" else ()
        net = MLP.scaled_to(train.x, train.y, hidden=self.hidden, residual=residual)
        weights = [self._weights(p.x[:, 0], regions) for p in (train, validation)]
        sets = [Samples(p.x, p.y, w) for p, w in zip((train, validation), weights, strict=True)]
        history = trainer_of(self.trainer).fit(net, sets[0], sets[1], seed=seed)
        metrics = self.scored(net.eval(), validation, signals, regions)
        metrics |= {"n_train": len(train), **story(net, history)}
        return Learnt(net, metrics)

    def _column(self, signals: Signals) -> int:
        names = [s.name for s in signals.pv]
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
