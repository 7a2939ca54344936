"""The parts of a model set in params.yaml, and their training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeVar

import numpy as np
import torch

from loopwright.pipeline.config.known import Known
from loopwright.pipeline.config.params import choose
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.metrics import per_region, r2, rmse
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.training.regressors import Pairs, forward_pairs, inverse_pairs
from loopwright.pipeline.plants.simulator import Array, Signals, Simulator
from loopwright.pipeline.records.record import Record

if TYPE_CHECKING:
    from loopwright.pipeline.models.static.sweep import SweepResult
Regions = Mapping[str, tuple[float, float]]
Result_co = TypeVar("Result_co", covariant=True)
PREDICTED_ROWS = 8192  # predicted in one call


@dataclass(frozen=True, slots=True)
class Source:
    """The data that a part is trained on.

    ``record`` is None for a set that is made from equations. ``regions`` are ranges of the controlled variable, for
    the figures only. ``plant`` is for parts that are made from equations or compared with the plant. ``known`` is what
    an engineer knows of pairs of PV and input. ``held``: PV -> sign of its answer to the MV, by the old loop that held
    it with that.
    """

    record: Record | None
    signals: Signals
    regions: Regions = field(default_factory=dict)
    seed: int = 0
    plant: Simulator | None = None
    groundwork: Mapping[Groundwork[Any], Any] = field(default_factory=dict)  # what is done already, and its results
    known: tuple[Known, ...] = ()
    held: Mapping[str, int] = field(default_factory=dict)

    def result(self, work: Groundwork[Result_co]) -> Result_co:
        """The result of a groundwork, which is done now where nobody has done it before."""
        return self.groundwork[work] if work in self.groundwork else work.done(self, work.kind)

    def data(self, kind: str) -> Record:
        """The record, for a part of this kind; ModelError without one."""
        if self.record is None:
            raise ModelError(f"a part of kind {kind!r} learns from a record; point `data:` of its set at one")
        return self.record

    def pv_index(self, name: str | None) -> int:
        """Index of a process variable, None for the controlled variable; ParamsError for an unknown name."""
        names = {s.name: i for i, s in enumerate(self.signals.pv)}
        return 0 if name is None else choose(names, name, "process variable", "target")


class Groundwork(ABC, Generic[Result_co]):
    """Work that several parts of a set need. Equal ones are done once a data seed, before the parts are learnt.

    Its pieces may be spread over the cores by ``parallel_map``; its result can be pickled.
    """

    kind: str  # of the parts that need it

    @abstractmethod
    def done(self, source: Source, label: str) -> Result_co:
        """The result; ``label`` names its progress. Raises ModelError without the needed data."""

    def plainer(self, found: Any) -> Any:
        """The result with a simpler model, for a record that does not prove the one of ``found``; None without one."""
        return None


@dataclass(frozen=True)
class Learnt:
    """A trained part: the model, its figures, and the data for its pictures."""

    model: Model
    metrics: dict[str, Any]
    sweep: SweepResult | None = None
    predictions: dict[str, Array] | None = None  # time_s, actual, predicted over some validation rows


@dataclass(frozen=True, kw_only=True)
class Part(ABC):
    """One model of a set, as params.yaml describes it."""

    model: ClassVar[type[Model]]

    def groundwork(self) -> Groundwork[Any] | None:
        """Work that this part shares with others of its set; None for a part that stands alone."""
        return None

    @abstractmethod
    def learn(self, source: Source) -> Learnt:
        """The trained model. Raises ModelError without the needed data, PlantError without the equations."""


def groundworks(parts: Iterable[Part]) -> list[Groundwork[Any]]:
    """The work that some parts need, equal ones once."""
    return list(dict.fromkeys(work for part in parts if (work := part.groundwork()) is not None))


def done(works: Iterable[Groundwork[Any]], source: Source, label: str) -> dict[Groundwork[Any], Any]:
    """The result of each groundwork on a source."""
    return {work: work.done(source, label) for work in works}


@dataclass(frozen=True, kw_only=True)
class StaticPart(Part):
    """A part that learns a static map from pairs of a record.

    ``task`` inverse: [pv(k), cv(k+h)] -> mv(k); forward: [pv(k), mv(k)] -> target(k+h). ``horizon``: h
    in periods. ``target``: a PV's name, None for the controlled variable. ``train_fraction``: share of the
    pairs for training; ``split`` takes them in ``time`` order or at ``random``.
    """

    task: Literal["inverse", "forward"]
    horizon: int = 1
    target: str | None = None
    train_fraction: float = 0.7
    split: Literal["time", "random"] = "time"

    def pairs(self, source: Source) -> Pairs:
        """All pairs of the record; raises ParamsError for an unknown target, ModelError without a record."""
        record = source.data(self.model.kind)
        if self.task == "inverse":
            return inverse_pairs(record, self.horizon)
        return forward_pairs(record, self.horizon, source.pv_index(self.target))

    def limits(self, signals: Signals) -> tuple[float, float] | None:
        """The MV's range, which limits the output of an inverse model; None for a forward model."""
        mv = signals.mv[0]
        return (mv.low, mv.high) if self.task == "inverse" else None

    def limited(self, predicted: Array, signals: Signals) -> Array:
        """Predictions within the output's range."""
        limits = self.limits(signals)
        return predicted if limits is None else predicted.clip(*limits)

    def scored(self, model: Model, pairs: Pairs, source: Source) -> dict[str, Any]:
        """``accuracy`` over the pairs, with limited predictions, and the number of pairs in each region."""
        predicted = self.limited(predict(model, pairs.x), source.signals)
        cv = pairs.x[:, 0]
        figures = accuracy(pairs.y, predicted, cv, source.regions)
        counts = per_region(lambda a, _: float(len(a)), pairs.y, predicted, cv, source.regions)
        for name, count in counts.items():
            figures["regions"][name]["n"] = int(count)
        return figures


def predict(model: Model, x: Array) -> Array:
    """Outputs (N, n_out) of a model for inputs (N, n_in), a chunk of rows at a time."""
    with torch.no_grad():
        return np.concatenate([model(rows).numpy() for rows in torch.split(torch.from_numpy(x), PREDICTED_ROWS)])


def accuracy(actual: Array, predicted: Array, cv: Array, regions: Regions) -> dict[str, Any]:
    """RMSE [unit of the output] and R2 of predictions (N, ...), and the RMSE by the region of cv (N,)."""
    errors = per_region(rmse, actual, predicted, cv, regions)
    return {
        "rmse": rmse(actual, predicted),
        "r2": r2(actual, predicted),
        "regions": {name: {"rmse": error} for name, error in errors.items()},
    }
