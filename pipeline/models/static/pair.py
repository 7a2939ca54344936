"""Two models and the linear arithmetic around them as few matrix products: a node costs more than a product."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pipeline.models.base import Model
from pipeline.models.static.mlp import MLP, scaled_layers

Combine = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a vector z holds the states (n,) of the two models and the one MV that both are asked for."""

    n_z: int
    n: int
    first: int
    second: int
    mv: int


class Pair(nn.Module):
    """``combine(f, g, z)`` of two models over [x, u], both asked for u = [z_mv, grid].

        f = first(z_first, u), g = second(z_second, u),   shapes (..., K);  z (..., n_z) -> (..., n_out)

    ``combine`` must be linear in (f, g, z) together. Two MLPs with the same hidden layers then become
    one network: the first layer maps z to the hidden units of every candidate of both, the hidden
    layers are products of stacks of two, and the last layer, the residual columns and ``combine``
    are one matrix, found by asking ``combine`` for every unit vector. Other models are evaluated
    one after the other, as the formulas stand.
    """

    grid: Tensor  # (K - 1,)

    def __init__(self, first: Model, second: Model, grid: Tensor, layout: Layout, combine: Combine) -> None:
        super().__init__()
        self.layout, self.combine = layout, combine
        self.register_buffer("grid", grid)
        self.fused = None
        if isinstance(first, MLP) and isinstance(second, MLP) and _alike(first, second):
            self.fused = _Fused((first, second), grid, layout, combine)
        else:
            self.first, self.second = first, second

    def forward(self, z: Tensor) -> Tensor:
        """Shape (..., n_out)."""
        return self.plain(z, self.first, self.second) if self.fused is None else self.fused(z)

    def plain(self, z: Tensor, first: Model, second: Model) -> Tensor:
        """The same, as the formulas stand."""
        at = self.layout
        u = torch.cat([z[..., at.mv : at.mv + 1], self.grid.expand(*z.shape[:-1], len(self.grid))], dim=-1)
        f = candidates(first, z[..., at.first : at.first + at.n], u)
        g = candidates(second, z[..., at.second : at.second + at.n], u)
        return self.combine(f, g, z)


def candidates(model: Model, x: Tensor, u: Tensor) -> Tensor:
    """Predictions (..., K) of a model over [x, u] at one state x (..., n) for candidates u (..., K)."""
    if isinstance(model, MLP):
        return model.sections(x, u.unsqueeze(-1)).squeeze(-1)
    states = x.unsqueeze(-2).expand(*u.shape, x.shape[-1])
    y: Tensor = model(torch.cat([states, u.unsqueeze(-1)], dim=-1))
    return y.squeeze(-1)


def _alike(first: MLP, second: MLP) -> bool:
    same = (first.n_in, first.n_out, first.hidden) == (second.n_in, 1, second.hidden)
    return same and all(i < m.n_in - 1 for m in (first, second) for i in m.residual)


# tanh(SATURATED) is 1 to the last bit: a hidden unit that carries the biases, so that no node adds them.
SATURATED = 30.0


class _Fused(nn.Module):
    """The products; every buffer is made once from the nets' weights, in float64."""

    one: Tensor  # (1,)
    into: Tensor  # (n_z + 1, 2 K (H + 1)) of the first layer
    out: Tensor  # (2 K (H + 1) + n_z + 1, n_out) of the last layer and of z itself, combined

    @torch.no_grad()
    def __init__(self, nets: tuple[MLP, MLP], grid: Tensor, at: Layout, combine: Combine) -> None:
        super().__init__()
        k, h, h_last = len(grid) + 1, nets[0].hidden[0], nets[0].hidden[-1]
        self.shape = (2, k, h + 1)
        layers = [scaled_layers(net) for net in nets]
        self.depth = len(layers[0]) - 1
        into = torch.zeros(at.n_z + 1, 2, k, h + 1, dtype=torch.float64)
        into[-1, :, :, -1] = SATURATED
        out = torch.zeros(2, k, h_last + 1, 2, k, dtype=torch.float64)
        direct = torch.zeros(at.n_z + 1, 2, k, dtype=torch.float64)
        for i, (net, start) in enumerate(zip(nets, (at.first, at.second), strict=True)):
            weight, bias = layers[i][0]
            into[start : start + at.n, i, :, :-1] = weight[: at.n, None, :]
            into[at.mv, i, 0, :-1] = weight[at.n]
            into[-1, i, :, :-1] = bias
            into[-1, i, 1:, :-1] += grid[:, None] * weight[at.n]
            weight, bias = layers[i][-1]
            for j in range(k):
                out[i, j, :-1, i, j], out[i, j, -1, i, j] = weight[:, 0], bias[0]
            for column in net.residual:
                direct[start + column, i] = 1.0
        eye = torch.eye(2 * k + at.n_z, dtype=torch.float64)
        combined = combine(eye[:, :k], eye[:, k : 2 * k], eye[:, 2 * k :])
        of_models = combined[: 2 * k]
        of_z = direct.reshape(at.n_z + 1, 2 * k) @ of_models
        of_z[:-1] += combined[2 * k :]
        self.register_buffer("one", torch.ones(1, dtype=torch.float64))
        self.register_buffer("into", into.reshape(at.n_z + 1, -1))
        self.register_buffer("out", torch.cat([out.reshape(-1, 2 * k) @ of_models, of_z]))
        for i in range(1, self.depth):
            self.register_buffer(f"hidden{i}", torch.stack([_with_bias_unit(*rows[i]) for rows in layers]))

    def forward(self, z: Tensor) -> Tensor:
        z = torch.cat([z, self.one.expand(*z.shape[:-1], 1)], dim=-1)
        a = torch.tanh(z @ self.into).reshape(*z.shape[:-1], *self.shape)
        for i in range(1, self.depth):
            a = torch.tanh(a @ getattr(self, f"hidden{i}"))
        return torch.cat([a.reshape(*z.shape[:-1], -1), z], dim=-1) @ self.out


def _with_bias_unit(weight: Tensor, bias: Tensor) -> Tensor:
    """The layer (H, H') with its bias as the weights of one more unit, which hands itself on."""
    full = torch.zeros(weight.shape[0] + 1, weight.shape[1] + 1, dtype=torch.float64)
    full[:-1, :-1], full[-1, :-1], full[-1, -1] = weight, bias, SATURATED
    return full
