"""Recursive least squares with forgetting, its covariance in square-root form and bounded."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import ModelError

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
