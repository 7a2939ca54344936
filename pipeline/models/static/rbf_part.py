"""How a fuzzy-means RBF network is learnt, with its partition sweep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.part import Learnt, Source, StaticPart, predict
from loopwright.pipeline.models.static.rbf import RBF, Basis
from loopwright.pipeline.models.training.regressors import Pairs

if TYPE_CHECKING:
    from loopwright.pipeline.models.static.sweep import SweepResult


@dataclass(frozen=True, kw_only=True)
class RbfPart(StaticPart):
    """A fuzzy-means RBF network.

    ``partitions`` c fuzzy sets an input; ``basis``, ``width``, ``ridge`` as in FuzzyMeansRBF; ``sweep``
    [first, last] partitions to try on the data seed ``sweep_seed``, for the picture, none where empty.
    """

    model: ClassVar[type[Model]] = RBF
    partitions: int = 10
    basis: Basis = "thin_plate"
    width: float = 0.5
    ridge: float = 0.0
    sweep: tuple[int, ...] = ()
    sweep_seed: int = 0

    def __post_init__(self) -> None:
        if self.sweep and (len(self.sweep) != 2 or not 2 <= self.sweep[0] <= self.sweep[1]):
            raise ValueError(f"sweep is {list(self.sweep)}; give [first, last] partitions, 2 <= first <= last")

    def learn(self, source: Source) -> Learnt:
        """Train by one least-squares fit, and sweep the partitions where asked to."""
        pairs = self.pairs(source)
        train, validation = pairs.split(self.train_fraction, self.split, source.seed)
        model, metrics = self._fit(train, validation, source)
        if self.split == "random":
            # Neighbours in time on both sides flatter a random split: the honest figure stands beside it.
            _, chronological = self._fit(*pairs.split(self.train_fraction, "time", source.seed), source)
            metrics["time_split"] = {k: chronological[k] for k in ("rmse", "r2", "centres")}
        swept = self._swept(train, validation, source) if self.sweep and source.seed == self.sweep_seed else None
        shown = validation.take(np.arange(min(400, len(validation))))
        predictions = {
            "time_s": source.data(self.model.kind).time_s[shown.row],
            "actual": shown.y[:, 0],
            "predicted": self.limited(predict(model, shown.x), source.signals)[:, 0],
        }
        return Learnt(model, metrics, swept, predictions)

    def _fit(self, train: Pairs, validation: Pairs, source: Source) -> tuple[Model, dict[str, Any]]:
        from loopwright.pipeline.models.static.fuzzy_means import (
            FuzzyMeansRBF,  # scikit-learn is slow to import, few need it
        )

        estimator = FuzzyMeansRBF(self.partitions, basis=self.basis, width=self.width, ridge=self.ridge)
        model = estimator.fit(train.x, train.y).to_torch()
        metrics = self.scored(model, validation, source)
        return model, metrics | {"centres": len(estimator.centres_), "c": self.partitions, "n_train": len(train)}

    def _swept(self, train: Pairs, validation: Pairs, source: Source) -> SweepResult:
        from loopwright.pipeline.models.static.sweep import sweep  # here, as above

        signals = source.signals
        data = train.x, train.y, validation.x, validation.y
        return sweep(
            *data,
            partitions=range(self.sweep[0], self.sweep[1] + 1),
            limits=self.limits(signals),
            regions=source.regions,
            basis=self.basis,
            width=self.width,
            ridge=self.ridge,
            unit=(signals.mv[0] if self.task == "inverse" else signals.pv[source.pv_index(self.target)]).unit,
        )
