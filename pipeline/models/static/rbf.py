"""The radial basis function network: one torch module, and its design matrix for the fits."""

from __future__ import annotations

from typing import ClassVar, Literal, Self, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model

Basis = Literal["thin_plate", "gaussian"]
BASES: tuple[str, ...] = get_args(Basis)

# Below this a squared distance counts as zero: the spline's limit there is zero, its logarithm's is not.
ZERO_DISTANCE = 1e-30
# Rows of a design matrix that are computed at once: large enough for both cores, small enough for a small buffer.
DESIGN_ROWS = 8192


class RBF(Model):
    """A network of radial basis functions on inputs scaled to [-1, 1].

        y = sum_l w_l h(|u - c_l|),   u = 2 (x - low) / span - 1
        thin_plate: h(d) = d^2 log d = d^2 log(d^2) / 2      gaussian: h(d) = exp(-d^2 / (2 width^2))

    ``x`` is in engineering units, shape (..., n_in); ``y`` too, shape (..., n_out). There is no affine tail.

    The squared distance is written |u|^2 + (|c|^2 - 2 u c): three small nodes and one product in
    onnxruntime. Its cancellation costs about 1e-16 of the unit cube, no more than the rounding of
    the weighted sum itself, whose terms exceed the output a million times; so float64 throughout.

    Buffers: low, span (n_in,); centres (n_in, n_centres), one column each so that no constant is
    transposed in the graph; weights (n_out, n_centres); width (1,).

    Source: [inverse_rbf, eqs. 1-3].
    """

    kind: ClassVar[str] = "rbf"
    low: Tensor
    span: Tensor
    centres: Tensor
    weights: Tensor
    width: Tensor
    tiny: Tensor

    def __init__(self, n_in: int, n_centres: int, n_out: int = 1, *, basis: Basis = "thin_plate") -> None:
        super().__init__()
        if basis not in BASES:
            raise ModelError(f"basis {basis!r} is unknown; choose one of {', '.join(BASES)}")
        self.n_in, self.n_centres, self.n_out, self.basis = n_in, n_centres, n_out, basis
        self.reserve(low=(n_in,), span=(n_in,), centres=(n_in, n_centres), weights=(n_out, n_centres), width=(1,))
        # A Python float would reach the graph through float32, where it is a denormal or zero.
        self.register_buffer("tiny", torch.tensor([ZERO_DISTANCE], dtype=torch.float64), persistent=False)

    @classmethod
    def of(
        cls,
        centres: NDArray[np.float64],
        weights: NDArray[np.float64],
        low: NDArray[np.float64],
        span: NDArray[np.float64],
        *,
        basis: Basis = "thin_plate",
        width: float = 1.0,
    ) -> Self:
        """The network with these scaled centres (n_centres, n_in) and weights (n_out, n_centres)."""
        centres, weights = np.asarray(centres, np.float64), np.asarray(weights, np.float64)
        (n_centres, n_in), n_out = centres.shape, weights.shape[0]
        if weights.shape != (n_out, n_centres):
            raise ModelError(f"weights have shape {weights.shape} for {n_centres} centres; give (n_out, {n_centres})")
        arguments = {"n_in": n_in, "n_centres": n_centres, "n_out": n_out, "basis": basis}
        buffers = {"low": low, "span": span, "centres": centres.T, "weights": weights, "width": np.array([width])}
        return cls.from_arrays(arguments, buffers)

    def forward(self, x: Tensor) -> Tensor:
        """Output (..., n_out) [engineering units] for x (..., n_in) [engineering units]."""
        # Everything that holds buffers only is folded into one constant when the graph is loaded.
        scale = 2.0 / self.span
        u = x * scale - (self.low * scale + 1.0)
        slope, offset = -2.0 * self.centres, (self.centres * self.centres).sum(0)
        d2 = (u * u).sum(-1, keepdim=True) + (u @ slope + offset)  # shape: (..., n_centres)
        if self.basis == "thin_plate":
            h, weights = d2 * torch.log(torch.maximum(d2, self.tiny)), 0.5 * self.weights
        else:
            h, weights = torch.exp(d2 * (-0.5 / (self.width * self.width))), self.weights
        # An elementwise product and sum: twice as fast here as a product with an (n, 1) matrix, and out of
        # reach of onnxruntime's fusion of transposed constants, which is wrong for vectors.
        one = weights.shape[0] == 1  # saves two nodes
        return (h * weights[0]).sum(-1, keepdim=True) if one else (h.unsqueeze(-2) * weights).sum(-1)


def design_matrix(
    u: Tensor, centres: Tensor, basis: str, width: float, *, out: Tensor | None = None, work: Tensor | None = None
) -> Tensor:
    """Responses h of all centres to all samples, shape (K, L), for scaled u (K, n_in) and centres (L, n_in).

    ``out`` (at least K L numbers) and ``work`` (at least DESIGN_ROWS L numbers) are flat buffers that a
    caller with many fits reuses: the first touch of fresh memory costs more than the logarithms.
    """
    n_rows, n_centres = len(u), len(centres)
    out = torch.empty(n_rows * n_centres, dtype=u.dtype) if out is None else out
    z = out[: n_rows * n_centres].view(n_rows, n_centres)
    if basis == "thin_plate" and work is None:
        work = torch.empty(min(n_rows, DESIGN_ROWS) * n_centres, dtype=u.dtype)
    # |u|^2 - 2 u c + |c|^2 as one product, written once.
    ones = torch.ones(n_rows, 1, dtype=u.dtype)
    left = torch.cat([u, (u * u).sum(1, keepdim=True), ones], dim=1)
    right = torch.cat([-2.0 * centres.T, ones[:1].expand(1, n_centres), (centres * centres).sum(1)[None]], dim=0)
    for start in range(0, n_rows, DESIGN_ROWS):
        rows = z[start : start + DESIGN_ROWS]
        torch.mm(left[start : start + DESIGN_ROWS], right, out=rows)
        if basis == "thin_plate":
            assert work is not None
            log = work[: rows.numel()].view(rows.shape)
            torch.clamp(rows, min=ZERO_DISTANCE, out=log)
            torch.addcmul(torch.zeros((), dtype=u.dtype), rows, log.log_(), value=0.5, out=rows)
        else:
            rows.mul_(-0.5 / width**2).exp_()
    return z
