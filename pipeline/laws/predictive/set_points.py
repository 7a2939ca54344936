"""The set points over a horizon, as they are or with their slope, and soft limits of the controlled variables."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from loopwright.pipeline.laws.base import hold_numbers


class SetPointCourse(nn.Module):
    """Set points r(k+1) .. r(k+N) from those of now and, with ``ramp``, of the two samples before.

        held:  r(k+i) = r(k)
        ramp:  r(k+i) = clip(r(k) + i s),   s = the smaller of r(k) - r(k-1) and r(k-1) - r(k-2)

    s is 0 where the two changes differ in their signs or one is 0: a step of the set point is no ramp, and the slope
    of a recipe is believed from its second sample on. ``bounds`` are the ends of the clip: the CVs' soft limits, as a
    set point beyond a limit counts as one at the limit, and with ``ramp`` the signals' ranges too.
    """

    low: Tensor | None  # (N n_cv,) scaled
    high: Tensor | None
    samples: Tensor | None  # (N n_cv,) i

    def __init__(self, horizon: int, n_cv: int, bounds: tuple[Tensor, Tensor] | None, *, ramp: bool) -> None:
        super().__init__()
        self.horizon, self.ramp = horizon, ramp
        low, high = (None, None) if bounds is None else (end.repeat(horizon) for end in bounds)
        samples = torch.arange(1, horizon + 1, dtype=torch.float64).repeat_interleave(n_cv) if ramp else None
        for name, values in {"low": low, "high": high, "samples": samples}.items():
            self.register_buffer(name, values)

    def forward(self, now: Tensor, past: list[Tensor]) -> Tensor:
        """The set points (..., 1, N n_cv), from ``now`` (..., 1, n_cv); ``past`` [r(k-1), r(k-2)] with ``ramp``."""
        course = self._held(now)
        if self.samples is not None:
            last, older = past
            change, before = now - last, last - older
            slope = torch.minimum(torch.maximum(change, before.clamp(max=0.0)), before.clamp(min=0.0))
            course = course + self.samples * self._held(slope)
        if self.low is not None and self.high is not None:
            course = torch.minimum(torch.maximum(course, self.low), self.high)
        return course

    def _held(self, values: Tensor) -> Tensor:
        """Each of (..., 1, n_cv) at every sample of the horizon."""
        return values.repeat(*(1 for _ in values.shape[:-1]), self.horizon)


# --------------------------------------------------------------------------------------------------------- soft limits
PRICE = 30.0  # of a scaled unit beyond a limit, in units of the largest weight of an error
EPS = 0.03  # scaled: what lies beyond a limit by less counts by its square
SOFT = 0.003  # scaled: where the curvature begins, so that the law has no jump at a limit


class Push(NamedTuple):
    """For each output over the horizon: the weight of a quadratic that stands for the limits' cost, and its slope."""

    weight: Tensor  # (..., 1, N n_cv)
    slope: Tensor  # (..., 1, N n_cv)


class SoftLimits(nn.Module):
    """The cost of outputs beyond their limits: sum p(b) over all samples, with the slope of p.

        p'(b) = w(b) b,   w(b) = rho |b|/((|b| + delta) sqrt(b^2 + eps^2)),   b = y - clip(y, low, high)

    It is convex and of the same kind as the errors' cost sqrt(b^2 + eps^2), with a curvature that begins at 0. Its
    slope grows to rho, above that of the errors, so that errors are left where a limit asks for it: a limit gives way
    only where no plan within the MVs' ranges keeps it, or where it would cost the other CVs more than rho. Where they
    would gain l < rho by a unit of b, the plan ends at p'(b) = l; that is b = .005 for l = rho/10, .02 for rho/2.

    Source: exact penalties, Kerrigan and Maciejowski, Soft constraints and exact penalty functions in model
    predictive control, UKACC International Conference Control 2000, Cambridge.
    """

    low: Tensor  # (N n_cv,) scaled
    high: Tensor  # (N n_cv,)
    price: Tensor  # (1,) rho
    soft: Tensor  # (1,) delta
    eps_squared: Tensor  # (1,)

    def __init__(self, low: Tensor, high: Tensor, price: float, horizon: int) -> None:
        super().__init__()
        self.register_buffer("low", low.repeat(horizon))
        self.register_buffer("high", high.repeat(horizon))
        hold_numbers(self, price=price, soft=SOFT, eps_squared=EPS**2)

    def forward(self, y: Tensor) -> Push:
        """The push on outputs y (..., 1, N n_cv), scaled."""
        beyond = y - torch.minimum(torch.maximum(y, self.low), self.high)
        size = beyond.abs()
        weight = self.price * size / ((size + self.soft) * torch.sqrt(size * size + self.eps_squared))
        return Push(weight, weight * beyond)
