"""Shared parts of the laws that act on the prediction of an NNARX."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from torch import Tensor

from loopwright.pipeline.errors import LawError, ModelError
from loopwright.pipeline.laws.adaptive import AdaptiveParams, AdaptivePid
from loopwright.pipeline.laws.base import require_kind
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.lagged.instantaneous import Arx, arx
from loopwright.pipeline.models.lagged.next_output import Ahead, NextOutput
from loopwright.pipeline.models.lagged.nnarx import NNARX
from loopwright.pipeline.models.memory import Named, Slot
from loopwright.pipeline.plants.signals import Signals
from loopwright.pipeline.plants.simulator import Simulator


@dataclass(frozen=True, slots=True)
class NnarxParams(AdaptiveParams):
    """Parameters of an adaptive PID, and how much the model believes the measurement.

    ``offset_filter`` alpha and ``trust``, both in (0, 1], as in ``NextOutput``; 1 is as the paper.
    """

    offset_filter: float = 1.0
    trust: float = 1.0

    def __post_init__(self) -> None:
        AdaptiveParams.__post_init__(self)
        for name in ("offset_filter", "trust"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in (0, 1], 1 to believe every sample")


def central_model(model: NNARX) -> Arx:
    """The linear model at the centre of the training data."""
    return arx(model, model.net.x_center)


def next_output(law: str, model: NNARX, unit: float, offset_filter: float, trust: float = 1.0) -> NextOutput:
    """The predictor of a law; raises LawError for a model whose newest MV does not act at once."""
    try:
        return NextOutput(model, unit, offset_filter, trust)
    except ModelError as error:
        raise LawError(f"law {law!r}: {error}") from error


class NnarxPid(AdaptivePid):
    """A PID law over part ``nnarx``. ``more`` are slots of the law's own, ``info`` the names of its own info."""

    parts: ClassVar[Mapping[str, str]] = {"nnarx": "kind nnarx"}
    params: NnarxParams

    def __init__(
        self,
        signals: Signals,
        model: NNARX,
        params: NnarxParams,
        more: Mapping[str, Slot] | None = None,
        info: tuple[str, ...] = (),
    ) -> None:
        def predictor(unit: float) -> NextOutput:
            return next_output(self.name, model, unit, params.offset_filter, params.trust)

        centre = central_model(model)
        super().__init__(signals, params, centre.a, float(centre.b[0]), predictor, more or {}, ("offset", *info))

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over part ``nnarx``; raises LawError."""
        return cls(signals, require_kind(models, NNARX, cls.name), params)

    def commanded(self, p: Named, move: Tensor) -> tuple[Tensor, Tensor]:
        """The MV (..., 1) after a move in units, within its limits, and the move that they leave, in units."""
        mv = self.limited(p["u"] + move * self.gains.unit, p["u"])
        return mv, (mv - p["u"]) * self.gains.by_unit

    def linearization_error(self, ahead: Ahead, move: Tensor) -> Tensor:
        """|NN - linear| of y(t+1), (..., 1), at a move in units."""
        y, _ = self.model.moved(ahead, move)
        return (y - ahead.y - ahead.slope * move).abs()
