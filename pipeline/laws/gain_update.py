"""One step of adapting PID gains: the bounded least-squares problem in closed form, and what gains mean."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from loopwright.pipeline.laws.base import hold_numbers

LONGEST_ACTION = 1e4  # periods; a time as long says only that there is no such action
NEXT_TO_NOTHING = 1e-8  # share of its bound at which a gain counts as none


def gain_update(
    z_prev: Tensor, rho: Tensor, v: Tensor, c: Tensor, lam: Tensor, w: Tensor, lo: Tensor, hi: Tensor, free: Tensor
) -> Tensor:
    """The gains z (..., 3) nearest to the last ones whose move rho'z is nearest to v.

        min  1/2 (rho'z - v)^2 + s/2 sum_i (z_i - z_prev_i)^2 / w_i   subject to   lo <= z <= hi,   s = lambda/c

    The optimum is z = clip(z_prev + nu w rho, lo, hi), with nu the root of

        s nu + sum_i min(q_i |nu|, B_i) sign(nu) = T sign(nu),   q = w rho^2,   T = |v - rho'z_prev|

    where B_i >= 0 is how far gain i can push the move the wanted way before it meets its bound. The
    left side grows with nu and is linear between the three breakpoints B_i/q_i: a gain is at its
    bound if the left side at its own breakpoint is still below the right one. So the active set
    takes no iteration, and multiplied by q_i it takes no division: zero errors are no special case.

    ``z_prev`` (..., 3): the last gains, within their bounds ``lo`` and ``hi`` (3,). ``rho`` (..., 3): what each gain
    is multiplied with to give the move. ``v``, ``c`` (..., 1): the wanted move, and the curvature c >= 0 of the
    law's objective along it. ``lam`` (1,): stiffness lambda > 0; ``w`` (3,) > 0: how easily each gain gives way.
    ``free`` (..., 1): 1, or 0 where the gains stay as they are.

    Source: [chen2004, eqs 20-26]. The matrix of eq. 22 has rank one and is never
    inverted; the stiffness, not in the paper, makes the optimum unique.
    """
    stiffness = lam / c  # s
    short = free * (v - (rho * z_prev).sum(dim=-1, keepdim=True))
    push = torch.sign(short) * rho
    ease = w * push
    give = ease * push  # q
    room = torch.maximum(push * (lo - z_prev), push * (hi - z_prev))  # B
    cross = room.unsqueeze(-1) * give.unsqueeze(-2)
    reached = torch.minimum(cross, cross.transpose(-1, -2)).sum(dim=-1)
    full = (stiffness * room + reached < torch.abs(short) * give).to(rho.dtype)
    left = torch.abs(short) - (full * room).sum(dim=-1, keepdim=True)
    nu = left / (stiffness + ((1 - full) * give).sum(dim=-1, keepdim=True))
    return torch.minimum(torch.maximum(z_prev + nu * ease, lo), hi)


class PidForm(nn.Module):
    """kc [mv/pv], tau_i and tau_d [s], shape (..., 3), of gains z = (kc, Ki, Kd) >= 0 of one ``unit`` of move [mv].

        tau_i = kc dt/Ki,   tau_d = Kd dt/kc

    A gain that is nothing beside its bound in ``largest`` counts as none, and no time is longer than LONGEST_ACTION
    periods: what is divided by next to nothing is rounding, and has no meaning either.

    Source: [chen2004, eq. 4]; eq. 25 there is the inverse of another form, without the
    trapezoidal integral.
    """

    forms: Tensor  # (3, 5): z -> kc dt, Kd dt, Ki, kc, kc unit
    least: Tensor  # (2,) of Ki and kc
    longest: Tensor  # (1,) [s]

    def __init__(self, period_s: float, unit: float, largest: Sequence[float]) -> None:
        super().__init__()
        h = period_s
        hold_numbers(
            self,
            forms=[[h, 0, 0, 1, unit], [0, 0, 1, 0, 0], [0, h, 0, 0, 0]],
            least=[NEXT_TO_NOTHING * largest[1], NEXT_TO_NOTHING * largest[0]],
            longest=LONGEST_ACTION * h,
        )

    def forward(self, z: Tensor) -> Tensor:
        """Shape (..., 3), of gains (..., 3)."""
        of, by, kc = torch.split(z @ self.forms, [2, 2, 1], dim=-1)
        return torch.cat([kc, torch.minimum(of / torch.maximum(by, self.least), self.longest)], dim=-1)
