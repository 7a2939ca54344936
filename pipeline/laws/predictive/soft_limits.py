"""The cost of outputs beyond their limits, and the quadratic that stands for it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from loopwright.pipeline.laws.base import hold_numbers
from loopwright.pipeline.laws.predictive.params import PredictiveParams, limits_of
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Signals

PRICE = 30.0  # of a scaled unit beyond a limit, in units of the largest weight of an error
EPS = 0.03  # scaled: what lies beyond a limit by less counts by its square
SOFT = 0.003  # scaled: where the curvature begins, so that the law has no jump at a limit


class LimitCost(NamedTuple):
    """For each output over the horizon: the weight of a quadratic that stands for the limits' cost, and its slope."""

    weight: Tensor  # (..., 1, N n_cv)
    slope: Tensor  # (..., 1, N n_cv)


def limit_cost(y: Tensor, low: Tensor, high: Tensor, price: Tensor, soft: Tensor, eps_squared: Tensor) -> LimitCost:
    """The push on outputs y (..., 1, N n_cv) that lie outside low..high, as ``SoftLimits`` says; all scaled."""
    beyond = y - torch.minimum(torch.maximum(y, low), high)
    size = beyond.abs()
    weight = price * size / ((size + soft) * torch.sqrt(size * size + eps_squared))
    return LimitCost(weight, weight * beyond)


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

    def forward(self, y: Tensor) -> LimitCost:
        """The push on outputs y (..., 1, N n_cv), scaled."""
        return limit_cost(y, self.low, self.high, self.price, self.soft, self.eps_squared)


def scaled_limits(signals: Signals, model: Identified, params: PredictiveParams) -> tuple[Tensor, Tensor] | None:
    """The CVs' limits, scaled, (n_cv,) each; None where there are none. Raises as ``limits_of``."""
    found, n_cv = limits_of(signals, params), len(signals.sp)
    if found is None:
        return None
    low, high = ((torch.from_numpy(end) - model.y_center[:n_cv]) / model.y_scale[:n_cv] for end in found)
    return low, high
