"""Objectives of the trainers, the one-step error or the free-run error, and the Jacobians that they need."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record


def scaled_output(net: MLP, x: Tensor) -> Tensor:
    """The output before its scaling, s = (y - y_center - x_residual) / y_scale, shape (N, n_out)."""
    a = (x - net.x_center) / net.x_scale
    for weight, bias in zip(list(net.weights)[:-1], list(net.biases)[:-1], strict=True):
        a = torch.tanh(torch.addmm(bias, a, weight))
    return torch.addmm(net.biases[-1], a, net.weights[-1])


@torch.no_grad()
def parameter_jacobian(net: MLP, x: Tensor) -> tuple[Tensor, Tensor]:
    """Scaled output s (N, n_out) and ds/dtheta (N, n_out, P).

    theta holds the parameters in the order of ``net.parameters()``: all weights, then all biases.
    With delta_l = ds/d(preactivation of layer l), found from the last layer back,

        delta_{L+1} = I,   delta_l = (delta_{l+1} W_{l+1}') (1 - a_l^2),
        ds_o/dW_l[i, j] = a_{l-1, i} delta_l[o, j],   ds_o/db_l[j] = delta_l[o, j].
    """
    weights, biases = list(net.weights), list(net.biases)
    layers = [(x - net.x_center) / net.x_scale]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        layers.append(torch.tanh(torch.addmm(bias, layers[-1], weight)))
    s = torch.addmm(biases[-1], layers[-1], weights[-1])

    n, n_out = len(x), net.n_out
    sizes = [p.numel() for p in net.parameters()]
    ends = list(torch.tensor(sizes).cumsum(0))
    jac = x.new_empty(n, n_out, sum(sizes))
    delta = torch.eye(n_out, dtype=x.dtype).expand(n, -1, -1)
    for layer in reversed(range(len(weights))):
        n_in, width = weights[layer].shape
        w_end, b_end = int(ends[layer]), int(ends[len(weights) + layer])
        jac[:, :, b_end - width : b_end] = delta
        block = jac[:, :, w_end - n_in * width : w_end].view(n, n_out, n_in, width)
        # Written in place: the Jacobian of a chunk is the largest array of the fit.
        torch.mul(layers[layer][:, None, :, None], delta[:, :, None, :], out=block)
        if layer:
            delta = (delta @ weights[layer].T) * (1 - layers[layer] ** 2)[:, None, :]
    return s, jac


@torch.no_grad()
def input_jacobian(net: MLP, x: Tensor) -> Tensor:
    """dy/dx of the prediction, shape (N, n_out, n_in), in engineering units."""
    a = (x - net.x_center) / net.x_scale
    chain = torch.diag(1 / net.x_scale).expand(len(x), -1, -1)  # da_l/dx, (N, n_in, width)
    for weight, bias in zip(list(net.weights)[:-1], list(net.biases)[:-1], strict=True):
        a = torch.tanh(torch.addmm(bias, a, weight))
        chain = (chain @ weight) * (1 - a * a)[:, None, :]
    jac = ((chain @ net.weights[-1]) * net.y_scale).transpose(1, 2).contiguous()
    for o, column in enumerate(net.residual):
        jac[:, o, column] += 1.0
    return jac


class Objective(Protocol):
    """A weighted mean squared error of an MLP's scaled outputs."""

    def loss(self, net: MLP) -> Tensor:
        """The objective, a differentiable scalar."""

    def normal_equations(self, net: MLP, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """(loss, J'r, J'J) over ``chunk`` rows at a time; the loss's gradient is 2 J'r."""

    def part(self, rows: NDArray[np.int64]) -> Objective:
        """The same objective over some of its rows."""

    def __len__(self) -> int:
        """Number of rows."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Arrays with a row for each sample or window, of which an objective is the mean."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def part(self, rows: NDArray[np.int64]) -> Self:
        """The same objective over some of its rows."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: None if v is None else v[rows] for name, v in values.items()})


def check_finite(what: str, *arrays: Array) -> None:
    """Raise ModelError where a value is not finite."""
    if not all(np.all(np.isfinite(a)) for a in arrays):
        raise ModelError(f"{what} hold a value that is not finite; drop those rows of the record")


@dataclass(frozen=True, slots=True, eq=False)
class Samples(Rows):
    """One-step error: mean over rows of w |s(x) - s*|^2, s the output scaled to deviation 1.

    Raises ModelError for shapes that do not match, no row, a value that is not finite, or a negative weight.
    """

    x: Array  # (N, n_in) inputs, engineering units
    y: Array  # (N, n_out) outputs, engineering units
    weight: Array | None = None  # (N,) importance of each row; None for equal ones. Rows of a rare region want more.

    def __post_init__(self) -> None:
        x, y = self.x, self.y
        if x.ndim != 2 or y.ndim != 2 or len(x) != len(y) or not len(x):
            raise ModelError(f"training data have shapes {x.shape} and {y.shape}; give (N, n_in), (N, n_out), N > 0")
        check_finite("training data", x, y)
        self._root()

    def _root(self) -> Tensor:
        """Square roots of the rows' weights, normalized so that the sum of squares is a mean, shape (N,)."""
        n = len(self)
        w = np.ones(n) if self.weight is None else np.asarray(self.weight, float)
        if w.shape != (n,) or not np.all(np.isfinite(w)) or np.any(w < 0) or w.sum() <= 0:
            raise ModelError(
                f"weights of training data: give {n} finite numbers >= 0, not all zero; got shape {w.shape}"
            )
        return torch.from_numpy(np.sqrt(w / (w.sum() * self.y.shape[1])))

    def _tensors(self, net: MLP) -> tuple[Tensor, Tensor, Tensor]:
        x, y = torch.from_numpy(self.x), torch.from_numpy(self.y)
        target = (y - net.y_center - (x[:, list(net.residual)] if net.residual else 0.0)) / net.y_scale
        return x, target, self._root()

    def loss(self, net: MLP) -> Tensor:
        """Weighted mean squared error of the scaled output."""
        x, target, root = self._tensors(net)
        return ((root[:, None] * (scaled_output(net, x) - target)) ** 2).sum()

    def normal_equations(self, net: MLP, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """(loss, J'r, J'J)."""
        x, target, root = self._tensors(net)
        sums = JacobianSums(net)
        for rows in chunks(len(self), chunk):
            s, jac = parameter_jacobian(net, x[rows])
            sums.add((s - target[rows]) * root[rows, None], jac.mul_(root[rows, None, None]))
        return sums.result


@dataclass(frozen=True, slots=True, eq=False)
class FreeRunWindows(Rows):
    """Free-run error of an NNARX over k steps: mean over windows and steps of (s_t - s*_t)^2.

    Inside a window the model is fed its own predictions; k = 1 is the one-step error. The Jacobian
    follows the recursion, with phi(t) the regressor:

        dy(t)/dtheta = dNN/dtheta(phi(t)) + sum_i dNN/dy(t-i)(phi(t)) dy(t-i)/dtheta

    Raises ModelError for shapes that do not match, no window, or a value that is not finite.
    """

    past: Array  # (N, n_y) the last measured PVs before each window, oldest first
    u: Array  # (N, n_u - 1 + k, n_mv) MVs that the window's predictions use, oldest first
    future: Array  # (N, k) measured PVs of the window

    def __post_init__(self) -> None:
        shapes = self.past.shape, self.u.shape, self.future.shape
        fits = [len(s) for s in shapes] == [2, 3, 2] and len({s[0] for s in shapes}) == 1 and self.past.size > 0
        if not fits or not 0 < self.future.shape[1] <= self.u.shape[1]:
            raise ModelError(
                f"windows have shapes {shapes}; give (N, n_y), (N, n_u - 1 + k, n_mv), (N, k) with N, k > 0"
            )
        check_finite("windows", self.past, self.u, self.future)

    @classmethod
    def of(
        cls,
        record: Record,
        n_y: int,
        n_u: int,
        steps: int,
        *,
        target: int = 0,
        delay: int = 1,
        every: int = 1,
        least_back: int = 0,
    ) -> Self:
        """Windows of ``steps`` samples of one PV of a record, none reaching over the end of a run.

        Lags and delay as in ``nnarx_pairs``. Each ``every``-th of all windows; with ``least_back`` rows before
        a window's last measured one, although these lags may need fewer: so that models of other lags are
        compared over the same windows. Raises RecordError where no run is long enough.
        """
        back = max(n_y - 1, n_u + delay - 2, least_back)
        k = (record.starts(back + steps) + back)[::every]  # last measured row of each window
        y = record.pv[:, target]
        return cls(
            y[k[:, None] + np.arange(1 - n_y, 1)],
            record.mv[k[:, None] + np.arange(2 - delay - n_u, 1 - delay + steps)],
            y[k[:, None] + np.arange(1, steps + 1)],
        )

    @property
    def steps(self) -> int:
        """Samples per window, k."""
        return int(self.future.shape[1])

    def _root(self, net: MLP) -> Tensor:
        """The factor of an error that makes the sum of squares a mean of scaled ones, shape (1,)."""
        return math.sqrt(1 / self.future.size) / net.y_scale

    def loss(self, net: MLP) -> Tensor:
        """Mean squared error of the scaled free run."""
        past, u, future = (torch.from_numpy(a) for a in (self.past, self.u, self.future))
        predicted = free_run(net, past, u, self.u.shape[1] - self.steps + 1)
        return ((self._root(net) * (predicted - future)) ** 2).sum()

    @torch.no_grad()
    def normal_equations(self, net: MLP, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """(loss, J'r, J'J)."""
        past, u, future = (torch.from_numpy(a) for a in (self.past, self.u, self.future))
        root, n_y, n_u = self._root(net), self.past.shape[1], self.u.shape[1] - self.steps + 1
        sums = JacobianSums(net)
        for rows in chunks(len(self), chunk):
            ys = list(past[rows].unbind(1))
            sensitivities: list[Tensor] = []  # dy/dtheta of the predictions; measured PVs have none
            for step in range(self.steps):
                phi = regressor(ys, u[rows], step, n_y, n_u)
                s, jac = parameter_jacobian(net, phi)
                jac = jac[:, 0].mul_(net.y_scale)
                slope = input_jacobian(net, phi)[:, 0]
                for lag in range(1, min(n_y, step) + 1):
                    jac.addcmul_(slope[:, lag - 1 : lag], sensitivities[-lag])
                y = net.y_center + net.y_scale * s[:, 0]
                ys.append(y + phi[:, net.residual[0]] if net.residual else y)
                sensitivities.append(jac)
                sums.add(root * (ys[-1] - future[rows, step]), jac * root)
        return sums.result


def regressor(ys: list[Tensor], u: Tensor, step: int, n_y: int, n_u: int) -> Tensor:
    """Phi (..., n_y + n_u n_mv) of prediction ``step``, as ``nnarx_pairs`` has it.

    ``ys`` are the PVs (...,) up to the sample before, ``u`` (..., k, n_mv) the MVs, both oldest first.
    """
    recent = u[..., step : step + n_u, :].flip(-2).transpose(-1, -2).flatten(-2)
    return torch.cat([torch.stack(ys[-1 : -1 - n_y : -1], dim=-1), recent], dim=-1)


def free_run(predictor: Callable[[Tensor], Tensor], past: Tensor, u: Tensor, n_u: int) -> Tensor:
    """Predictions (..., k) of ``predictor`` (phi -> (..., 1)), fed back in place of measurements.

    ``past`` (..., n_y) holds the last measured PVs, oldest first; ``u`` (..., n_u - 1 + k, n_mv)
    the MVs that the k predictions use, oldest first: its last row is u(t - d) of the last one.
    """
    n_y = past.shape[-1]
    ys = list(past.unbind(-1))
    for step in range(u.shape[-2] - n_u + 1):
        ys.append(predictor(regressor(ys, u, step, n_y, n_u))[..., 0])
    return torch.stack(ys[n_y:], dim=-1)


class JacobianSums:
    """Running sums of r'r, J'r and J'J."""

    def __init__(self, net: MLP) -> None:
        size = sum(p.numel() for p in net.parameters())
        self.result = (
            torch.zeros((), dtype=torch.float64),
            torch.zeros(size, dtype=torch.float64),
            torch.zeros(size, size, dtype=torch.float64),
        )

    @torch.no_grad()
    def add(self, residual: Tensor, jac: Tensor) -> None:
        """Add rows: residual (n, ...), jac (n, ..., P)."""
        loss, gradient, hessian = self.result
        r, j = residual.reshape(-1), jac.flatten(0, -2)
        loss += r @ r
        gradient.addmv_(j.T, r)
        hessian.addmm_(j.T, j)


def chunks(n: int, size: int) -> Iterator[slice]:
    """Slices of at most ``size`` over ``n`` rows."""
    for start in range(0, n, size):
        yield slice(start, min(start + size, n))
