"""Linear models of a plant around its steady states, and the local model network that blends them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.part import Learnt, Part, Source
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.plants.steady import Linearization


class Validity(nn.Module):
    """How far each of m local models or controllers is valid: normalized Gaussians of the controlled variable.

        rho_i(y) = exp(-((y - c_i)/sigma_i)^2 / 2) / sum_j exp(-((y - c_j)/sigma_j)^2 / 2)

    (..., 1) -> (..., m). A softmax of the exponents, so that far from every centre the nearest one
    (in its own width) still gets the whole weight instead of 0/0.

    Source: [gao2002, section IV.B]; its widths are not printed.
    """

    centre: Tensor  # (m,) [CV], in units of the width
    inverse_width: Tensor  # (m,) [1/CV]

    def __init__(self, centre: Tensor, width: Tensor) -> None:
        super().__init__()
        if centre.ndim != 1 or width.shape != centre.shape or not bool((width > 0).all()):
            raise ModelError(
                f"validity functions need as many widths above 0 as centres; got centres {centre.tolist()} "
                f"and widths {width.tolist()}"
            )
        # exp(-z^2/2) as exp(-(z/sqrt 2)^2): the square alone stays to be computed.
        inverse = 1.0 / (width * np.sqrt(2.0))
        self.register_buffer("centre", centre * inverse)
        self.register_buffer("inverse_width", inverse)

    def forward(self, cv: Tensor) -> Tensor:
        """Weights (..., m) at the controlled variable (..., 1); each row sums to 1."""
        distance = cv * self.inverse_width - self.centre
        return torch.softmax(-(distance * distance), dim=-1)


class LocalModels(Model):
    """Linear models at m steady states (x_i, u_i), blended by the controlled variable.

        x(k+1) = sum_i rho_i(x_1(k)) [ x_i + Phi_i (x(k) - x_i) + Gamma_i (u(k) - u_i) ]

    with (Phi_i, Gamma_i) the zero-order-hold discretization of the local (A_i, B_i) over ``period_s`` [s]. ``forward``
    maps [x, u] (..., n_x + 1) to the states one period later (..., n_x); fed with its own result it
    is a simulation that never sees the plant. The continuous matrices stay inside for laws that
    are tuned from them. The first state is the controlled variable, and every state is measured.

    Source: [gao2002, eq. 2], which blends the derivatives; blended are here
    their exact integrals over a period, in which the weights stay as they are.
    """

    kind: ClassVar[str] = "local_models"
    x: Tensor  # (m, n_x) operating points
    mv: Tensor  # (m, 1)
    width: Tensor  # (m,) of the validity functions [CV]
    a: Tensor  # (m, n_x, n_x) 1/s
    b: Tensor  # (m, n_x, 1)
    one_period: Tensor  # (n_x + 1, m n_x), [Phi_i, Gamma_i] transposed and side by side
    offset: Tensor  # (m n_x,), x_i - Phi_i x_i - Gamma_i u_i

    def __init__(self, n_models: int, n_x: int, period_s: float) -> None:
        super().__init__()
        if n_models < 1 or n_x < 1 or not period_s > 0:
            raise ModelError(
                f"a local model network has n_models={n_models}, n_x={n_x}, period_s={period_s}; all must be above 0"
            )
        self.n_models, self.n_x, self.period_s = n_models, n_x, period_s
        self.reserve(x=(n_models, n_x), mv=(n_models, 1), width=(n_models,))
        self.reserve(a=(n_models, n_x, n_x), b=(n_models, n_x, 1))
        self.reserve(one_period=(n_x + 1, n_models * n_x), offset=(n_models * n_x,))

    @classmethod
    def of(cls, points: list[Linearization], width: Array, period_s: float) -> Self:
        """The network of some linearizations, with the widths (m,) of their validity functions."""
        sampled = [np.hstack(p.sampled(period_s)) for p in points]  # (n_x, n_x + 1) each
        buffers = {name: np.array([getattr(p, name) for p in points]) for name in ("x", "mv", "a", "b")}
        buffers |= {
            "width": np.asarray(width, dtype=np.float64),
            "one_period": np.vstack(sampled).T,
            "offset": np.concatenate([p.x - s @ np.append(p.x, p.mv) for p, s in zip(points, sampled, strict=True)]),
        }
        return cls.from_arrays({"n_models": len(points), "n_x": len(points[0].x), "period_s": period_s}, buffers)

    @classmethod
    def at_set_points(cls, plant: EquationPlant, cvs: list[float], overlap: float) -> Self:
        """The network of the plant's own equations, linearized at the steady states with these controlled variables.

        ``overlap`` times the mean distance to the neighbours is the width of each validity function.
        Raises PlantError where there is no such steady state, ModelError for fewer than two different ones.
        """
        if len(set(cvs)) < max(2, len(cvs)) or not overlap > 0:
            raise ModelError(f"local models need two or more different points and overlap > 0; got {cvs}, {overlap}")
        points = [plant.linearize(*plant.steady_state_at(cv)) for cv in cvs]
        return cls.of(points, overlap * spacing(np.array(cvs)), plant.period_s)

    def validity(self) -> Validity:
        """The validity functions, for a law that blends by them too."""
        return Validity(self.x[:, 0], self.width)

    def linearizations(self) -> list[Linearization]:
        """The local models, continuous, per second."""
        c = np.eye(self.n_x)
        rows = zip(self.x.numpy(), self.mv.numpy(), self.a.numpy(), self.b.numpy(), strict=True)
        return [Linearization(x.copy(), mv.copy(), a.copy(), b.copy(), c) for x, mv, a, b in rows]

    def forward(self, x: Tensor) -> Tensor:
        """States one period later, shape (..., n_x), for [x, mv], shape (..., n_x + 1)."""
        distance = (x[..., :1] - self.x[:, 0]) / (self.width * np.sqrt(2.0))
        rho = torch.softmax(-(distance * distance), dim=-1)
        local = (x @ self.one_period + self.offset).reshape(*x.shape[:-1], self.n_models, self.n_x)
        return (rho[..., None] * local).sum(dim=-2)


def spacing(at: Array) -> Array:
    """Mean distance of each point to its neighbours, shape (m,); the outer ones have one neighbour."""
    order = np.argsort(at)
    gaps = np.diff(at[order])
    mean = np.concatenate([gaps[:1], (gaps[1:] + gaps[:-1]) / 2, gaps[-1:]])
    found = np.empty_like(mean)
    found[order] = mean
    return found


class LinearizedPlant(Model):
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

    model: ClassVar[type[Model]] = LinearizedPlant
    at: float

    def learn(self, source: Source) -> Learnt:
        """The linearization; needs no data."""
        model = LinearizedPlant.at_set_point(equations(source.plant, "a part of kind 'linearized'"), self.at)
        lin = model.linearization()
        metrics = {
            "eigenvalues": [[float(v.real), float(v.imag)] for v in lin.eigenvalues],
            "sampled_zeros": [[float(v.real), float(v.imag)] for v in lin.sampled_zeros(source.signals.period_s)],
            "mv": lin.mv.tolist(),
        }
        return Learnt(model, metrics)
