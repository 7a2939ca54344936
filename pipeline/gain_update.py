"""One step of adapting PID gains: the bounded least-squares problem in closed form, and the forms of the gains."""

from __future__ import annotations

import torch
from torch import Tensor

# Times longer than this many periods say only that there is no such action.
LONGEST = 1e4


def gain_update(
    z_prev: Tensor, rho: Tensor, v: Tensor, c: Tensor, lam: Tensor, w: Tensor, lo: Tensor, hi: Tensor
) -> Tensor:
    """The gains z (..., 3) nearest to the last ones whose move rho'z is nearest to v.

        min  c/2 (rho'z - v)^2 + lambda/2 sum_i (z_i - z_prev_i)^2 / w_i   subject to   lo <= z <= hi

    The optimum is z = clip(z_prev + nu w rho, lo, hi), with nu the root of

        lambda nu + c sum_i min(q_i |nu|, B_i) sign(nu) = c T sign(nu),   q = w rho^2,   T = |v - rho'z_prev|

    where B_i >= 0 is how far gain i can push the move the wanted way before it meets its bound. The
    left side grows with nu and is linear between the three breakpoints B_i/q_i: a gain is at its
    bound if the left side at its own breakpoint is still below the right one. So the active set
    takes no iteration, and multiplied by q_i it takes no division: zero errors are no special case.

    Parameters
    ----------
    z_prev : (..., 3)
        Last gains, within their bounds.
    rho : (..., 3)
        What each gain is multiplied with to give the move.
    v, c : (..., 1)
        Wanted move; curvature c >= 0 of the objective along it.
    lam, w : (1,), (3,)
        Stiffness lambda > 0, and how easily each gain gives way, w > 0.
    lo, hi : (3,)
        Bounds.

    Source: seed 002_4e35f3d541bda8ae.txt, eqs 20-26. The matrix of eq. 22 has rank one and is never
    inverted; the stiffness, not in the paper, makes the optimum unique.
    """
    short = v - (rho * z_prev).sum(dim=-1, keepdim=True)
    push = torch.sign(short) * rho
    room = torch.maximum(push * (lo - z_prev), push * (hi - z_prev))  # B
    give = w * rho * rho  # q
    wanted = c * torch.abs(short)
    cross = room.unsqueeze(-1) * give.unsqueeze(-2)
    reached = c * torch.minimum(cross, cross.transpose(-1, -2)).sum(dim=-1)
    full = lam * room + reached < wanted * give
    nothing = torch.zeros_like(room)
    left = wanted - c * torch.where(full, room, nothing).sum(dim=-1, keepdim=True)
    nu = left / (lam + c * torch.where(full, nothing, give).sum(dim=-1, keepdim=True))
    return torch.minimum(torch.maximum(z_prev + nu * w * push, lo), hi)


def error_weights(z: Tensor) -> Tensor:
    """Weights (k0, k1, k2) of e(t), e(t-1), e(t-2) for the gains z = (kc, Ki, Kd), both (..., 3).

        rho'z = k0 e + k1 e1 + k2 e2,   Ki = kc dt/tau_i,   Kd = kc tau_d/dt

    Source: seed 002_4e35f3d541bda8ae.txt, eq. 4.
    """
    kc, ki, kd = z.unbind(-1)
    return torch.stack([kc + ki / 2 + kd, ki / 2 - kc - 2 * kd, kd], dim=-1)


def gains(k: Tensor) -> Tensor:
    """The gains z = (kc, Ki, Kd) of the weights (k0, k1, k2): the inverse of ``error_weights``.

    Source: eq. 4; eq. 25 there is the inverse of another form, without the trapezoidal integral.
    """
    k0, k1, k2 = k.unbind(-1)
    return torch.stack([(k0 - k1 - 3 * k2) / 2, k0 + k1 + k2, k2], dim=-1)


def pid_times(z: Tensor, period_s: float) -> Tensor:
    """(tau_i, tau_d) [s], shape (..., 2), of the gains z = (kc, Ki, Kd) >= 0, at most LONGEST periods.

    tau_i = kc dt/Ki,   tau_d = Kd dt/kc
    """
    of = z[..., [0, 2]]
    by = z[..., [1, 0]]
    tiny = torch.finfo(z.dtype).tiny
    return period_s * torch.clamp(of / torch.clamp(by, min=tiny), max=LONGEST)
