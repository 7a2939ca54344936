"""A local model network: linear models of a plant at several operating points, blended by where it is."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.linearization import Linearization
from loopwright.pipeline.plants.simulator import Array


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
