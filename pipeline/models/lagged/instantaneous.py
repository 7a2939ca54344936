"""An NNARX seen from one operating point: its linear model there, and its course along the newest MV."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.static.mlp import scaled_layers
from loopwright.pipeline.models.training.objectives import input_jacobian


class Linearized(NamedTuple):
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
def linearize(model: NNARX, phi: Tensor) -> Linearized:
    """Value and slopes of an NNARX at regressors phi (..., n_phi), for a batch at once.

    Source: [chen2004, eqs 10, 11, 13 and 14].
    """
    rows = phi.reshape(-1, phi.shape[-1])
    return Linearized(model(phi), input_jacobian(model.net, rows)[:, 0].reshape(phi.shape))


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
