"""PID gains from the instantaneous linearization of an NNARX."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from pipeline.laws.base import require_kind
from pipeline.laws.linearized.nnarx_law import NnarxParams, NnarxPid
from pipeline.models.base import Model
from pipeline.models.lagged.next_output import Ahead
from pipeline.models.lagged.nnarx import NNARX
from pipeline.models.memory import Named, Slot, constant
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator

DOUBLINGS = 12


class LinearizedPid(NnarxPid):
    """PID whose gains give, within bounds, the minimum-variance move of the linearized network.

        min_du  (r - y0 - b du)^2 + mu du^2   ->   v = b (r - y0)/c,   c = b^2 + mu

    y0 is the network's y(t+1) without a move, offset included, b its slope over the move. With
    ``adaptive`` the penalty is doubled within the sample until the network agrees with its
    linearization at the move, |NN - linear| <= eps_high (at most 12 times), and halved once for the
    next sample, down to ``penalty_low``, where it agrees to eps_low already. All doublings are
    computed at once, as candidates, so that a step costs the same whatever it finds.

    Source: [chen2004, eqs 16-29 and section 4]; see ``NextOutput``,
    ``AdaptiveGains`` and ``gain_update`` for where this departs from it and why.
    """

    name: ClassVar[str] = "linearized_pid"
    title: ClassVar[str] = "PID from the linearized NNARX"

    @dataclass(frozen=True, slots=True)
    class Params(NnarxParams):
        """As NnarxParams, and the adaptive penalty, in whose place ``penalty`` then is not used.

        ``penalty_start`` and ``penalty_low`` [pv^2]: its first and its least value; ``eps_high`` and
        ``eps_low`` [pv]: linearization errors above which it doubles and below which it halves.
        """

        adaptive: bool = False
        penalty_start: float = 20.0
        penalty_low: float = 0.1
        eps_high: float = 0.2
        eps_low: float = 0.05

        def __post_init__(self) -> None:
            NnarxParams.__post_init__(self)
            if not 0 < self.penalty_low <= self.penalty_start:
                raise ValueError(
                    f"penalty_low is {self.penalty_low} and penalty_start {self.penalty_start}; "
                    "0 < penalty_low <= penalty_start must hold"
                )
            if not 0 <= self.eps_low < self.eps_high:
                raise ValueError(f"eps_low is {self.eps_low} and eps_high {self.eps_high}; give 0 <= low < high")

    penalty: Tensor  # (1,) fixed
    doubled: Tensor  # (DOUBLINGS + 1, 1) 1, 2, 4, ..
    allowed: Tensor  # (DOUBLINGS + 1, 1) linearization error of each; the last candidate has no choice
    penalty_low: Tensor  # (1,)
    eps_low: Tensor  # (1,)
    none: Tensor  # (1,) larger than any penalty

    def __init__(self, signals: Signals, model: NNARX, params: Params) -> None:
        start = torch.tensor([params.penalty_start], dtype=torch.float64)
        more = {"penalty": Slot(1, constant(start))} if params.adaptive else {}
        told = ("linearization_error", *more)
        super().__init__(signals, model, params, more=more, told=told)
        self.adaptive = params.adaptive
        numbers = {
            "penalty": [params.penalty],
            "doubled": [[2.0**j] for j in range(DOUBLINGS + 1)],
            "penalty_low": [params.penalty_low],
            "allowed": [[params.eps_high]] * DOUBLINGS + [[math.inf]],
            "eps_low": [params.eps_low],
            "none": [math.inf],
        }
        for name, values in numbers.items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64))

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over part ``nnarx``; raises LawError."""
        return cls(signals, require_kind(models, NNARX, cls.name), params)

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        past = self.memory.recall(sp, pv, mv_applied, state)
        if self.adaptive:
            past = past.unsqueeze(-2)  # candidates are rows
        now = self.stage(past)
        ahead = self.model(now)
        free, loud = self.gains.free(now, ahead.slope)
        if self.adaptive:
            z, error, penalty, following = self._searched(now, ahead, free)
        else:
            z = self._gains(now, ahead, self.penalty)
        z, changed = self.gains.settled(now, z, free)
        mv, moved = self.commanded(now, self.gains.step(now, z))
        told = [self.gains.told(z, ahead.slope, free), ahead.offset]
        given = {**ahead.kept, **loud, **changed}
        if self.adaptive:
            told, given = [*told, error, penalty], {**given, "penalty": following}
        else:
            told.append(self.linearization_error(ahead, moved))
        state_next, info = self.memory.stored(now["known"], given), torch.cat(told, dim=-1)
        if self.adaptive:
            return mv.squeeze(-2), state_next.squeeze(-2), info.squeeze(-2)
        return mv, state_next, info

    def _gains(self, now: Named, ahead: Ahead, penalty: Tensor) -> Tensor:
        """Gains (..., 3) for a penalty (..., 1)."""
        c = ahead.slope * ahead.slope + penalty
        return self.gains.update(now, ahead.slope * ahead.gap / c, c)

    def _searched(self, now: Named, ahead: Ahead, free: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gains, linearization error and penalty of the first candidate that agrees, and the next sample's penalty."""
        penalties = now["penalty"] * self.doubled
        z = self._gains(now, ahead, penalties)
        error = self.linearization_error(ahead, self.gains.step(now, z))
        penalty = torch.where(error <= self.allowed, penalties, self.none).amin(dim=-2, keepdim=True)
        first, nothing = penalties == penalty, torch.zeros_like(penalty)
        z, error = (torch.where(first, t, nothing).sum(dim=-2, keepdim=True) for t in (z, error))
        penalty = torch.where(free, penalty, now["penalty"])
        easy = free & (error < self.eps_low)
        following = torch.where(easy, torch.maximum(0.5 * penalty, self.penalty_low), penalty)
        return z, error, penalty, following
