"""The leverage domain as a model: a part of a model set, and of the law that holds it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.models.applicability import Leverage
from pipeline.models.base import Model
from pipeline.models.part import Learnt, Regions, StaticPart, predict
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.records.record import Record


class Interval(NamedTuple):
    """The values of w inside the domain at a state: centre +- half, while room > 0."""

    centre: Tensor  # (..., 1) [w] global linear prediction of w from the state
    half: Tensor  # (..., 1) [w] zero where the state itself is outside
    room: Tensor  # (..., 1) leverage that the state leaves for w; negative: no w is inside


class LeverageDomain(Model):
    """Leverage of u = [x; w] and the interval of w that keeps it below the threshold.

        h(u) = 1/K + |(x - mean_x) W|^2 + ((w - centre)/scale)^2 <= h*
        w    = centre(x) +- scale sqrt(h* - 1/K - |(x - mean_x) W|^2)

    As a model: ``(..., N) -> (..., 1)``, the leverage. See ``pipeline.models.applicability.Leverage``.

    Source: [inverse_rbf, eqs 13-20].
    """

    kind: ClassVar[str] = "leverage_domain"

    mean_x: Tensor  # (N-1,)
    mean_w: Tensor  # (1,)
    project: Tensor  # (N-1, N): W, and the slope of the centre in the last column
    scale: Tensor  # (1,)
    free: Tensor  # (1,) h* - 1/K
    threshold: Tensor  # (1,) h*
    edge: Tensor  # (1,) h* and a little: a value of w at its bound lies on either side of h* by rounding

    def __init__(self, n_in: int) -> None:
        super().__init__()
        self.n_in = n_in
        shapes = {"mean_x": (n_in - 1,), "mean_w": (1,), "project": (n_in - 1, n_in)}
        shapes |= {"scale": (1,), "free": (1,), "threshold": (1,), "edge": (1,)}
        for name, shape in shapes.items():
            self.register_buffer(name, torch.ones(shape, dtype=torch.float64))

    @classmethod
    def fit(cls, u: NDArray[np.float64]) -> Self:
        """The domain of training inputs ``u``, shape (K, N), w last; raises ModelError."""
        fitted = Leverage.fit(u)
        numbers = {
            "mean_x": fitted.mean[:-1],
            "mean_w": fitted.mean[-1:],
            "project": np.column_stack([fitted.whiten, fitted.slope]),
            "scale": np.array([fitted.scale]),
            "free": np.array([fitted.threshold - fitted.offset]),
            "threshold": np.array([fitted.threshold]),
            "edge": np.array([fitted.threshold * (1 + 1e-9)]),
        }
        return cls.from_arrays({"n_in": u.shape[1]}, numbers)

    def config(self) -> dict[str, Any]:
        """The number of inputs."""
        return {"n_in": self.n_in}

    def interval(self, x: Tensor) -> Interval:
        """The interval of w at states ``x``, shape (..., N-1)."""
        along = (x - self.mean_x) @ self.project
        spread = along[..., :-1]
        room = self.free - (spread * spread).sum(dim=-1, keepdim=True)
        return Interval(self.mean_w + along[..., -1:], self.scale * room.relu().sqrt(), room)

    def leverage(self, at: Interval, w: Tensor) -> Tensor:
        """Leverage (..., 1) of w, shape (..., 1), at the state of an interval."""
        away = (w - at.centre) / self.scale
        return self.threshold - at.room + away * away

    def inside(self, leverage: Tensor) -> Tensor:
        """1.0 where a leverage (..., 1) is that of an input inside the domain, else 0.0."""
        return (leverage <= self.edge).to(leverage.dtype)

    def forward(self, x: Tensor) -> Tensor:
        """Leverage, shape (..., 1), of inputs [state, w], shape (..., N)."""
        return self.leverage(self.interval(x[..., :-1]), x[..., -1:])

    def bounds(self, at: Interval, y: Tensor, r: Tensor | float = 1.0) -> tuple[Tensor, Tensor]:
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

    def learn(
        self, record: Record | None, signals: Signals, regions: Regions, seed: int, plant: Simulator | None = None
    ) -> Learnt:
        """The domain of the training pairs' inputs."""
        train, validation = self.pairs(record, signals).split(self.train_fraction, self.split, seed)
        domain = LeverageDomain.fit(train.x)
        inside = predict(domain, validation.x) <= domain.threshold.numpy()
        return Learnt(domain, {"threshold": float(domain.threshold), "inside": float(inside.mean())})
