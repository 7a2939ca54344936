"""How params.yaml asks for the models of a set, and how each is learnt from a record."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.config.params import choose
from pipeline.errors import ModelError
from pipeline.metrics import per_region, r2, rmse
from pipeline.models.base import Model
from pipeline.models.training.regressors import Pairs, forward_pairs, inverse_pairs
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.records.record import Record

if TYPE_CHECKING:
    from pipeline.models.static.sweep import SweepResult

Array = NDArray[np.float64]
Regions = Mapping[str, tuple[float, float]]
ROWS = 8192  # predicted at a time


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

    model: ClassVar[type[Model]]

    @abstractmethod
    def learn(
        self, record: Record | None, signals: Signals, regions: Regions, seed: int, plant: Simulator | None = None
    ) -> Learnt:
        """The trained model; ``regions`` (ranges of the controlled variable) are for the figures only.

        ``plant`` is for parts that are made from equations, or compared with the plant itself; PlantError where one
        needs it and has none. The others know the signals alone.
        """


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

    def pairs(self, record: Record | None, signals: Signals) -> Pairs:
        """All pairs of the record; raises ParamsError for an unknown target, ModelError without a record."""
        if record is None:
            raise ModelError(
                f"a part of kind {self.model.kind!r} learns from a record; point `data:` of its set at one"
            )
        if self.task == "inverse":
            return inverse_pairs(record, self.horizon)
        names = {s.name: i for i, s in enumerate(signals.pv)}
        target = 0 if self.target is None else choose(names, self.target, "process variable", "target")
        return forward_pairs(record, self.horizon, target)

    def limits(self, signals: Signals) -> tuple[float, float] | None:
        """Range of an inverse's output, the MV's; a forward model's is not limited."""
        mv = signals.mv[0]
        return (mv.low, mv.high) if self.task == "inverse" else None

    def unit(self, signals: Signals) -> str:
        """Unit of the output."""
        if self.task == "inverse":
            return signals.mv[0].unit
        return next((s.unit for s in signals.pv if s.name == self.target), signals.pv[0].unit)

    def scored(self, model: Model, pairs: Pairs, signals: Signals, regions: Regions) -> dict[str, Any]:
        """RMSE and R2 over some pairs, overall and by the region of cv(k), predictions limited as in use."""
        predicted = self.limited(predict(model, pairs.x), signals)
        cv = pairs.x[:, 0]
        counts = per_region(lambda a, _: float(len(a)), pairs.y, predicted, cv, regions)
        errors = per_region(rmse, pairs.y, predicted, cv, regions)
        return {
            "rmse": rmse(pairs.y, predicted),
            "r2": r2(pairs.y, predicted),
            "regions": {name: {"rmse": errors[name], "n": int(counts[name])} for name in errors},
        }

    def limited(self, predicted: Array, signals: Signals) -> Array:
        """Predictions within the output's range."""
        limits = self.limits(signals)
        return predicted if limits is None else predicted.clip(*limits)


def predict(model: Model, x: Array) -> Array:
    """Outputs (N, n_out) of a model for inputs (N, n_in), a chunk of rows at a time."""
    with torch.no_grad():
        return np.concatenate([model(rows).numpy() for rows in torch.split(torch.from_numpy(x), ROWS)])
