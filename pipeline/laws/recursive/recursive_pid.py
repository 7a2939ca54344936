"""PID gains from a linear model that is learnt on at every sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from pipeline.laws.adaptive import (
    AdaptiveGains,
    AdaptiveParams,
    minimum_variance_gains,
    signed_unit,
    target,
    target_slots,
)
from pipeline.laws.base import ControlLaw, require_single_loop
from pipeline.laws.recursive.arx_law import estimator, require_arx
from pipeline.models.base import Model
from pipeline.models.lagged.arx import ARX
from pipeline.models.memory import Memory, Named, Slot, Stage, constant
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator


class RecursivePid(ControlLaw):
    """PID whose gains give, within bounds, the minimum-variance move of a recursively estimated ARX model.

        min_du  (r - y0 - b du)^2 + mu du^2   ->   v = b (r - y0)/c,   c = b^2 + mu
        y0 = theta' x(t+1) with u(t) = u(t-1), plus d;   d = (1 - alpha) d1 + alpha (y - theta' x(t))

    with theta after this sample's update by recursive least squares with forgetting, begun from
    part ``arx``; parameters and covariance are in the state. It knows only what the recent past
    has shown, where ``linearized_pid`` knows the plant at the point it is at.

    Source: REC-LINPID of [chen2004, section 5], with eqs 16-28 as its control law.
    """

    name: ClassVar[str] = "recursive_pid"
    title: ClassVar[str] = "PID from a recursive linear model"
    incremental: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True)
    class Params(AdaptiveParams):
        """As AdaptiveParams, and the estimator.

        ``forgetting`` in (0, 1]; ``covariance`` the first and largest one, of parameters and signals
        scaled to the order of one; ``offset_filter`` alpha in [0, 1], 0 to leave d out.
        """

        forgetting: float = 0.98
        covariance: float = 1.0
        offset_filter: float = 1.0

        def __post_init__(self) -> None:
            AdaptiveParams.__post_init__(self)
            if not 0 <= self.offset_filter <= 1:
                raise ValueError(f"offset_filter is {self.offset_filter}; it must lie in [0, 1]")

    penalty: Tensor  # (1,)
    alpha: Tensor  # (1,) [pv]

    def __init__(self, signals: Signals, model: ARX, params: Params) -> None:
        super().__init__(signals, params.mv_rate)
        require_single_loop(signals, self.name)
        b = float(model.weight[model.n_y])
        unit = signed_unit(signals, params.plant_gain, b)
        start = params.gains or minimum_variance_gains(-model.weight[: model.n_y], b * unit, params)
        self.model = estimator(
            self.name, signals, model, unit, forgetting=params.forgetting, covariance=params.covariance
        )
        self.gains = AdaptiveGains(params, signals, unit, start)
        numbers = {
            "penalty": [params.penalty],
            "alpha": [self.model.half_y * params.offset_filter],
        }
        for name, values in numbers.items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64))
        nothing = constant(torch.zeros(1, dtype=torch.float64))
        self.memory = Memory(
            {**target_slots(params.preview), **self.model.slots, **self.gains.slots, "offset": Slot(1, nothing)}
        )
        keep = 1 - params.offset_filter

        def terms(p: Named) -> Named:
            goal = target(p, params.preview) - self.model.middle_y - keep * p["offset"]
            return {
                "known": self.memory.then(p),
                **self.gains.terms(p),
                **self.model.terms(p),
                "goal": goal,
                "kept": keep * p["offset"],
            }

        self.stage = Stage(self.memory.layout, terms)
        self.n_state = self.memory.n_state
        self.info = (*AdaptiveGains.info, "offset")

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law with part ``arx`` as its first estimate; raises LawError."""
        return cls(signals, require_arx(models, cls.name), params)

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
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
        return mv, self.memory.stored(now["known"], kept), torch.cat([self.gains.told(z, slope, free), offset], dim=-1)
