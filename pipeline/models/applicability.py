"""The applicability domain of a model: where its training data lie, by leverage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ModelError

Array = NDArray[np.float64]

# Where QR leaves a column with less than this share of its spread, the column follows from the others.
COLLINEAR = 1e-10


@dataclass(frozen=True, slots=True)
class Leverage:
    """Leverage of an input u = [x; w] in a data set, arranged for solving it in its last entry w.

        h(u) = z' (sum z z')^-1 z,  z = [1; u]
             = 1/K + |(x - mean_x) W|^2 + ((w - centre(x)) / scale)^2
        centre(x) = mean_w + (x - mean_x) slope

    The second form follows from QR of the centred, scaled data: with Q R = U and the last column
    being w, R^-T is lower triangular, so that only its last row holds w. ``centre`` is the linear
    regression of w on [1, x]. Nothing is squared before it is factored, and the bounds on w need
    no difference of large numbers.

    An input is inside where h(u) <= h* = 3 (N+1)/K, three times the mean leverage of the data.

    Source: [inverse_rbf, eqs 13-15], with the intercept that centring stands for.
    """

    mean: Array  # (N,) of the data; the last entry is w's
    whiten: Array  # (N-1, N-1) the matrix W above
    slope: Array  # (N-1,) of the regression of w on x
    scale: float  # [w] root of the sum of squared residuals of that regression
    offset: float  # 1/K
    threshold: float  # h*

    @classmethod
    def fit(cls, u: Array) -> Self:
        """The leverage of data ``u``, shape (K, N), K > N, the entry to bound last.

        Raises ModelError for data that are too few, not finite, constant in a column or collinear.
        """
        u = np.asarray(u, dtype=np.float64)
        if u.ndim != 2 or u.shape[1] < 2:
            raise ModelError(f"a leverage domain needs data of shape (K, N >= 2), states then w; got {u.shape}")
        k, n = u.shape
        if k <= n + 1:
            raise ModelError(f"a leverage domain over {n} inputs needs more than {n + 1} rows of data; got {k}")
        if not np.all(np.isfinite(u)):
            row, column = np.argwhere(~np.isfinite(u))[0]
            raise ModelError(f"data of the leverage domain are not finite in row {row}, column {column}: {u[row]}")
        mean = u.mean(axis=0)
        spread = u.std(axis=0)
        constant = np.nonzero(spread <= COLLINEAR * np.abs(mean))[0]
        if constant.size:
            raise ModelError(
                f"column {constant[0]} of the leverage domain's data is constant at {mean[constant[0]]:g}; "
                "excite it or leave it out of the model's inputs"
            )
        factor = np.linalg.qr((u - mean) / spread, mode="r")
        kept = np.abs(np.diag(factor)) / np.sqrt(k)
        if kept.min() < COLLINEAR:
            raise ModelError(
                f"column {int(kept.argmin())} of the leverage domain's data is a linear function of those before it; "
                "excite it independently or leave it out of the model's inputs"
            )
        # Columns of R^-1 are the rows of R^-T: all but the last hold x only.
        inverse = np.linalg.solve(factor, np.eye(n)) / spread[:, None]
        return cls(
            mean=mean,
            whiten=inverse[:-1, :-1],
            slope=-inverse[:-1, -1] / inverse[-1, -1],
            scale=float(1 / np.abs(inverse[-1, -1])),
            offset=1 / k,
            threshold=3 * (n + 1) / k,
        )


def narrowed(w_min: Array, w_max: Array, r: float) -> tuple[Array, Array]:
    """Bounds drawn towards their middle until they are r times closer, r >= 1.

        w'_min = ((r+1) w_min + (r-1) w_max) / (2r),   w'_max = ((r+1) w_max + (r-1) w_min) / (2r)

    Source: [inverse_rbf, eqs 18 and 19], both with plus signs.
    """
    return ((r + 1) * w_min + (r - 1) * w_max) / (2 * r), ((r + 1) * w_max + (r - 1) * w_min) / (2 * r)
