"""PID gains from an NNARX that is linearized again within the sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from pipeline.laws.base import require_kind
from pipeline.laws.linearized.nnarx_law import NnarxParams, NnarxPid
from pipeline.models.base import Model
from pipeline.models.lagged.next_output import GaussNewton
from pipeline.models.lagged.nnarx import NNARX
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator


class GaussNewtonPid(NnarxPid):
    """PID whose gains give, within bounds, the minimum-variance move of the network itself.

        min_du  (r - y(t+1))^2 + mu du^2,   y(t+1) by the network

    solved by a few Gauss-Newton steps, each a linearization at the move so far, and limited to what
    the actuator can do; the gains are then updated towards that move. Where a single linearization
    needs a large penalty not to overshoot a curved plant, this needs next to none.

    Source: not in [chen2004], which linearizes once and adapts the penalty instead
    (eqs 16-29).
    """

    name: ClassVar[str] = "gauss_newton_pid"
    title: ClassVar[str] = "PID from the NNARX, relinearized within the sample"

    @dataclass(frozen=True, slots=True)
    class Params(NnarxParams):
        """As NnarxParams, with a smaller penalty; ``relinearize`` is the number of linearizations, 1 or more."""

        penalty: float = 0.1
        relinearize: int = 5

        def __post_init__(self) -> None:
            NnarxParams.__post_init__(self)
            if self.relinearize < 1:
                raise ValueError(f"relinearize is {self.relinearize}; give 1 or more linearizations a sample")

    def __init__(self, signals: Signals, model: NNARX, params: Params) -> None:
        super().__init__(signals, model, params, told=("linearization_error",), bounded=True)
        self.search = GaussNewton(self.model, params.relinearize, params.penalty, params.slope_min)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over part ``nnarx``; raises LawError."""
        return cls(signals, require_kind(models, NNARX, cls.name), params)

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        now = self.stage(self.memory.recall(sp, pv, mv_applied, state))
        ahead = self.model(now)
        free, loud = self.gains.free(now, ahead.slope)
        move, curvature = self.search(ahead, now["down"], now["up"])
        z, changed = self.gains.settled(now, self.gains.update(now, move, curvature), free)
        mv, moved = self.commanded(now, self.gains.step(now, z))
        told = [self.gains.told(z, ahead.slope, free), ahead.offset, self.linearization_error(ahead, moved)]
        state_next = self.memory.stored(now["known"], {**ahead.kept, **loud, **changed})
        return mv, state_next, torch.cat(told, dim=-1)
