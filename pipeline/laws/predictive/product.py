"""A product and a sum as one operator."""

from __future__ import annotations

import torch
from torch import Tensor


def product(x: Tensor, w: Tensor, b: Tensor) -> Tensor:
    """Affine map x W + b for x (..., i, n), w (..., n, k), b broadcastable to (..., i, k).

    Matrices without leading dimensions, as in an exported graph, take one operator (Gemm), which has half the cost of
    two in a chain of small products.
    """
    return torch.addmm(b, x, w) if x.ndim == w.ndim == 2 else x @ w + b
