"""Fuzzy means: the centres of an RBF network in one pass over the data, and its fit by least squares."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.static.rbf import BASES, DESIGN_ROWS, RBF, Basis, design_matrix
from loopwright.pipeline.plants.simulator import Array

# Rows of the sample that each stratum gives; with 8 the preconditioned condition number is about 2.5.
STRATUM_ROWS = 8


def solve_qr(z: Tensor, y: Tensor, ridge: float = 0.0) -> Tensor:
    """Weights (L, n_out) that minimize |Z w - y|^2 + ridge |w|^2, from the R factor of [Z y].

    Z is (K, L), y (K, n_out). Q is never formed. Where Z has dependent columns, the weights of
    least norm.
    """
    return _back_substitute(_r_factor(torch.cat([z, y], dim=1), z.shape[1], ridge), z.shape[1])


def solve_iterative(
    z: Tensor, y: Tensor, strata: NDArray[np.int64], ridge: float = 0.0, *, tolerance: float = 1e-5, limit: int = 60
) -> Tensor:
    """The same weights to a relative ``tolerance`` of the residual's norm, without the QR of all rows.

    Samples in one cell of the grid give nearly equal rows of Z. So the R factor of a few rows of each cell (``strata``
    (K,) numbers the cells 0, 1, ...), each weighted by the number of rows it stands for, makes Z R^-1 nearly
    orthogonal: singular values of about 0.7 to 1.6, where those of Z span eight decades. Conjugate gradients on it gain
    half a decade an iteration. Z R^-1 is nearly orthogonal, so that the gradient's norm is the distance to the solution
    in the space of the predictions, which is what ``tolerance`` bounds.

    Falls back on ``solve_qr`` where the sample would be most of the data or does not hold the
    column space of Z.
    """
    n = z.shape[1]
    rows, weight = _sample(strata)
    if 2 * len(rows) > len(z):
        return solve_qr(z, y, ridge)
    take = torch.from_numpy(rows)
    r = _r_factor(torch.cat([z[take], y[take]], dim=1) * torch.from_numpy(weight)[:, None], n, ridge)
    if len(r) < n or _is_singular(r[:n, :n]):
        return solve_qr(z, y, ridge)
    factor, start = r[:n, :n].contiguous(), _back_substitute(r, n)
    columns = [_gradients(z, y[:, j], factor, start[:, j], ridge, tolerance, limit) for j in range(y.shape[1])]
    found = [w for w in columns if w is not None]
    return torch.stack(found, dim=1) if len(found) == y.shape[1] else solve_qr(z, y, ridge)


def _gradients(
    z: Tensor, y: Tensor, factor: Tensor, w: Tensor, ridge: float, tolerance: float, limit: int
) -> Tensor | None:
    """Preconditioned conjugate gradients for one output from the start w; None if they do not converge."""
    upper = factor
    lower = factor.T.contiguous()
    floor = 1e-9 * float(y.norm())  # an exact fit leaves no residual to be relative to

    def gradient(residual: Tensor, weights: Tensor) -> Tensor:
        g = torch.mv(z.T, residual) - ridge * weights
        return torch.linalg.solve_triangular(lower, g[:, None], upper=False)[:, 0]

    w = w.clone()
    residual = y - torch.mv(z, w)
    g = gradient(residual, w)
    direction, square = g.clone(), float(g @ g)
    for _ in range(limit):
        if square**0.5 <= tolerance * max(float(residual.norm()), floor):
            return w
        step = torch.linalg.solve_triangular(upper, direction[:, None], upper=True)[:, 0]
        image = torch.mv(z, step)
        length = square / float(image @ image + ridge * (step @ step))
        w += length * step
        residual -= length * image
        g = gradient(residual, w)
        previous, square = square, float(g @ g)
        direction = g + (square / previous) * direction
    return None


def _sample(strata: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows that stand for all, up to STRATUM_ROWS of each stratum and evenly spaced in it, and their weights."""
    order = np.argsort(strata, kind="stable")
    count = np.bincount(strata)
    size = count[strata[order]]
    rank = np.arange(len(strata)) - np.repeat(np.cumsum(count) - count, count)
    take = (rank * STRATUM_ROWS) // size != ((rank - 1) * STRATUM_ROWS) // size
    return order[take], np.sqrt(size[take] / np.minimum(size[take], STRATUM_ROWS))


def _r_factor(zy: Tensor, n: int, ridge: float) -> Tensor:
    """R of the QR of [Z y], with the ridge's rows [sqrt(ridge) I, 0] under it."""
    r = torch.linalg.qr(zy, mode="r")[1]
    if ridge > 0:
        below = torch.zeros(n, zy.shape[1], dtype=zy.dtype)
        below.diagonal().fill_(ridge**0.5)
        r = torch.linalg.qr(torch.cat([r, below], dim=0), mode="r")[1]
    return r


def _is_singular(r: Tensor) -> bool:
    diagonal = r.diagonal().abs()
    return not bool(diagonal.min() > 1e-13 * diagonal.max())


def _back_substitute(r: Tensor, n: int) -> Tensor:
    """Weights (n, n_out) from the R factor of [Z y]."""
    left, right = r[:n, :n], r[:n, n:]
    if left.shape[0] < n or _is_singular(left):
        return torch.linalg.lstsq(left, right, driver="gelsd").solution
    return torch.linalg.solve_triangular(left, right, upper=True)


def scaling(x: Array) -> tuple[Array, Array]:
    """(low, span) of each input, shapes (n_in,), with which u = 2 (x - low) / span - 1 fills [-1, 1].

    A constant input has span 1, so that it stays finite and adds nothing to any distance.
    """
    low, high = x.min(axis=0), x.max(axis=0)
    return low, np.where(high > low, high - low, 1.0)


def to_grid(u: Array, partitions: int) -> tuple[Array, NDArray[np.int64]]:
    """Scaled samples (K, n_in) in units of the grid's spacing, and the index of the grid point nearest to each."""
    g = (u + 1.0) * (0.5 * (partitions - 1))
    return g, np.rint(g).clip(0, partitions - 1).astype(np.int64)


def select_centres(u: Array, partitions: int) -> NDArray[np.int64]:
    """Grid indices (L, n_in), each 0 .. c-1, of the centres that fuzzy means chooses for scaled samples.

    Each input has c fuzzy sets, ends inclusive, of half width da = half the grid's spacing. A
    sample is covered by a centre when its relative distance

        r = |a - u| / (da sqrt(N)) <= 1

    In one pass over the samples in their order, one that no chosen centre covers adds the grid
    point nearest to it; the c^N grid points are never enumerated. A sample in the very corner
    between grid points has r = 1: it counts as covered, or it would add the same centre for ever.

    The pass is exact but not a loop over samples: the next uncovered one of a block is found at
    once, and the rest is thinned by all centres of a block before it is looked at.

    Source: [inverse_rbf, eqs. 4-7].
    """
    g, near = to_grid(u, partitions)
    # da sqrt(N) in grid units is sqrt(N)/2; the margin is for rounding, far below any sample's resolution.
    reach = 0.25 * g.shape[1] * (1 + 1e-9)
    chosen: list[NDArray[np.int64]] = []
    block = 64  # most centres come early, so the first blocks are short and the data shrink at once
    while len(g):
        head, head_near = g[:block], near[:block]
        covered = np.zeros(len(head), dtype=bool)
        first = len(chosen)
        while not covered.all():
            k = int(np.argmin(covered))
            chosen.append(head_near[k])
            step = head - head_near[k]
            covered |= np.einsum("ij,ij->i", step, step) <= reach
            covered[k] = True
        g, near = g[block:], near[block:]
        new = np.array(chosen[first:], dtype=np.float64).reshape(-1, g.shape[1])
        left = [
            np.flatnonzero(~_covered(g[i : i + DESIGN_ROWS], new, reach)) + i for i in range(0, len(g), DESIGN_ROWS)
        ]
        keep = np.concatenate([np.empty(0, dtype=np.int64), *left])
        g, near = g[keep], near[keep]
        block *= 2
    return np.array(chosen)


def _covered(g: Array, centres: Array, reach: float) -> NDArray[np.bool_]:
    """The samples that some centre covers."""
    return np.asarray((cdist(g, centres, "sqeuclidean") <= reach).any(axis=1))


def grid_points(index: NDArray[np.int64], partitions: int) -> Array:
    """Scaled coordinates, -1 .. 1, of grid indices."""
    return index / (0.5 * (partitions - 1)) - 1.0


class FuzzyMeansRBF(RegressorMixin, BaseEstimator):
    """RBF network whose centres fuzzy means chooses and whose weights least squares gives.

    Parameters
    ----------
    partitions : int, default=10
        Fuzzy sets c of each input, at least 2.
    basis : {"thin_plate", "gaussian"}, default="thin_plate"
        h(d) = d^2 log d, or exp(-d^2 / (2 width^2)).
    width : float, default=0.5
        Width of the Gaussian, in units of the inputs scaled to [-1, 1].
    ridge : float, default=0.0
        Penalty on the sum of squared weights; 0 for plain least squares.

    Attributes
    ----------
    centres_ : ndarray of shape (n_centres, n_features_in_), scaled
    weights_ : ndarray of shape (n_outputs, n_centres)
    low_, span_ : ndarray of shape (n_features_in_,), the scaling u = 2 (x - low) / span - 1

    Notes
    -----
    The design matrix Z of a thin-plate spline has a condition number of about 1e8, which the
    normal equations of eq. 8 square; the weights come from the R factor of [Z y] instead.

    Source: [inverse_rbf, section 2, eqs. 1-8].
    """

    def __init__(
        self, partitions: int = 10, *, basis: Basis = "thin_plate", width: float = 0.5, ridge: float = 0.0
    ) -> None:
        self.partitions = partitions
        self.basis = basis
        self.width = width
        self.ridge = ridge

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Choose centres and weights from X (K, n_in) and y (K,) or (K, n_out), engineering units.

        Raises ModelError for a parameter out of its range, ValueError for data that scikit-learn refuses.
        """
        check_parameters(self.partitions, self.basis, self.width, self.ridge)
        x, target = validate_data(self, X, y, dtype=np.float64, multi_output=True, y_numeric=True)
        target = np.asarray(target, dtype=np.float64)
        self.low_, self.span_ = scaling(x)
        u = 2.0 * (x - self.low_) / self.span_ - 1.0
        self.centres_ = grid_points(select_centres(u, self.partitions), self.partitions)
        z = design_matrix(torch.from_numpy(u), torch.from_numpy(self.centres_), self.basis, self.width)
        weights = solve_qr(z, torch.tensor(target.reshape(len(u), -1)), self.ridge)
        self.weights_ = weights.T.contiguous().numpy()
        self._single_output = target.ndim == 1
        return self

    def predict(self, X: ArrayLike) -> Array:
        """Outputs (K,) or (K, n_out) for X (K, n_in), engineering units."""
        check_is_fitted(self)
        x = torch.from_numpy(np.array(validate_data(self, X, dtype=np.float64, reset=False)))
        net = self.to_torch()
        with torch.inference_mode():
            y = torch.cat([net(x[i : i + DESIGN_ROWS]) for i in range(0, len(x), DESIGN_ROWS)]).numpy()
        return y[:, 0] if self._single_output else y

    def to_torch(self) -> RBF:
        """The fitted network as a float64 torch module."""
        check_is_fitted(self)
        return RBF.of(self.centres_, self.weights_, self.low_, self.span_, basis=self.basis, width=self.width)


def check_parameters(partitions: Any, basis: Any, width: Any, ridge: Any) -> None:
    """Raise ModelError where a parameter of the fit is out of its range."""
    if not isinstance(partitions, Integral) or isinstance(partitions, bool) or partitions < 2:
        raise ModelError(f"partitions is {partitions!r}; give a whole number of at least 2")
    if basis not in BASES:
        raise ModelError(f"basis {basis!r} is unknown; choose one of {', '.join(BASES)}")
    if not isinstance(width, Real) or not 0 < float(width) < np.inf:
        raise ModelError(f"width is {width!r}; give a positive number (inputs are scaled to [-1, 1])")
    if not isinstance(ridge, Real) or not 0 <= float(ridge) < np.inf:
        raise ModelError(f"ridge is {ridge!r}; give 0 for plain least squares or a positive number")
