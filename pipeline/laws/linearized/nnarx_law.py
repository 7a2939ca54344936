"""What the laws share that act on the prediction of an NNARX."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from pipeline.errors import LawError, ModelError
from pipeline.laws.adaptive import (
    AdaptiveGains,
    AdaptiveParams,
    minimum_variance_gains,
    signed_unit,
    target,
    target_slots,
)
from pipeline.laws.base import ControlLaw, require_single_loop
from pipeline.models.lagged.instantaneous import Arx, arx
from pipeline.models.lagged.next_output import Ahead, NextOutput
from pipeline.models.lagged.nnarx import NNARX
from pipeline.models.memory import Memory, Named, Slot, Stage
from pipeline.plants.signals import Signals


@dataclass(frozen=True, slots=True)
class NnarxParams(AdaptiveParams):
    """Those of an adaptive PID, and how much the model believes the measurement.

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


def room(p: Named, low: Tensor, high: Tensor, unit: float) -> dict[str, Tensor]:
    """Formulas of the least and the largest move that the actuator can make, in units."""
    ends = [(low - p["u"]) / unit, (high - p["u"]) / unit]
    return dict(zip(("down", "up"), ends if unit > 0 else reversed(ends), strict=True))


class NnarxPid(ControlLaw):
    """A PID law over part ``nnarx``: model, gains, and the memory and formulas of both. ``forward`` is the law's.

    ``more`` are slots of the law's own; ``told`` the names of its info after those of the gains;
    ``bounded`` asks for the formulas of ``room``.
    """

    incremental = True

    def __init__(
        self,
        signals: Signals,
        model: NNARX,
        params: NnarxParams,
        *,
        more: Mapping[str, Slot] | None = None,
        told: tuple[str, ...] = (),
        bounded: bool = False,
    ) -> None:
        super().__init__(signals, params.mv_rate)
        require_single_loop(signals, self.name)
        centre = central_model(model)
        slope = float(centre.b[0])
        unit = signed_unit(signals, params.plant_gain, slope)
        start = params.gains or minimum_variance_gains(centre.a, slope * unit, params)
        self.model = next_output(self.name, model, unit, params.offset_filter, params.trust)
        self.gains = AdaptiveGains(params, signals, unit, start)
        more = more or {}
        self.memory = Memory({**target_slots(params.preview), **self.model.slots, **self.gains.slots, **more})
        self.stage = Stage(
            self.memory.layout,
            lambda p: {
                "known": self.memory.then(p),
                **self.gains.terms(p),
                **self.model.terms(p, target(p, params.preview)),
                **{name: p[name] for name in more},
                **(room(p, self.low, self.high, unit) if bounded else {}),
            },
        )
        self.n_state = self.memory.n_state
        self.info = (*AdaptiveGains.info, "offset", *told)

    def commanded(self, now: Named, step: Tensor) -> tuple[Tensor, Tensor]:
        """The MV (..., 1) after a move of ``step`` units, within its limits, and the move that they leave, in units."""
        mv = self.limited(now["mv"] + step * self.gains.unit, now["mv"])
        return mv, (mv - now["mv"]) * self.gains.by_unit

    def linearization_error(self, ahead: Ahead, step: Tensor) -> Tensor:
        """|NN - linear| of y(t+1), (..., 1), at a move of ``step`` units."""
        return (self.model.moved(ahead, step) - ahead.slope * step).abs()
