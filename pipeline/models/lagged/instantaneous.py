"""An NNARX seen from one operating point: its linear model there, its course, and the next output without a move."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.memory import Named, Slot, lag_slots, regressors
from loopwright.pipeline.models.static.mlp import scaled_layers
from loopwright.pipeline.models.training.objectives import input_jacobian


class LinearizedNetwork(NamedTuple):
    """NN(phi) and dNN/dphi at a point, shapes (..., 1) and (..., n_phi), in engineering units."""

    value: Tensor
    slopes: Tensor

    def predict(self, step: Tensor) -> Tensor:
        """The tangent plane (..., 1) at phi + step, step (..., n_phi)."""
        return self.value + (self.slopes * step).sum(dim=-1, keepdim=True)


class Arx(NamedTuple):
    """y(t) = bias - sum_i a_i y(t-i) + sum_i b_i u(t-d-i+1): shapes (..., n_y), (..., n_u n_mv), (..., 1)."""

    a: Tensor
    b: Tensor
    bias: Tensor


@torch.no_grad()
def linearize(model: NNARX, phi: Tensor) -> LinearizedNetwork:
    """Value and slopes of an NNARX at regressors phi (..., n_phi), for a batch at once.

    Source: [chen2004, eqs 10, 11, 13 and 14].
    """
    rows = phi.reshape(-1, phi.shape[-1])
    return LinearizedNetwork(model(phi), input_jacobian(model.net, rows)[:, 0].reshape(phi.shape))


def arx(model: NNARX, phi: Tensor) -> Arx:
    """The linear model at phi (..., n_phi) in the signs of an ARX, which goes through NN(phi).

        a_i = -dNN/dy(t-i),   b_i = dNN/du(t-d-i+1),   bias = NN(phi) + sum_i a_i y(t-i) - sum_i b_i u(t-d-i+1)

    Source: [chen2004, eqs 9-12]; eqs 13 and 14 there have both slopes positive.
    """
    value, slopes = linearize(model, phi)
    bias = value - (slopes * phi).sum(dim=-1, keepdim=True)
    return Arx(-slopes[..., : model.n_y], slopes[..., model.n_y :], bias)


class AlongMv(nn.Module):
    """An NNARX and its slope along its newest MV.

        NN(phi),   dNN/ds of NN(phi + s e_u) at s = 0

    The slope comes forward through the layers along e_u alone, a fraction of all slopes. ``unit`` is
    the length of e_u [mv]; its sign too. Raises ModelError for a model of several MVs, or of a delay
    above 1: its newest MV would not act on y(t).
    """

    newest: Tensor  # (n_phi,) e_u
    first: Tensor  # (n_phi, H)
    first_bias: Tensor  # (H,)
    direction: Tensor  # (H,) e_u through the first layer
    out: Tensor  # (H_last, 1)
    residual: Tensor  # (n_phi, 1)
    offset: Tensor  # (1,)

    @torch.no_grad()
    def __init__(self, model: NNARX, unit: float = 1.0) -> None:
        super().__init__()
        if model.n_mv != 1 or model.delay != 1:
            raise ModelError(
                f"an NNARX of {model.n_mv} MVs and delay {model.delay} has no newest MV that acts on the next sample "
                "alone; take one MV and delay 1 (more MV lags n_u stand for a dead time)"
            )
        (first, first_bias), *hidden, (out, offset) = scaled_layers(model.net)
        residual, newest = torch.zeros(len(first), 1, dtype=torch.float64), torch.zeros(len(first), dtype=torch.float64)
        for column in model.net.residual:
            residual[column] = 1.0
        newest[model.n_y] = unit
        self.depth = len(hidden)
        buffers = {"newest": newest, "first": first, "first_bias": first_bias, "direction": newest @ first}
        for i, (weight, bias) in enumerate(hidden, start=1):
            buffers |= {f"weight{i}": weight, f"bias{i}": bias}
        for name, value in {**buffers, "out": out, "residual": residual, "offset": offset}.items():
            self.register_buffer(name, value)

    def value(self, phi: Tensor) -> Tensor:
        """NN(phi), shape (..., 1), at phi (..., n_phi)."""
        a = torch.tanh(phi @ self.first + self.first_bias)
        for weight, bias in self._hidden():
            a = torch.tanh(a @ weight + bias)
        return a @ self.out + phi @ self.residual + self.offset

    def value_and_slope(self, phi: Tensor) -> tuple[Tensor, Tensor]:
        """NN(phi) and its slope along e_u, (..., 1) each. The newest MV is no column of the residual."""
        a = torch.tanh(phi @ self.first + self.first_bias)
        tangent = (1 - a * a) * self.direction
        for weight, bias in self._hidden():
            a = torch.tanh(a @ weight + bias)
            tangent = (1 - a * a) * (tangent @ weight)
        return a @ self.out + phi @ self.residual + self.offset, tangent @ self.out

    def _hidden(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Weight (H, H') and bias (H',) of each hidden layer after the first."""
        return ((getattr(self, f"weight{i}"), getattr(self, f"bias{i}")) for i in range(1, self.depth + 1))


class Ahead(NamedTuple):
    """Forecast of y(t+1) without a move.

    ``phi`` (..., n_phi) is phi(t+1) with u(t) = u(t-1); ``y`` the forecast, offset included, ``slope`` its slope over
    the move, ``offset`` d(t), (..., 1) each; ``kept`` is what the law remembers.
    """

    phi: Tensor
    y: Tensor
    slope: Tensor
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
    and ``trust`` lie in (0, 1]. A law gives ``slots`` to its Memory.

    Source: [chen2004, eqs 9 and 18], which linearize at phi(t) and have no filter.
    """

    def __init__(self, model: NNARX, unit: float, offset_filter: float = 1.0, trust: float = 1.0) -> None:
        super().__init__()
        self.along = AlongMv(model, unit)
        self.n_y, self.n_u = model.n_y, model.n_u
        self.offset_filter, self.trust = offset_filter, trust
        self.slots = lag_slots(self.n_y, self.n_u, measured=trust == 1)
        if offset_filter < 1:
            self.slots["offset"] = Slot(1, torch.zeros(1, dtype=torch.float64))

    def forward(self, p: Named) -> Ahead:
        """The forecast, from the past and the sample by name."""
        now, ahead = regressors(p, self.n_y, self.n_u)
        surprise = p["y"] - self.along.value(now)
        offset, kept = surprise, {}
        if self.offset_filter < 1:
            # At the first sample all of the surprise is believed.
            share = 1 - (1 - self.offset_filter) * p["started"]
            offset = kept["offset"] = (1 - self.offset_filter) * p["offset"] + share * surprise
        if self.trust < 1:
            y = kept["y1"] = p["y"] - (1 - self.trust) * p["started"] * surprise
            _, ahead = regressors({**p, "y": y}, self.n_y, self.n_u)
        value, slope = self.along.value_and_slope(ahead)
        return Ahead(ahead, value + offset, slope, offset, kept)

    def moved(self, ahead: Ahead, move: Tensor) -> tuple[Tensor, Tensor]:
        """The forecast of y(t+1) and its slope after a move (..., 1) in units, (..., 1) each."""
        value, slope = self.along.value_and_slope(ahead.phi + move * self.along.newest)
        return value + ahead.offset, slope


class GaussNewton(nn.Module):
    """The move that brings y(t+1) nearest to r(t+1), by a few linearizations of the network.

        du_0 = 0,   du_{i+1} = du_i + (b_i (r - y_i) - mu du_i) / (b_i^2 + mu)

    with y_i what the network predicts for du_i and b_i its slope there: the Gauss-Newton steps of
    min (r - y)^2 + mu du^2. The numerator's sign tells on which side of du_i the minimum lies. The
    minimum lies between du_i and the nearest earlier move on that side (at first: what the actuator
    can do), and a step beyond that is replaced by half of the way there; without that, a plant that
    is steep in the middle and flat at its ends makes the steps, and then the loop, jump between two
    moves for ever. A slope below ``slope_min`` is taken for that, so that a dip of the network is
    crossed.

    ``forward`` gives the move (..., 1) in units and the last b^2 + mu.
    """

    penalty: Tensor  # (1,)
    slope_min: Tensor  # (1,)

    def __init__(self, model: NextOutput, times: int, penalty: float, slope_min: float) -> None:
        super().__init__()
        self.model, self.times = model, times
        for name, value in (("penalty", penalty), ("slope_min", slope_min)):
            self.register_buffer(name, torch.tensor([value], dtype=torch.float64))

    def forward(self, ahead: Ahead, goal: Tensor, down: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
        """Towards ``goal`` = r(t+1), within the room ``down`` <= move <= ``up``, (..., 1) each, moves in units."""
        slope = torch.maximum(ahead.slope, self.slope_min)
        curvature = slope * slope + self.penalty
        push = slope * (goal - ahead.y)
        last, move = torch.zeros_like(push), torch.minimum(torch.maximum(push / curvature, down), up)
        end = torch.where(push > 0, up, down)
        for _ in range(self.times - 1):
            y, slope = self.model.moved(ahead, move)
            slope = torch.maximum(slope, self.slope_min)
            curvature = slope * slope + self.penalty
            before, push = push, slope * (goal - y) - self.penalty * move
            # On to the same end, or back: then the last move is the end.
            end = torch.where(push * before > 0, end, last)
            newton, way = push / curvature, end - move
            step = torch.where(newton.abs() <= way.abs(), newton, 0.5 * way)
            last, move = move, move + step
        return move, curvature
