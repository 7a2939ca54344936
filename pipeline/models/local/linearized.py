"""The linear model of a plant around one of its steady states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.part import Learnt, Part, Source
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.linearization import Linearization
from loopwright.pipeline.plants.simulator import Array


class Linearized(Model):
    """A plant linearized at a steady state and sampled with its MV held.

        x' = A (x - x0) + B (u - u0),   pv = pv0 + C (x - x0)
        pv(k+1) = pv0 + C (Phi (x(k) - x0) + Gamma (u(k) - u0))

    ``forward`` maps [x, mv] (..., n_x + n_mv) to the PVs one sampling period ``period_s`` [s] later (..., n_pv).
    The matrices of the continuous model stay inside for laws that are tuned from them.
    """

    kind: ClassVar[str] = "linearized"
    x: Tensor  # (n_x,) the steady state
    mv: Tensor  # (n_mv,)
    pv: Tensor  # (n_pv,)
    a: Tensor  # (n_x, n_x)
    b: Tensor  # (n_x, n_mv)
    c: Tensor  # (n_pv, n_x)
    one_period: Tensor  # (n_x + n_mv, n_pv), [C Phi, C Gamma] transposed, for z @ one_period

    def __init__(self, n_x: int, n_mv: int, n_pv: int, period_s: float) -> None:
        super().__init__()
        if min(n_x, n_mv, n_pv) < 1 or not period_s > 0:
            raise ModelError(
                f"a linearized model has n_x={n_x}, n_mv={n_mv}, n_pv={n_pv}, period_s={period_s}; all must be above 0"
            )
        self.n_x, self.n_mv, self.n_pv, self.period_s = n_x, n_mv, n_pv, period_s
        self.reserve(x=(n_x,), mv=(n_mv,), pv=(n_pv,), a=(n_x, n_x), b=(n_x, n_mv), c=(n_pv, n_x))
        self.reserve(one_period=(n_x + n_mv, n_pv))

    @classmethod
    def of(cls, at: Linearization, period_s: float, *, pv: Array | None = None) -> Self:
        """The model of a linearization.

        ``pv`` (n_pv,) is the steady PV; None takes C x0, right where the PVs are linear in the state.
        """
        (n_x, n_mv), n_pv = at.b.shape, at.c.shape[0]
        arguments = {"n_x": n_x, "n_mv": n_mv, "n_pv": n_pv, "period_s": period_s}
        buffers = {"x": at.x, "mv": at.mv, "pv": at.c @ at.x if pv is None else pv, "a": at.a, "b": at.b, "c": at.c}
        one_period = at.c @ np.hstack(at.sampled(period_s))
        return cls.from_arrays(arguments, buffers | {"one_period": one_period.T})

    @classmethod
    def at_set_point(cls, plant: EquationPlant, cv: float) -> Self:
        """The model at the steady state with controlled variable ``cv``; raises PlantError where there is none."""
        x, mv = plant.steady_state_at(cv)
        return cls.of(plant.linearize(x, mv), plant.period_s, pv=plant.measure(x))

    def linearization(self) -> Linearization:
        """The continuous model, per second."""
        return Linearization(*(t.numpy().copy() for t in (self.x, self.mv, self.a, self.b, self.c)))

    def forward(self, x: Tensor) -> Tensor:
        """PVs one period later, shape (..., n_pv), for [x, mv], shape (..., n_x + n_mv)."""
        return self.pv + (x - torch.cat([self.x, self.mv])) @ self.one_period


@dataclass(frozen=True, kw_only=True)
class LinearizedPart(Part):
    """The plant's own equations, linearized at the steady state with controlled variable ``at``."""

    model: ClassVar[type[Model]] = Linearized
    at: float

    def learn(self, source: Source) -> Learnt:
        """The linearization; needs no data."""
        model = Linearized.at_set_point(equations(source.plant, "a part of kind 'linearized'"), self.at)
        lin = model.linearization()
        metrics = {
            "eigenvalues": [[float(v.real), float(v.imag)] for v in lin.eigenvalues],
            "sampled_zeros": [[float(v.real), float(v.imag)] for v in lin.sampled_zeros(source.signals.period_s)],
            "mv": lin.mv.tolist(),
        }
        return Learnt(model, metrics)
