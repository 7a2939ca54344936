"""Multilayer perceptron with its scaling inside."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.simulator import Array


class MLP(Model):
    """Feedforward network with tanh hidden layers and a linear output.

        a_0 = (x - x_center) / x_scale,   a_l = tanh(a_{l-1} W_l + b_l),   l = 1..L
        y   = y_center + y_scale (a_L W_{L+1} + b_{L+1})  [+ x_residual]

    for x (..., n_in) and y (..., n_out); ``hidden`` are the widths of the hidden layers. ``residual`` names for
    each output the input column to which the network adds, or is empty: predicting the change is what a model of
    one or a few sampling periods needs, as its error is then relative to the change.

    Raises ModelError without a hidden unit, or where ``residual`` does not name one input column per output.
    """

    kind: ClassVar[str] = "mlp"
    x_center: Tensor  # (n_in,)
    x_scale: Tensor  # (n_in,)
    y_center: Tensor  # (n_out,)
    y_scale: Tensor  # (n_out,)

    def __init__(self, n_in: int, n_out: int = 1, hidden: Sequence[int] = (20,), residual: Sequence[int] = ()) -> None:
        super().__init__()
        if not hidden or min(hidden) < 1:
            raise ModelError(f"hidden layers {tuple(hidden)} of an MLP: give at least one, each of at least one unit")
        if residual and (len(residual) != n_out or not all(0 <= i < n_in for i in residual)):
            raise ModelError(
                f"residual columns {tuple(residual)} of an MLP with {n_in} inputs and {n_out} outputs: "
                f"give one column of 0..{n_in - 1} per output, or none"
            )
        self.n_in, self.n_out, self.hidden, self.residual = n_in, n_out, tuple(hidden), tuple(residual)
        # Weights are (n_in, n_out) and used as x @ W: onnxruntime 1.31.1 computes wrong results
        # where a transposed 2-D constant meets a 1-D MatMul (its MatmulTransposeFusion).
        shapes = list(pairwise((n_in, *hidden, n_out)))
        self.weights = nn.ParameterList([nn.Parameter(torch.zeros(i, o, dtype=torch.float64)) for i, o in shapes])
        self.biases = nn.ParameterList([nn.Parameter(torch.zeros(o, dtype=torch.float64)) for _, o in shapes])
        self.reserve(x_center=(n_in,), x_scale=(n_in,), y_center=(n_out,), y_scale=(n_out,))
        self.x_scale.fill_(1.0)
        self.y_scale.fill_(1.0)

    @classmethod
    def scaled_to(cls, x: Array, y: Array, *, hidden: Sequence[int] = (20,), residual: Sequence[int] = ()) -> Self:
        """An untrained network whose scaling is taken from data x (N, n_in), y (N, n_out).

        Inputs go to [-1, 1], outputs (changes, with ``residual``) to mean 0 and deviation 1.
        Raises ModelError for a constant column.
        """
        if x.ndim != 2 or y.ndim != 2 or len(x) != len(y):
            raise ModelError(
                f"training data of an MLP have shapes {x.shape} and {y.shape}; give (N, n_in) and (N, n_out)"
            )
        model = cls(x.shape[1], y.shape[1], hidden, residual)
        change = y - x[:, list(residual)] if residual else y
        spans = {"input": np.ptp(x, axis=0) / 2, "output": change.std(axis=0)}
        for what, span in spans.items():
            flat = np.nonzero(~(span > 0))[0]  # ~(>) catches NaN too
            if flat.size:
                raise ModelError(
                    f"{what} column {flat[0]} of an MLP's training data does not vary or is not finite: "
                    "leave it out, or excite it"
                )
        with torch.no_grad():
            model.x_center.copy_(torch.from_numpy((x.max(axis=0) + x.min(axis=0)) / 2))
            model.x_scale.copy_(torch.from_numpy(spans["input"]))
            model.y_center.copy_(torch.from_numpy(change.mean(axis=0)))
            model.y_scale.copy_(torch.from_numpy(spans["output"]))
        return model

    @torch.no_grad()
    def reset(self, generator: torch.Generator) -> None:
        """Draw new weights: the hidden units' slopes spread over the inputs' box (Nguyen and Widrow, 1990)."""
        last = len(self.hidden)
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            n_in, n_out = weight.shape
            draw = 2 * torch.rand(n_in, n_out, generator=generator, dtype=torch.float64) - 1
            if layer == last:
                weight.copy_(draw / math.sqrt(n_in))
                bias.zero_()
                continue
            length = 0.7 * n_out ** (1 / n_in)
            weight.copy_(draw / draw.norm(dim=0) * length)
            bias.copy_(length * (2 * torch.rand(n_out, generator=generator, dtype=torch.float64) - 1))

    def forward(self, x: Tensor) -> Tensor:
        """Prediction, shape (..., n_out), for inputs of shape (..., n_in)."""
        slope, offset = self._first_layer()
        return self._after_first_layer(x, x @ slope + offset)

    def sections(self, x: Tensor, candidates: Tensor) -> Tensor:
        """Prediction (..., K, n_out) at one point x (..., n) for K candidates (..., K, n_in - n) of the last inputs.

        The first layer's share of ``x`` is computed once. A law that searches its MV uses this.
        ``residual`` columns must lie within ``x``.
        """
        n = x.shape[-1]
        slope, offset = self._first_layer()
        known = x @ slope[:n] + offset
        return self._after_first_layer(x.unsqueeze(-2), known.unsqueeze(-2) + candidates @ slope[n:])

    # The scaling is multiplied into the first and last weights: all constants, which onnxruntime
    # folds when it loads the graph. Left as a node of its own, a scalar factor beside a MatMul
    # becomes FusedMatMul's alpha, which is float32 and costs half the digits (onnxruntime 1.31.1).
    def _first_layer(self) -> tuple[Tensor, Tensor]:
        slope = self.weights[0] / self.x_scale[:, None]
        return slope, self.biases[0] - self.x_center @ slope

    def _after_first_layer(self, x: Tensor, preactivation: Tensor) -> Tensor:
        a = torch.tanh(preactivation)
        for weight, bias in zip(list(self.weights)[1:-1], list(self.biases)[1:-1], strict=True):
            a = torch.tanh(a @ weight + bias)
        y = a @ (self.weights[-1] * self.y_scale) + (self.biases[-1] * self.y_scale + self.y_center)
        if self.residual:
            # A narrow instead of a gather: one cheap node in the exported graph.
            y = y + torch.cat([x[..., i : i + 1] for i in self.residual], dim=-1)
        return y


def scaled_layers(net: MLP) -> list[tuple[Tensor, Tensor]]:
    """(weight (n_in, n_out), bias (n_out,)) of each layer, from engineering units to engineering units.

    Copies without a gradient; the residual column is not among them.
    """
    layers = [(w.detach().clone(), b.detach().clone()) for w, b in zip(net.weights, net.biases, strict=True)]
    slope = layers[0][0] / net.x_scale[:, None]
    layers[0] = (slope, layers[0][1] - net.x_center @ slope)
    weight, bias = layers[-1]
    layers[-1] = (weight * net.y_scale, bias * net.y_scale + net.y_center)
    return layers
