"""PID gains from a linear model that is learnt on at every sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from pipeline.laws.adaptive import AdaptiveParams, AdaptivePid, target
from pipeline.laws.base import Stepped, hold_numbers
from pipeline.laws.recursive.arx_law import estimator, require_arx
from pipeline.models.base import Model
from pipeline.models.lagged.arx import ARX
from pipeline.models.lagged.recursive_arx import RecursiveArx
from pipeline.models.memory import Named, Slot, constant
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator


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

        more = {"offset": Slot(1, constant(torch.zeros(1, dtype=torch.float64)))}
        slopes = model.weight[: model.n_y], float(model.weight[model.n_y])
        super().__init__(signals, params, -slopes[0], slopes[1], model_for, more, ("offset",))
        hold_numbers(self, penalty=self.params.penalty, alpha=self.model.half_y * params.offset_filter)

    def formulas(self, p: Named) -> Named:
        """The model's terms, r(t+1) less the known part of y(t+1), and (1 - alpha) d1."""
        kept = (1 - self.params.offset_filter) * p["offset"]
        goal = target(p, self.params.preview) - self.model.middle_y - kept
        return {**self.model.terms(p), "goal": goal, "kept": kept}

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law with part ``arx`` as its first estimate; raises LawError."""
        return cls(signals, require_arx(models, cls.name), params)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        now = self.stage(self.memory.recall(sp, pv, mv_applied, state))
        estimate = self.model(now)
        theta = estimate.theta
        missed = self.alpha * (now["psi"] - (now["x"] * theta).sum(dim=-1, keepdim=True))
        gap = now["goal"] - missed - self.model.pv_unit * (now["x_ahead"] * theta).sum(dim=-1, keepdim=True)
        slope = estimate.slope
        c = slope * slope + self.penalty
        free, loud = self.gains.free(now, slope)
        z, changed = self.gains.settled(now, self.gains.update(now, slope * gap / c, c), free)
        mv = self.limited(now["mv"] + self.gains.step(now, z) * self.gains.unit, now["mv"])
        offset = now["kept"] + missed
        kept = {**estimate.kept, **loud, **changed, "offset": offset}
        state_next = self.memory.stored(now["known"], kept)
        return mv, state_next, torch.cat([self.gains.info_of(z, slope, free), offset], dim=-1)
