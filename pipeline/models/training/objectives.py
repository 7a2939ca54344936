"""What a trainer minimizes: the one-step error over samples, or the free-run error over windows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.errors import ModelError
from pipeline.models.static.mlp import MLP
from pipeline.models.training.jacobian import input_jacobian, parameter_jacobian, scaled_output
from pipeline.records.record import Record

Array = NDArray[np.float64]


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


def _weights(weight: Array | None, n: int, n_terms: int) -> Tensor:
    """Square roots of the row weights, normalized so that the sum of squares is a mean."""
    w = np.ones(n) if weight is None else np.asarray(weight, float)
    if w.shape != (n,) or not np.all(np.isfinite(w)) or np.any(w < 0) or w.sum() <= 0:
        raise ModelError(f"weights of training data: give {n} finite numbers >= 0, not all zero; got shape {w.shape}")
    return torch.from_numpy(np.sqrt(w / (w.sum() * n_terms)))


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """One-step error: mean over rows of w |s(x) - s*|^2, s the output scaled to deviation 1.

    Parameters
    ----------
    x, y
        Inputs (N, n_in) and outputs (N, n_out), engineering units.
    weight
        Importance of each row (N,); None for equal ones. Rows of a rare region want more.

    Raises
    ------
    ModelError
        Shapes that do not match, no row, a value that is not finite, or a negative weight.
    """

    x: Array
    y: Array
    weight: Array | None = None

    def __post_init__(self) -> None:
        if self.x.ndim != 2 or self.y.ndim != 2 or len(self.x) != len(self.y) or not len(self.x):
            raise ModelError(
                f"samples have shapes {self.x.shape}, {self.y.shape}; give (N, n_in), (N, n_out) with N > 0"
            )
        if not (np.all(np.isfinite(self.x)) and np.all(np.isfinite(self.y))):
            raise ModelError("samples hold a value that is not finite; drop those rows of the record")
        _weights(self.weight, len(self.x), self.y.shape[1])

    def __len__(self) -> int:
        return len(self.x)

    def part(self, rows: NDArray[np.int64]) -> Samples:
        """The samples of some rows."""
        return Samples(self.x[rows], self.y[rows], None if self.weight is None else self.weight[rows])

    def _tensors(self, net: MLP) -> tuple[Tensor, Tensor, Tensor]:
        x, y = torch.from_numpy(self.x), torch.from_numpy(self.y)
        target = (y - net.y_center - (x[:, list(net.residual)] if net.residual else 0.0)) / net.y_scale
        return x, target, _weights(self.weight, len(self), net.n_out)

    def loss(self, net: MLP) -> Tensor:
        """Weighted mean squared error of the scaled output."""
        x, target, root = self._tensors(net)
        return ((root[:, None] * (scaled_output(net, x) - target)) ** 2).sum()

    def normal_equations(self, net: MLP, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """(loss, J'r, J'J)."""
        x, target, root = self._tensors(net)
        sums = Sums(net)
        for rows in chunks(len(self), chunk):
            s, jac = parameter_jacobian(net, x[rows])
            sums.add((s - target[rows]) * root[rows, None], jac.mul_(root[rows, None, None]))
        return sums.result


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Free-run error of an NNARX over k steps: mean over windows and steps of w (s_t - s*_t)^2.

    Inside a window the model is fed its own predictions; k = 1 is the one-step error. The Jacobian
    follows the recursion, with phi(t) the regressor:

        dy(t)/dtheta = dNN/dtheta(phi(t)) + sum_i dNN/dy(t-i)(phi(t)) dy(t-i)/dtheta

    Parameters
    ----------
    past
        The last n_y measured PVs before each window, oldest first, shape (N, n_y).
    u
        MVs that the window's predictions use, oldest first, shape (N, n_u - 1 + k, n_mv).
    future
        Measured PVs of the window, shape (N, k).
    weight
        Importance of each window (N,); None for equal ones.

    Raises
    ------
    ModelError
        Shapes that do not match, no window, a value that is not finite, or a negative weight.
    """

    past: Array
    u: Array
    future: Array
    weight: Array | None = None

    def __post_init__(self) -> None:
        shapes = self.past.shape, self.u.shape, self.future.shape
        fits = [len(s) for s in shapes] == [2, 3, 2] and len({s[0] for s in shapes}) == 1 and self.past.size > 0
        if not fits or not 0 < self.future.shape[1] <= self.u.shape[1]:
            raise ModelError(
                f"windows have shapes {shapes}; give (N, n_y), (N, n_u - 1 + k, n_mv), (N, k) with N, k > 0"
            )
        if not all(np.all(np.isfinite(a)) for a in (self.past, self.u, self.future)):
            raise ModelError("windows hold a value that is not finite; drop those rows of the record")
        _weights(self.weight, len(self.past), self.steps)

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

        Lags and delay as in ``nnarx_pairs``. Of all windows each ``every``-th; with ``least_back`` rows before
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

    def __len__(self) -> int:
        return len(self.past)

    @property
    def steps(self) -> int:
        """Samples per window, k."""
        return int(self.future.shape[1])

    def part(self, rows: NDArray[np.int64]) -> Windows:
        """Some of the windows."""
        weight = None if self.weight is None else self.weight[rows]
        return Windows(self.past[rows], self.u[rows], self.future[rows], weight)

    def _regressor(self, ys: list[Tensor], u: Tensor, step: int) -> Tensor:
        n_u = self.u.shape[1] - self.steps + 1
        recent = u[:, step : step + n_u].flip(1).transpose(1, 2).flatten(1)
        return torch.cat([torch.stack(ys[-1 : -1 - self.past.shape[1] : -1], dim=1), recent], dim=1)

    def loss(self, net: MLP) -> Tensor:
        """Weighted mean squared error of the scaled free run."""
        past, u, future = (torch.from_numpy(a) for a in (self.past, self.u, self.future))
        root = _weights(self.weight, len(self), self.steps) / net.y_scale
        ys = list(past.unbind(1))
        for step in range(self.steps):
            ys.append(net.unlimited(self._regressor(ys, u, step))[:, 0])
        free_run = torch.stack(ys[-self.steps :], dim=1)
        return ((root[:, None] * (free_run - future)) ** 2).sum()

    @torch.no_grad()
    def normal_equations(self, net: MLP, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """(loss, J'r, J'J)."""
        past, u, future = (torch.from_numpy(a) for a in (self.past, self.u, self.future))
        root = _weights(self.weight, len(self), self.steps) / net.y_scale
        sums = Sums(net)
        n_y = self.past.shape[1]
        for rows in chunks(len(self), chunk):
            ys = list(past[rows].unbind(1))
            sensitivities: list[Tensor] = []  # dy/dtheta of the predictions; measured PVs have none
            for step in range(self.steps):
                phi = self._regressor(ys, u[rows], step)
                s, jac = parameter_jacobian(net, phi)
                jac = jac[:, 0].mul_(net.y_scale)
                slope = input_jacobian(net, phi)[:, 0]
                for lag in range(1, min(n_y, step) + 1):
                    jac.addcmul_(slope[:, lag - 1 : lag], sensitivities[-lag])
                y = net.y_center + net.y_scale * s[:, 0]
                ys.append(y + phi[:, net.residual[0]] if net.residual else y)
                sensitivities.append(jac)
                sums.add(root[rows] * (ys[-1] - future[rows, step]), jac * root[rows, None])
        return sums.result


class Sums:
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
