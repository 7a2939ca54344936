"""PID gains from the instantaneous linearization of an NNARX."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from loopwright.pipeline.laws.adaptive import move, target
from loopwright.pipeline.laws.base import Stepped, hold_numbers
from loopwright.pipeline.laws.linearized.nnarx_law import NnarxParams, NnarxPid
from loopwright.pipeline.laws.scaled_defaults import ascend, in_units
from loopwright.pipeline.models.lagged.next_output import Ahead
from loopwright.pipeline.models.lagged.nnarx import NNARX
from loopwright.pipeline.models.memory import Named, Slot
from loopwright.pipeline.plants.signals import Signals

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
        """Parameters of NnarxParams, and the penalty that ``adaptive`` puts in the place of ``penalty``.

        ``penalty_start`` and ``penalty_low`` [pv^2]: its first and its least value, None as ``penalty``;
        ``eps_high`` and ``eps_low`` [pv]: linearization errors above which it doubles and below which it
        halves; ``adaptive`` needs an ``eps_high`` above 0.
        """

        adaptive: bool = False
        penalty_start: float | None = None
        penalty_low: float | None = None
        eps_high: float = 0.0
        eps_low: float = 0.0

        def __post_init__(self) -> None:
            NnarxParams.__post_init__(self)
            start, low = self.penalties
            if not (low > 0 and (low == start or ascend(low, start))):
                raise ValueError(f"penalty_low is {low} and penalty_start {start}; give 0 < low <= start")
            if not (0 <= self.eps_low < self.eps_high or (self.eps_low == self.eps_high == 0 and not self.adaptive)):
                raise ValueError(f"eps_low is {self.eps_low} and eps_high {self.eps_high}; give 0 <= low < high")

        @property
        def penalties(self) -> tuple[float, float]:
            """The first and the least penalty."""
            start = self.penalty if self.penalty_start is None else self.penalty_start
            return start, self.penalty if self.penalty_low is None else self.penalty_low

    params: Params
    penalty: Tensor  # (1,) fixed
    doubled: Tensor  # (DOUBLINGS + 1, 1) 1, 2, 4, ..
    allowed: Tensor  # (DOUBLINGS + 1, 1) linearization error of each; the last candidate has no choice
    penalty_low: Tensor  # (1,)
    eps_low: Tensor  # (1,)
    none: Tensor  # (1,) larger than any penalty

    def __init__(self, signals: Signals, model: NNARX, params: Params) -> None:
        params = in_units(params, signals, self.name)
        start, low = params.penalties
        more = {"penalty": Slot(1, torch.tensor([start], dtype=torch.float64))} if params.adaptive else {}
        super().__init__(signals, model, params, more, ("linearization_error", *more))
        self.adaptive = params.adaptive
        hold_numbers(
            self,
            penalty=params.penalty,
            doubled=[[2.0**j] for j in range(DOUBLINGS + 1)],
            penalty_low=low,
            allowed=[[params.eps_high]] * DOUBLINGS + [[math.inf]],
            eps_low=params.eps_low,
            none=math.inf,
        )

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.memory.recall(sp, pv, mv_applied, state)
        if self.adaptive:
            p = {name: value.unsqueeze(-2) for name, value in p.items()}  # candidates are rows
        ahead, rho = self.model(p), self.gains.errors(p)
        gap = target(p, self.params.preview) - ahead.y
        free, loud = self.gains.free(p, ahead.slope)
        if self.adaptive:
            z, error, penalty, following = self._searched(p, rho, ahead, gap, free)
        else:
            z = self._gains(p, rho, ahead.slope, gap, self.penalty, free)
        z, changed = self.gains.settled(p, z, free)
        mv, moved = self.commanded(p, move(rho, z))
        shown = [self.gains.info_of(z, ahead.slope, free), ahead.offset]
        given = {**ahead.kept, **loud, **changed}
        if self.adaptive:
            shown, given = [*shown, error, penalty], {**given, "penalty": following}
        else:
            shown.append(self.linearization_error(ahead, moved))
        state_next, info = self.memory.stored(p, given), torch.cat(shown, dim=-1)
        if self.adaptive:
            return mv.squeeze(-2), state_next.squeeze(-2), info.squeeze(-2)
        return mv, state_next, info

    def _gains(self, p: Named, rho: Tensor, slope: Tensor, gap: Tensor, penalty: Tensor, free: Tensor) -> Tensor:
        """Gains (..., 3) for a penalty (..., 1)."""
        c = slope * slope + penalty
        return self.gains.update(p, rho, slope * gap / c, c, free)

    def _searched(
        self, p: Named, rho: Tensor, ahead: Ahead, gap: Tensor, free: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gains, linearization error and penalty of the first candidate that agrees, and the next sample's penalty."""
        penalties = p["penalty"] * self.doubled
        z = self._gains(p, rho, ahead.slope, gap, penalties, free)
        error = self.linearization_error(ahead, move(rho, z))
        penalty = torch.where(error <= self.allowed, penalties, self.none).amin(dim=-2, keepdim=True)
        first, nothing = penalties == penalty, torch.zeros_like(penalty)
        z, error = (torch.where(first, t, nothing).sum(dim=-2, keepdim=True) for t in (z, error))
        penalty = torch.where(free > 0, penalty, p["penalty"])
        easy = (free > 0) & (error < self.eps_low)
        following = torch.where(easy, torch.maximum(0.5 * penalty, self.penalty_low), penalty)
        return z, error, penalty, following
