"""How a fuzzy-means RBF network is learnt, with its partition sweep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pipeline.errors import ParamsError
from pipeline.models.base import Model
from pipeline.models.part import Learnt, Regions, StaticPart, predict
from pipeline.models.static.rbf import RBF, Basis
from pipeline.models.training.regressors import Pairs
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.records.record import Record

if TYPE_CHECKING:
    from pipeline.models.static.sweep import SweepResult


@dataclass(frozen=True, kw_only=True)
class RbfPart(StaticPart):
    """A fuzzy-means RBF network.

    ``partitions`` c fuzzy sets an input; ``basis``, ``width``, ``ridge`` as in FuzzyMeansRBF; ``sweep``
    [first, last] partitions to try on the data seed ``sweep_seed``, for the picture, none where empty.
    """

    model: ClassVar[type[Model]] = RBF
    partitions: int = 88
    basis: Basis = "thin_plate"
    width: float = 0.5
    ridge: float = 0.0
    sweep: tuple[int, ...] = ()
    sweep_seed: int = 0

    def learn(
        self, record: Record | None, signals: Signals, regions: Regions, seed: int, plant: Simulator | None = None
    ) -> Learnt:
        """Train by one least-squares fit, and sweep the partitions where asked to."""
        pairs = self.pairs(record, signals)
        train, validation = pairs.split(self.train_fraction, self.split, seed)
        model, metrics = self._fit(train, validation, signals, regions)
        if self.split == "random":
            # Neighbours in time on both sides flatter a random split: the honest figure stands beside it.
            _, chronological = self._fit(*pairs.split(self.train_fraction, "time", seed), signals, regions)
            metrics["time_split"] = {k: chronological[k] for k in ("rmse", "r2", "centres")}
        found = None
        if self.sweep and seed == self.sweep_seed:
            if len(self.sweep) != 2 or not 2 <= self.sweep[0] <= self.sweep[1]:
                raise ParamsError(f"sweep is {list(self.sweep)}; give [first, last] partitions, 2 <= first <= last")
            found = self._sweep(train, validation, signals, regions)
        shown = validation.take(np.arange(min(400, len(validation))))
        assert record is not None
        predictions = {
            "time_s": record.time_s[shown.row],
            "actual": shown.y[:, 0],
            "predicted": self.limited(predict(model, shown.x), signals)[:, 0],
        }
        return Learnt(model, metrics, found, predictions)

    def _fit(self, train: Pairs, validation: Pairs, signals: Signals, regions: Regions) -> tuple[Model, dict[str, Any]]:
        from pipeline.models.static.fuzzy_means import (
            FuzzyMeansRBF,  # here: scikit-learn is slow to import, and few need it
        )

        estimator = FuzzyMeansRBF(self.partitions, basis=self.basis, width=self.width, ridge=self.ridge)
        model = estimator.fit(train.x, train.y).to_torch()
        metrics = self.scored(model, validation, signals, regions)
        return model, metrics | {"centres": len(estimator.centres_), "c": self.partitions, "n_train": len(train)}

    def _sweep(self, train: Pairs, validation: Pairs, signals: Signals, regions: Regions) -> SweepResult:
        from pipeline.models.static.sweep import sweep  # here, as above

        return sweep(
            train.x,
            train.y,
            validation.x,
            validation.y,
            partitions=range(self.sweep[0], self.sweep[1] + 1),
            limits=self.limits(signals),
            regions=regions,
            basis=self.basis,
            width=self.width,
            ridge=self.ridge,
            unit=self.unit(signals),
        )
