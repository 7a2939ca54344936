"""An affine function of named tensors as one matrix: a prediction over a horizon, condensed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from loopwright.pipeline.models.memory import Named


class AffineMap(nn.Module):
    """Named affine functions of a named vector, ``x (..., n) -> {name: (..., k)}``: one product, one sum, one split.

    ``formulas`` maps the pieces of x to the results; it is asked once, for every unit vector and
    for zero, so that it may be written as the formulas stand.
    """

    matrix: Tensor  # (n, sum of k)
    offset: Tensor  # (sum of k,)

    @torch.no_grad()
    def __init__(self, layout: Mapping[str, int], formulas: Callable[[Named], Named]) -> None:
        super().__init__()
        n = sum(layout.values())
        points = torch.cat([torch.eye(n, dtype=torch.float64), torch.zeros(1, n, dtype=torch.float64)])
        results = formulas(dict(zip(layout, torch.split(points, list(layout.values()), dim=-1), strict=True)))
        self.sizes = {name: value.shape[-1] for name, value in results.items()}
        table = torch.cat(list(results.values()), dim=-1)
        self.register_buffer("matrix", (table[:-1] - table[-1]).contiguous())
        self.register_buffer("offset", table[-1].clone())

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """The results at x (..., n)."""
        parts = torch.split(x @ self.matrix + self.offset, list(self.sizes.values()), dim=-1)
        return dict(zip(self.sizes, parts, strict=True))
