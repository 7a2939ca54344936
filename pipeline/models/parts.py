"""How params.yaml asks for the models of a set, and how each is learnt from a record."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.errors import ModelError, ParamsError
from pipeline.metrics import per_region, r2, rmse
from pipeline.models.base import Model
from pipeline.models.fit import TRAINERS
from pipeline.models.fuzzy_means import FuzzyMeansRBF
from pipeline.models.leverage_domain import LeverageDomain
from pipeline.models.linearized import Linearized
from pipeline.models.mlp import MLP
from pipeline.models.objectives import Samples
from pipeline.models.rbf import CHUNK, Basis
from pipeline.models.regressors import Pairs, forward_pairs, inverse_pairs
from pipeline.models.sweep import SweepResult, sweep
from pipeline.params import choose, parse
from pipeline.plants.base import Plant
from pipeline.record import Record

Array = NDArray[np.float64]
Regions = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Learnt:
    """A trained part: the model, how well it does, and what its report shows beside the figures."""

    model: Model
    metrics: dict[str, Any]
    sweep: SweepResult | None = None
    predictions: dict[str, Array] | None = None  # time_s, actual, predicted over some validation rows


@dataclass(frozen=True, kw_only=True)
class Part(ABC):
    """One model of a set, as params.yaml describes it."""

    kind: ClassVar[str]

    @abstractmethod
    def learn(self, record: Record | None, plant: Plant, regions: Regions, seed: int) -> Learnt:
        """The trained model; ``regions`` (ranges of the controlled variable) are for the figures only."""


@dataclass(frozen=True, kw_only=True)
class StaticPart(Part):
    """A part that learns a static map from pairs of a record.

    ``task`` inverse: [pv(k), cv(k+h)] -> mv(k); forward: [pv(k), mv(k)] -> target(k+h). ``horizon`` h
    in periods; ``target`` a PV's name, None for the controlled variable; ``train_fraction`` of the pairs
    train, split in ``time`` or at ``random``.
    """

    task: Literal["inverse", "forward"]
    horizon: int = 1
    target: str | None = None
    train_fraction: float = 0.7
    split: Literal["time", "random"] = "time"

    def pairs(self, record: Record | None, plant: Plant) -> Pairs:
        """All pairs of the record; raises ParamsError for an unknown target, ModelError without a record."""
        if record is None:
            raise ModelError(f"a part of kind {self.kind!r} learns from a record; point `data:` of its set at one")
        if self.task == "inverse":
            return inverse_pairs(record, self.horizon)
        names = {s.name: i for i, s in enumerate(plant.pv_signals)}
        return forward_pairs(record, self.horizon, choose(names, self.target, "process variable", "target"))

    def limits(self, plant: Plant) -> tuple[float, float] | None:
        """Range of an inverse's output, the MV's; a forward model's is not limited."""
        mv = plant.mv_signals[0]
        return (mv.low, mv.high) if self.task == "inverse" else None

    def unit(self, plant: Plant) -> str:
        """Unit of the output."""
        if self.task == "inverse":
            return plant.mv_signals[0].unit
        return next((s.unit for s in plant.pv_signals if s.name == self.target), plant.pv_signals[0].unit)

    def scored(self, model: Model, pairs: Pairs, plant: Plant, regions: Regions) -> dict[str, Any]:
        """RMSE and R2 over some pairs, overall and by the region of cv(k), predictions limited as in use."""
        predicted = self.limited(_predict(model, pairs.x), plant)
        cv = pairs.x[:, 0]
        counts = per_region(lambda a, _: float(len(a)), pairs.y, predicted, cv, regions)
        errors = per_region(rmse, pairs.y, predicted, cv, regions)
        return {
            "rmse": rmse(pairs.y, predicted),
            "r2": r2(pairs.y, predicted),
            "regions": {name: {"rmse": errors[name], "n": int(counts[name])} for name in errors},
        }

    def limited(self, predicted: Array, plant: Plant) -> Array:
        """Predictions within the output's range."""
        limits = self.limits(plant)
        return predicted if limits is None else predicted.clip(*limits)


@dataclass(frozen=True, kw_only=True)
class RbfPart(StaticPart):
    """A fuzzy-means RBF network.

    ``partitions`` c fuzzy sets an input; ``basis``, ``width``, ``ridge`` as in FuzzyMeansRBF; ``sweep``
    [first, last] partitions to try on the first data seed, for the picture, none where empty.
    """

    kind: ClassVar[str] = "rbf"
    partitions: int = 88
    basis: Basis = "thin_plate"
    width: float = 0.5
    ridge: float = 0.0
    sweep: tuple[int, ...] = ()
    sweep_seed: int = 0

    def learn(self, record: Record | None, plant: Plant, regions: Regions, seed: int) -> Learnt:
        """Train by one least-squares fit, and sweep the partitions where asked to."""
        pairs = self.pairs(record, plant)
        train, validation = pairs.split(self.train_fraction, self.split, seed)
        model, metrics = self._fit(train, validation, plant, regions)
        if self.split == "random":
            # Neighbours in time on both sides flatter a random split: the honest figure stands beside it.
            _, chronological = self._fit(*pairs.split(self.train_fraction, "time", seed), plant, regions)
            metrics["time_split"] = {k: chronological[k] for k in ("rmse", "r2", "centres")}
        found = None
        if self.sweep and seed == self.sweep_seed:
            if len(self.sweep) != 2 or not 2 <= self.sweep[0] <= self.sweep[1]:
                raise ParamsError(f"sweep is {list(self.sweep)}; give [first, last] partitions, 2 <= first <= last")
            found = self._sweep(train, validation, plant, regions)
        shown = validation.take(np.arange(min(400, len(validation))))
        assert record is not None
        predictions = {
            "time_s": record.time_s[shown.row],
            "actual": shown.y[:, 0],
            "predicted": self.limited(_predict(model, shown.x), plant)[:, 0],
        }
        return Learnt(model, metrics, found, predictions)

    def _fit(self, train: Pairs, validation: Pairs, plant: Plant, regions: Regions) -> tuple[Model, dict[str, Any]]:
        estimator = FuzzyMeansRBF(self.partitions, basis=self.basis, width=self.width, ridge=self.ridge)
        model = estimator.fit(train.x, train.y).to_torch()
        metrics = self.scored(model, validation, plant, regions)
        return model, metrics | {"centres": len(estimator.centres_), "c": self.partitions, "n_train": len(train)}

    def _sweep(self, train: Pairs, validation: Pairs, plant: Plant, regions: Regions) -> SweepResult:
        return sweep(
            train.x,
            train.y,
            validation.x,
            validation.y,
            partitions=range(self.sweep[0], self.sweep[1] + 1),
            limits=self.limits(plant),
            regions=regions,
            basis=self.basis,
            width=self.width,
            ridge=self.ridge,
            unit=self.unit(plant),
        )


@dataclass(frozen=True, kw_only=True)
class MlpPart(StaticPart):
    """A multilayer perceptron.

    ``hidden`` widths; ``residual``: the network gives the change of the target, not the target;
    ``balance`` 0..1: 0 weighs all rows alike, 1 all regions of the controlled variable;
    ``trainer`` {kind: lm | lbfgs | adam, and its options}.
    """

    kind: ClassVar[str] = "mlp"
    hidden: tuple[int, ...] = (20,)
    residual: bool = True
    balance: float = 0.0
    train_fraction: float = 0.85
    trainer: Mapping[str, Any] = field(default_factory=lambda: {"kind": "lm"})

    def learn(self, record: Record | None, plant: Plant, regions: Regions, seed: int) -> Learnt:
        """Train with early stopping on the validation pairs."""
        pairs = self.pairs(record, plant)
        train, validation = pairs.split(self.train_fraction, self.split, seed)
        options = dict(self.trainer)
        kind = choose(TRAINERS, options.pop("kind", "lm"), "trainer", "trainer.kind")
        trainer = parse(kind, options, "trainer")
        residual = (self._column(plant),) if self.residual and self.task == "forward" else ()
        net = MLP.scaled_to(train.x, train.y, hidden=self.hidden, residual=residual)
        weights = [self._weights(p.x[:, 0], regions) for p in (train, validation)]
        sets = [Samples(p.x, p.y, w) for p, w in zip((train, validation), weights, strict=True)]
        history = trainer.fit(net, sets[0], sets[1], seed=seed)
        metrics = self.scored(net.eval(), validation, plant, regions)
        story = asdict(history)
        metrics |= {
            "n_train": len(train),
            "parameters": sum(p.numel() for p in net.parameters()),
            "iterations": len(history.validation),
            "stopped": story["stopped"],
            "history": list(history.validation),
        }
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
class DomainPart(StaticPart):
    """The leverage domain of a static part's training inputs: give it that part's task, horizon and split."""

    kind: ClassVar[str] = "leverage_domain"
    task: Literal["inverse", "forward"] = "inverse"

    def learn(self, record: Record | None, plant: Plant, regions: Regions, seed: int) -> Learnt:
        """The domain of the training pairs' inputs."""
        train, validation = self.pairs(record, plant).split(self.train_fraction, self.split, seed)
        model = LeverageDomain.fit(train.x)
        inside = _predict(model, validation.x) <= model.threshold.numpy()
        return Learnt(model, {"threshold": float(model.threshold), "inside": float(inside.mean())})


@dataclass(frozen=True, kw_only=True)
class LinearizedPart(Part):
    """The plant's own equations, linearized at the steady state with controlled variable ``at``."""

    kind: ClassVar[str] = "linearized"
    at: float

    def learn(self, record: Record | None, plant: Plant, regions: Regions, seed: int) -> Learnt:
        """The linearization; needs no data."""
        x, mv = plant.steady_state_at(self.at)
        lin = plant.linearize(x, mv)
        zeros = lin.sampled_zeros(plant.period_s)
        metrics = {
            "eigenvalues": [[float(v.real), float(v.imag)] for v in lin.eigenvalues],
            "sampled_zeros": [[float(v.real), float(v.imag)] for v in zeros],
            "mv": [float(v) for v in mv],
        }
        return Learnt(Linearized.at_set_point(plant, self.at), metrics)


def _predict(model: Model, x: Array) -> Array:
    with torch.no_grad():
        return np.concatenate([model(rows).numpy() for rows in torch.split(torch.from_numpy(x), CHUNK)])


PARTS: dict[str, type[Part]] = {p.kind: p for p in (RbfPart, MlpPart, DomainPart, LinearizedPart)}
