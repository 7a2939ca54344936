"""Fuzzy means: the centres of an RBF network in one pass over the data, and its fit."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.static.least_squares import solve_qr
from loopwright.pipeline.models.static.rbf import BASES, DESIGN_ROWS, RBF, Basis, design_matrix
from loopwright.pipeline.plants.simulator import Array


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
