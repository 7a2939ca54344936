"""Soft limits of the controlled variables in the cost of a plan."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from pipeline.laws.base import hold_numbers

PRICE = 30.0  # of a scaled unit beyond a limit, in units of the largest weight of an error
EPS = 0.03  # scaled: what lies beyond a limit by less counts by its square


class Push(NamedTuple):
    """Of each output over the horizon: the weight of a quadratic cost that touches the limits', and its slope."""

    weight: Tensor  # (..., 1, N n_cv)
    slope: Tensor  # (..., 1, N n_cv)


class SoftLimits(nn.Module):
    """What the outputs cost beyond their limits, sample by sample.

        rho sum sqrt(b^2 + eps^2),   b = y - clip(y, low, high)

    It is of the same form as the errors' cost, and convex. Its slope grows to rho, above that of the errors, so that
    errors are left where a limit asks for it: a limit gives way only where no plan within the MVs' ranges keeps it,
    or where it would cost the other CVs more than rho.

    Source: exact penalties, Kerrigan and Maciejowski, Soft constraints and exact penalty functions in model
    predictive control, UKACC International Conference (Control 2000), 2319.
    """

    low: Tensor  # (N n_cv,) scaled
    high: Tensor  # (N n_cv,)
    price: Tensor  # (1,) rho
    none: Tensor  # (1,) 0
    eps_squared: Tensor  # (1,)

    def __init__(self, low: Tensor, high: Tensor, price: float, horizon: int) -> None:
        super().__init__()
        self.register_buffer("low", low.repeat(horizon))
        self.register_buffer("high", high.repeat(horizon))
        hold_numbers(self, price=price, none=0.0, eps_squared=EPS**2)

    def forward(self, y: Tensor) -> Push:
        """The push on outputs y (..., 1, N n_cv), scaled."""
        beyond = y - torch.minimum(torch.maximum(y, self.low), self.high)
        weight = torch.where(beyond == 0, self.none, self.price / torch.sqrt(beyond * beyond + self.eps_squared))
        return Push(weight, weight * beyond)
