"""The linear model of a plant around one of its steady states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import ModelError
from pipeline.models.base import Model
from pipeline.models.part import Learnt, Part, Regions
from pipeline.plants.equations import EquationPlant, equations
from pipeline.plants.linearization import Linearization
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array, Simulator
from pipeline.records.record import Record


class Linearized(Model):
    """A plant linearized at a steady state and sampled with its MV held.

        x' = A (x - x0) + B (u - u0),   pv = pv0 + C (x - x0)
        pv(k+1) = pv0 + C (Phi (x(k) - x0) + Gamma (u(k) - u0))

    ``forward`` maps [x, mv] (..., n_x + n_mv) to the PVs one period later (..., n_pv). The
    matrices of the continuous model stay inside for laws that are tuned from them.

    Parameters
    ----------
    n_x, n_mv, n_pv
        Numbers of states, manipulated variables and process variables.
    period_s
        Sampling period [s].
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
        shapes: dict[str, tuple[int, ...]] = {
            "x": (n_x,),
            "mv": (n_mv,),
            "pv": (n_pv,),
            "a": (n_x, n_x),
            "b": (n_x, n_mv),
            "c": (n_pv, n_x),
            "one_period": (n_x + n_mv, n_pv),
        }
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    def config(self) -> dict[str, Any]:
        """JSON-ready arguments of the constructor."""
        return {"n_x": self.n_x, "n_mv": self.n_mv, "n_pv": self.n_pv, "period_s": self.period_s}

    @classmethod
    def of(cls, at: Linearization, period_s: float, *, pv: Array | None = None) -> Self:
        """The model of a linearization.

        ``pv`` (n_pv,) is the steady PV; None takes C x0, right where the PVs are linear in the state.
        """
        (n_x, n_mv), n_pv = at.b.shape, at.c.shape[0]
        model = cls(n_x, n_mv, n_pv, period_s)
        phi, gamma = at.sampled(period_s)
        values = {
            "x": at.x,
            "mv": at.mv,
            "pv": at.c @ at.x if pv is None else pv,
            "a": at.a,
            "b": at.b,
            "c": at.c,
            "one_period": (at.c @ np.hstack([phi, gamma])).T,
        }
        for name, value in values.items():
            getattr(model, name).copy_(torch.from_numpy(np.ascontiguousarray(value)))
        return model

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

    def learn(
        self, record: Record | None, signals: Signals, regions: Regions, seed: int, plant: Simulator | None = None
    ) -> Learnt:
        """The linearization; needs no data."""
        known = equations(plant, "a part of kind 'linearized'")
        x, mv = known.steady_state_at(self.at)
        lin = known.linearize(x, mv)
        zeros = lin.sampled_zeros(signals.period_s)
        metrics = {
            "eigenvalues": [[float(v.real), float(v.imag)] for v in lin.eigenvalues],
            "sampled_zeros": [[float(v.real), float(v.imag)] for v in zeros],
            "mv": [float(v) for v in mv],
        }
        return Learnt(Linearized.at_set_point(known, self.at), metrics)
