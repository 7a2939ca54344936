"""Recursive least squares with forgetting, bounded, and the ARX model that a control law learns on with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.lagged.lagged import ARX
from loopwright.pipeline.models.memory import Named, Slot, lag_slots, regressors
from loopwright.serving.manifest import Signal

# Below this the bound's step overshoots: the covariance of a direction without excitation would not settle on it.
LEAST_BOUNDED = 0.45


class RecursiveLeastSquares(nn.Module):
    """One update of a linear model y(t) = phi(t)' theta with a new sample.

        e     = y - phi' theta
        theta = theta + K e,             K = P phi / (f + phi' P phi)
        P     = (P - K phi' P) / f

    so that theta(N) minimizes sum_k f^(N-k) (y_k - phi_k' theta)^2 + f^N |theta - theta0|^2 in the
    metric of P0^-1. The state is a square root of the covariance, P = S S', by Potter's form:

        w = S' phi,  beta = f + w'w,  K = S w / beta,  S = (S - S w w' / (beta + sqrt(f beta))) / sqrt(f)

    so P is symmetric and has no negative eigenvalue whatever rounding does. With ``largest`` the
    division by sqrt(f) becomes S (sqrt(1/f) I - (sqrt(1/f) - 1) S'S / largest): an eigenvalue far
    below ``largest`` forgets as above, one at ``largest`` stays. Directions in which the data tell
    nothing thus settle there instead of growing without end, and the others do not notice.

    There is no state inside: theta and S come in and go out, with any batch dimensions in front.

        rls = RecursiveLeastSquares(0.98, largest=10.0)
        theta, root = torch.zeros(n), rls.start(n, 10.0)
        theta, root, error = rls(theta, root, phi, y)     # error: of the prediction before the update
        predicted, theta, root = rls.run(phi, y, theta, root)      # a whole record, one step ahead each

    ``forgetting`` is f in (0, 1]; 1 forgets nothing. ``largest`` is the largest eigenvalue that P keeps; None is no
    bound, and P then grows without excitation. It holds for every direction alike, so phi, theta and y should be of
    the order of one (scale them before).

    Source: Astrom and Wittenmark, Adaptive Control, ch. 2 (recursion); Bierman, Factorization
    Methods for Discrete Sequential Estimation, ch. 2 (Potter's form); the bound follows Salgado,
    Goodwin and Middleton, Int. J. Control 47 (1988), 477, here taken on the root.

    Raises ModelError for a forgetting factor outside (0, 1], or below 0.45 with a bound, or a bound not above 0.
    """

    # float64 numbers in buffers: the exporter rounds plain floats to float32
    forgetting: Tensor  # (1,)
    growth: Tensor  # (1, 1) sqrt(1/f)
    excess: Tensor  # (1, 1) (sqrt(1/f) - 1) / largest

    def __init__(self, forgetting: float, largest: float | None = None) -> None:
        super().__init__()
        if not 0 < forgetting <= 1:
            raise ModelError(f"the forgetting factor is {forgetting}; it must lie in (0, 1], 1 to forget nothing")
        if largest is not None and not largest > 0:
            raise ModelError(f"largest covariance is {largest}; it must be above 0, or None for no bound")
        if largest is not None and forgetting < LEAST_BOUNDED:
            raise ModelError(
                f"the forgetting factor is {forgetting}; with a bounded covariance it must be {LEAST_BOUNDED} or above"
            )
        growth = forgetting**-0.5
        self.register_buffer("forgetting", torch.tensor([forgetting], dtype=torch.float64))
        self.register_buffer("growth", torch.tensor([[growth]], dtype=torch.float64))
        excess = 0.0 if largest is None else (growth - 1) / largest
        self.register_buffer("excess", torch.tensor([[excess]], dtype=torch.float64))
        self.bounded = excess > 0
        self.largest = largest

    def start(self, n: int, variance: float | None = None) -> Tensor:
        """The root (n, n) of P0 = variance I; None is ``largest``. Raises ModelError above ``largest``."""
        p0 = self.largest if variance is None else variance
        if p0 is None or not p0 > 0 or (self.largest is not None and p0 > self.largest):
            raise ModelError(
                f"the first covariance is {p0}; give a number above 0 and not above largest={self.largest}"
            )
        return p0**0.5 * torch.eye(n, dtype=torch.float64)

    def forward(self, theta: Tensor, root: Tensor, phi: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """New theta (..., n), new root (..., n, n), e (..., 1); regressor phi (..., n), y (..., 1)."""
        error = y - (phi * theta).sum(-1, keepdim=True)
        w = (phi.unsqueeze(-2) @ root).squeeze(-2)
        beta = self.forgetting + (w * w).sum(-1, keepdim=True)
        gain = (root @ w.unsqueeze(-1)).squeeze(-1) / beta
        theta = theta + gain * error
        # S w w' / (beta + sqrt(f beta)) = K w' / (1 + sqrt(f / beta))
        shrunk = gain / (1 + (self.forgetting / beta).sqrt())
        root = root - shrunk.unsqueeze(-1) * w.unsqueeze(-2)
        if self.bounded:
            # Sums of products, no transposed matrix: onnxruntime would fuse that, which its older versions cannot load.
            gram = (root.unsqueeze(-1) * root.unsqueeze(-2)).sum(-3)  # (..., n, n): S'S
            return theta, root @ (self.growth * torch.eye(root.shape[-1], dtype=root.dtype) - self.excess * gram), error
        return theta, self.growth * root, error

    @torch.no_grad()
    def run(self, phi: Tensor, y: Tensor, theta: Tensor, root: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Pass over rows phi (N, n), y (N,): predictions (N,), each before its row is learnt, then theta, root."""
        predicted = []
        for row, value in zip(phi, y, strict=True):
            theta, root, error = self(theta, root, row, value[None])
            predicted.append(value - error[0])
        return torch.stack(predicted), theta, root


class ArxSample(NamedTuple):
    """x(t), x(t+1) with u(t) = u(t-1), (..., n) each, and psi(t) (..., 1)."""

    x: Tensor
    x_ahead: Tensor
    psi: Tensor


class ArxEstimate(NamedTuple):
    """Parameters theta (..., n) with what this sample taught; what a law asks of them, and remembers.

    ``slope`` (..., 1) [pv] is that of y(t+1) over one unit of move.
    """

    theta: Tensor
    slope: Tensor
    kept: dict[str, Tensor]


class RecursiveArx(nn.Module):
    """The parameters theta of a linear model of a filtered output, learnt on at every sample.

        psi(t) = eta(t) + p_1 eta(t-1) + .. = theta' x(t),
        x(t) = [eta(t-1), .., eta(t-n_y), v(t-1), .., v(t-n_u), 1]

    with eta = (y - middle of the set point's range)/half of it and v = (u - middle of the MV's
    range)/unit, so that all of x is of the order of one, as RecursiveLeastSquares wants it. Without
    a prefilter p this is the ARX model itself. A sample whose lags are not all measured teaches
    nothing.

    A law gives ``slots`` to its Memory.

    Parameters
    ----------
    model
        Where theta starts: an ARX of one MV with delay 1.
    sp, mv
        Signals whose ranges scale y and u.
    unit
        What v counts [mv]: half of the MV's range, with the sign of the plant's gain.
    rls
        How it learns; theta starts with its largest covariance.
    prefilter
        p_1, p_2, ..; theta then starts where model and prefilter say.
    n_y
        Lags of y, at least those of the model and of the prefilter; None takes as many.
    """

    pv_unit: Tensor  # (1,) [pv]

    def __init__(
        self,
        model: ARX,
        sp: Signal,
        mv: Signal,
        unit: float,
        rls: RecursiveLeastSquares,
        prefilter: Sequence[float] = (),
        n_y: int | None = None,
    ) -> None:
        super().__init__()
        self.rls = rls
        self.n_y = max(model.n_y, len(prefilter)) if n_y is None else n_y
        self.n_u, self.size = model.n_u, self.n_y + model.n_u + 1
        self.middle_y, self.half_y = (sp.low + sp.high) / 2, (sp.high - sp.low) / 2
        self.middle_u, self.unit = (mv.low + mv.high) / 2, unit
        self.prefilter = list(prefilter) + [0.0] * (self.n_y - len(prefilter))
        start = torch.zeros(self.size, dtype=torch.float64)
        start[: model.n_y] = model.weight[: model.n_y]
        start[: self.n_y] += torch.tensor(self.prefilter, dtype=torch.float64)
        start[self.n_y : -1] = model.weight[model.n_y :] * unit / self.half_y
        level = self.middle_y * (float(model.weight[: model.n_y].sum()) - 1)
        start[-1] = (float(model.bias) + level + self.middle_u * float(model.weight[model.n_y :].sum())) / self.half_y
        self.first = start
        self.register_buffer("pv_unit", torch.tensor([self.half_y], dtype=torch.float64))
        lags = max(self.n_y, self.n_u)
        none = torch.zeros(lags, dtype=torch.float64)
        self.slots = {
            **lag_slots(self.n_y, self.n_u),
            "seen": Slot(lags, none, lambda p: torch.cat([torch.ones_like(p["y"]), p["seen"]], -1)[..., :-1]),
            "theta": Slot(self.size, start),
            "root": Slot(self.size**2, rls.start(self.size).flatten()),
        }

    def sample(self, p: Named) -> ArxSample:
        """Regressors from the past and the sample, scaled."""
        now, ahead = (self._scaled(x) for x in regressors(p, self.n_y, self.n_u))
        eta = (p["y"] - self.middle_y) / self.half_y
        for i, weight in enumerate(self.prefilter):
            eta = eta + weight * now[..., i : i + 1]
        return ArxSample(now, ahead, eta)

    def output(self, x: Tensor, theta: Tensor) -> Tensor:
        """theta'x, shape (..., 1), of x and theta (..., n)."""
        return (x * theta).sum(dim=-1, keepdim=True)

    def _scaled(self, phi: Tensor) -> Tensor:
        y, u = phi[..., : self.n_y], phi[..., self.n_y :]
        one = torch.ones_like(phi[..., :1])
        return torch.cat([(y - self.middle_y) / self.half_y, (u - self.middle_u) / self.unit, one], dim=-1)

    def forward(self, p: Named, sample: ArxSample) -> ArxEstimate:
        """The parameters after this sample."""
        theta, flat = p["theta"], p["root"]
        root = flat.reshape(*flat.shape[:-1], self.size, self.size)
        # While lags are missing, x counts as nothing: theta stays, and so does a covariance that is the largest.
        complete = p["seen"][..., -1:]
        theta, root, _ = self.rls(theta, root, complete * sample.x, sample.psi)
        slope = theta[..., self.n_y : self.n_y + 1] * self.pv_unit
        return ArxEstimate(theta, slope, {"theta": theta, "root": root.flatten(-2)})
