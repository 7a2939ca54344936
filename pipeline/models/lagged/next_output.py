"""An NNARX in a control law: the next output without a move, its offset to the plant, and its slope over the move."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from pipeline.models.lagged.instantaneous import AlongMv
from pipeline.models.lagged.nnarx import NNARX
from pipeline.models.memory import Named, Slot, constant, lag_slots, regressors


class Ahead(NamedTuple):
    """Forecast of y(t+1): ``gap`` = r(t+1) - y0(t+1) and its slope over the move, (..., 1) each.

    ``at`` is the network's preactivation without a move, ``rest`` its output there less what is
    affine; ``offset`` is y(t) - NN(phi(t)), filtered; ``kept`` is what the law remembers.
    """

    gap: Tensor
    slope: Tensor
    rest: Tensor
    at: Tensor
    offset: Tensor
    kept: dict[str, Tensor]


class NextOutput(nn.Module):
    """Predictions of y(t+1) by an NNARX, free of offset.

        y0(t+1) = NN(phi(t+1) with u(t) = u(t-1)) + d(t),   d = y(t) - NN(phi(t))

    Linearizing at phi(t+1), not at phi(t), makes the linear model exact where there is no move.
    With ``offset_filter`` alpha below 1 noise is kept out of d:

        d(t) = (1 - alpha) d(t-1) + alpha (y(t) - NN(phi(t)))

    and with ``trust`` below 1 out of the lags, which then hold NN(phi) + trust (y - NN(phi)), an
    observer of the output. The first sample is believed as it is.

    ``model`` has one MV and delay 1, or ModelError is raised; ``unit`` [mv] is one unit of move, with its sign; alpha
    and ``trust`` lie in (0, 1]. A law gives ``slots`` to its Memory and ``terms`` to its Stage.

    Source: [chen2004, eqs 9 and 18], which linearize at phi(t) and have no filter.
    """

    doubt: Tensor  # (1,) 1 - trust
    kept_share: Tensor  # (1,) 1 - alpha
    newest: Tensor  # (H,) change of the preactivation by y(t)
    newest_base: Tensor  # (1,) change of the base by y(t)

    def __init__(self, model: NNARX, unit: float, offset_filter: float = 1.0, trust: float = 1.0) -> None:
        super().__init__()
        self.along = AlongMv(model, unit)
        self.n_y, self.n_u = model.n_y, model.n_u
        self.filtered, self.doubted = offset_filter < 1, trust < 1
        self.register_buffer("doubt", torch.tensor([1 - trust], dtype=torch.float64))
        self.register_buffer("kept_share", torch.tensor([1 - offset_filter], dtype=torch.float64))
        self.register_buffer("newest", self.doubt * self.along.first[0])
        self.register_buffer("newest_base", self.doubt * self.along.base_slope[0])
        self.slots = lag_slots(self.n_y, self.n_u, measured=not self.doubted)
        if self.filtered:
            self.slots["offset"] = Slot(1, constant(torch.zeros(1, dtype=torch.float64)))

    def terms(self, p: Named, target: Tensor) -> dict[str, Tensor]:
        """Formulas of what the prediction needs of the past and the sample; ``target`` is that of r(t+1)."""
        now, ahead = regressors(p, self.n_y, self.n_u)
        found = {
            "now": self.along.preactivation(now),
            "ahead": self.along.preactivation(ahead),
            "measured": p["y"] - self.along.base(now),
            "goal": target - self.along.base(ahead),
        }
        if self.filtered or self.doubted:
            found["started"] = p["started"]
        if self.filtered:
            found["offset"] = self.kept_share * p["offset"]
        if self.doubted:
            found["y"] = p["y"]
        return found

    def forward(self, now: Named) -> Ahead:
        """The prediction from the results of ``terms``."""
        surprise = now["measured"] - self.along.rest(now["now"])
        offset, at, goal, kept = surprise, now["ahead"], now["goal"], {}
        if self.filtered or self.doubted:
            known = now["started"] * surprise
        if self.filtered:
            offset = surprise - self.kept_share * known + now["offset"]
            kept["offset"] = offset
        if self.doubted:
            at = at - known * self.newest
            goal = goal + known * self.newest_base
            kept["y1"] = now["y"] - known * self.doubt
        rest, slope = self.along.rest_and_slope(at)
        return Ahead(goal - rest - offset, slope, rest, at, offset, kept)

    def moved(self, ahead: Ahead, step: Tensor) -> Tensor:
        """Change of y(t+1) by a move of ``step`` units, as the network says, (..., 1)."""
        return self.along.rest(self.along.moved(ahead.at, step)) - ahead.rest

    def relinearized(self, ahead: Ahead, step: Tensor) -> tuple[Tensor, Tensor]:
        """``rest`` and ``slope`` at a move of ``step`` units, (..., 1) each."""
        return self.along.rest_and_slope(self.along.moved(ahead.at, step))


class GaussNewton(nn.Module):
    """The move that brings y(t+1) nearest to r(t+1), by a few linearizations of the network.

        du_0 = 0,   du_{i+1} = du_i + (b_i (r - y_i) - mu du_i) / (b_i^2 + mu)

    with y_i what the network predicts for du_i and b_i its slope there: the Gauss-Newton steps of
    min (r - y)^2 + mu du^2. The numerator's sign tells on which side of du_i the minimum lies. Two
    such moves enclose it (at first: what the actuator can do), and a step that leads out of them is
    replaced by their middle; without that, a plant that is steep in the middle and flat at its
    ends makes the steps, and then the loop, jump between two moves for ever. A slope below
    ``slope_min`` is taken for that, so that a dip of the network is crossed.

    ``forward`` gives the move (..., 1) in units and the last b^2 + mu.
    """

    penalty: Tensor  # (1,)
    slope_min: Tensor  # (1,)

    def __init__(self, model: NextOutput, times: int, penalty: float, slope_min: float) -> None:
        super().__init__()
        self.model, self.times = model, times
        for name, value in (("penalty", penalty), ("slope_min", slope_min)):
            self.register_buffer(name, torch.tensor([value], dtype=torch.float64))

    def forward(self, ahead: Ahead, down: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
        """Within the room ``down`` <= move <= ``up``, (..., 1) each, in units."""
        slope = torch.maximum(ahead.slope, self.slope_min)
        curvature = slope * slope + self.penalty
        push = slope * ahead.gap
        move = torch.minimum(torch.maximum(push / curvature, down), up)
        nothing, goal = torch.zeros_like(move), ahead.gap + ahead.rest
        more = push > 0
        low, high = torch.where(more, nothing, down), torch.where(more, up, nothing)
        for _ in range(self.times - 1):
            rest, slope = self.model.relinearized(ahead, move)
            slope = torch.maximum(slope, self.slope_min)
            curvature = slope * slope + self.penalty
            push = slope * (goal - rest) - self.penalty * move
            more = push > 0
            low, high = torch.where(more, move, low), torch.where(more, high, move)
            newton = move + push / curvature
            # At the minimum itself the step is zero and the move an end of what encloses it.
            inside = (newton >= low) & (newton <= high)
            move = torch.where(inside, newton, 0.5 * (low + high))
        return move, curvature
