"""PID gains from a linear model that is learnt on at every sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from loopwright.pipeline.laws.adaptive import AdaptiveParams, AdaptivePid, move, target
from loopwright.pipeline.laws.base import Stepped, hold_numbers
from loopwright.pipeline.laws.recursive.arx_law import estimator, require_arx
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.lagged.arx import ARX
from loopwright.pipeline.models.lagged.recursive_arx import RecursiveArx
from loopwright.pipeline.models.memory import Slot
from loopwright.pipeline.plants.signals import Signals
from loopwright.pipeline.plants.simulator import Simulator


class RecursivePid(AdaptivePid):
    """PID whose gains give, within bounds, the minimum-variance move of a recursively estimated ARX model.

        min_du  (r - y0 - b du)^2 + mu du^2   ->   v = b (r - y0)/c,   c = b^2 + mu
        y0 = theta' x(t+1) with u(t) = u(t-1), plus d;   d = (1 - alpha) d1 + alpha (y - theta' x(t))

    Recursive least squares with forgetting updates theta at this sample; part ``arx`` gives the
    first estimate. Parameters and covariance are in the state. The estimate follows recent data
    only, whereas ``linearized_pid`` has a model of the plant at the present operating point.

    Source: REC-LINPID of [chen2004, section 5], with eqs 16-28 as its control law.
    """

    name: ClassVar[str] = "recursive_pid"
    title: ClassVar[str] = "PID from a recursive linear model"
    parts: ClassVar[Mapping[str, str]] = {"arx": "kind arx"}

    @dataclass(frozen=True, slots=True)
    class Params(AdaptiveParams):
        """The settings of AdaptiveParams, and those of the estimator.

        ``forgetting``: in (0, 1]. ``covariance``: its first and largest value, for scaled parameters
        and signals. ``offset_filter``: alpha in [0, 1]; 0 means no offset d.
        """

        forgetting: float = 0.98
        covariance: float = 1.0
        offset_filter: float = 1.0

        def __post_init__(self) -> None:
            AdaptiveParams.__post_init__(self)
            if not 0 <= self.offset_filter <= 1:
                raise ValueError(f"offset_filter is {self.offset_filter}; it must lie in [0, 1]")

    params: Params
    penalty: Tensor  # (1,)
    alpha: Tensor  # (1,) [pv]

    def __init__(self, signals: Signals, model: ARX, params: Params) -> None:
        def model_for(unit: float) -> RecursiveArx:
            return estimator(self.name, signals, model, unit, params)

        more = {"offset": Slot(1, torch.zeros(1, dtype=torch.float64))}
        slopes = model.weight[: model.n_y], float(model.weight[model.n_y])
        super().__init__(signals, params, -slopes[0], slopes[1], model_for, more, ("offset",))
        hold_numbers(self, penalty=self.params.penalty, alpha=self.model.half_y * params.offset_filter)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law with part ``arx`` as its first estimate; raises LawError."""
        return cls(signals, require_arx(models, cls.name), params)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.memory.recall(sp, pv, mv_applied, state)
        # What this sample teaches, and how far the model was off it.
        sample = self.model.sample(p)
        estimate = self.model(p, sample)
        missed = sample.psi - self.model.output(sample.x, estimate.theta)
        offset = (1 - self.params.offset_filter) * p["offset"] + self.alpha * missed
        # The forecast without a move, and the move that brings it to the set point.
        y = self.model.middle_y + self.model.pv_unit * self.model.output(sample.x_ahead, estimate.theta) + offset
        slope = estimate.slope
        c = slope * slope + self.penalty
        best = slope * (target(p, self.params.preview) - y) / c
        # The gains that come nearest to it, if they are free to change.
        rho = self.gains.errors(p)
        free, loud = self.gains.free(p, slope)
        z, changed = self.gains.settled(p, self.gains.update(p, rho, best, c, free), free)
        mv = self.limited(p["u"] + move(rho, z) * self.gains.unit, p["u"])
        kept = {**estimate.kept, **loud, **changed, "offset": offset}
        return mv, self.memory.stored(p, kept), torch.cat([self.gains.info_of(z, slope, free), offset], dim=-1)
