"""The applicability domain of a model, where its training data lie, by leverage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.part import Learnt, Source, StaticPart, predict
from loopwright.pipeline.plants.simulator import Array

# Where QR leaves a column with less than this share of its spread, the column follows from the others.
COLLINEAR = 1e-10


class DomainInterval(NamedTuple):
    """The values of w inside the domain at a state: centre +- half, while room > 0."""

    centre: Tensor  # (..., 1) [w] global linear prediction of w from the state
    half: Tensor  # (..., 1) [w] zero where the state itself is outside
    room: Tensor  # (..., 1) leverage that the state leaves for w; negative: no w is inside


class LeverageDomain(Model):
    """Leverage of an input u = [x; w] in a data set of K rows, and the interval of w that keeps it below h*.

        h(u) = z' (sum z z')^-1 z,  z = [1; u]
             = 1/K + |(x - mean_x) W|^2 + ((w - centre(x)) / scale)^2
        centre(x) = mean_w + (x - mean_x) slope
        w = centre(x) +- scale sqrt(h* - 1/K - |(x - mean_x) W|^2)

    The second form follows from QR of the centred, scaled data: with Q R = U and the last column
    being w, R^-T is lower triangular, so that only its last row holds w. ``centre`` is the linear
    regression of w on [1, x]. Nothing is squared before it is factored, and the bounds on w need
    no difference of large numbers.

    An input is inside where h(u) <= h* = 3 (N+1)/K, three times the mean leverage of the data.
    The leverage as a model: ``(..., N) -> (..., 1)``.

    Source: [inverse_rbf, eqs 13-20], with the intercept that centring stands for.
    """

    kind: ClassVar[str] = "leverage_domain"

    mean_x: Tensor  # (N-1,)
    mean_w: Tensor  # (1,)
    project: Tensor  # (N-1, N): W, and the slope of the centre in the last column
    scale: Tensor  # (1,) [w] root of the sum of squared residuals of the regression of w on x
    free: Tensor  # (1,) h* - 1/K
    threshold: Tensor  # (1,) h*
    edge: Tensor  # (1,) h* and a little: a value of w at its bound lies on either side of h* by rounding

    def __init__(self, n_in: int) -> None:
        super().__init__()
        self.n_in = n_in
        self.reserve(mean_x=(n_in - 1,), mean_w=(1,), project=(n_in - 1, n_in))
        self.reserve(scale=(1,), free=(1,), threshold=(1,), edge=(1,))

    @classmethod
    def fit(cls, u: Array) -> Self:
        """The domain of training inputs ``u``, shape (K, N), K > N + 1, w last.

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
        slope = -inverse[:-1, -1] / inverse[-1, -1]
        threshold = 3 * (n + 1) / k
        numbers = {
            "mean_x": mean[:-1],
            "mean_w": mean[-1:],
            "project": np.column_stack([inverse[:-1, :-1], slope]),
            "scale": 1 / np.abs(inverse[-1, -1:]),
            "free": np.array([threshold - 1 / k]),
            "threshold": np.array([threshold]),
            "edge": np.array([threshold * (1 + 1e-9)]),
        }
        return cls.from_arrays({"n_in": n}, numbers)

    def interval(self, x: Tensor) -> DomainInterval:
        """The interval of w at states ``x``, shape (..., N-1)."""
        along = (x - self.mean_x) @ self.project
        spread = along[..., :-1]
        room = self.free - (spread * spread).sum(dim=-1, keepdim=True)
        return DomainInterval(self.mean_w + along[..., -1:], self.scale * room.relu().sqrt(), room)

    def leverage(self, at: DomainInterval, w: Tensor) -> Tensor:
        """Leverage (..., 1) of w, shape (..., 1), at the state of an interval."""
        away = (w - at.centre) / self.scale
        return self.threshold - at.room + away * away

    def inside(self, leverage: Tensor) -> Tensor:
        """1.0 where a leverage (..., 1) is that of an input inside the domain, else 0.0."""
        return (leverage <= self.edge).to(leverage.dtype)

    def forward(self, x: Tensor) -> Tensor:
        """Leverage, shape (..., 1), of inputs [state, w], shape (..., N)."""
        return self.leverage(self.interval(x[..., :-1]), x[..., -1:])

    def bounds(self, at: DomainInterval, y: Tensor, r: Tensor | float = 1.0) -> tuple[Tensor, Tensor]:
        """Narrowed bounds (w_min, w_max), each (..., 1), by the factor r >= 1.

        Eqs 18 and 19 as centre -+ half/r. Where no w is inside, both are the output y (..., 1): to
        stay is the one request that cannot be wrong by much, while the centre may lie anywhere.
        """
        centre = torch.where(at.room > 0, at.centre, y)
        reach = at.half / r
        return centre - reach, centre + reach


@dataclass(frozen=True, kw_only=True)
class DomainPart(StaticPart):
    """The leverage domain of a static part's training inputs: give it that part's task, horizon and split."""

    model: ClassVar[type[Model]] = LeverageDomain
    task: Literal["inverse", "forward"] = "inverse"

    def learn(self, source: Source) -> Learnt:
        """The domain of the training pairs' inputs."""
        train, validation = self.pairs(source).split(self.train_fraction, self.split, source.seed)
        domain = LeverageDomain.fit(train.x)
        inside = predict(domain, validation.x) <= domain.threshold.numpy()
        return Learnt(domain, {"threshold": float(domain.threshold), "inside": float(inside.mean())})
