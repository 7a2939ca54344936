"""One step of an identified model with loads, in the pieces that are affine."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from pipeline.models.identified.identified import Identified
from pipeline.models.memory import Named


def one_step(model: Identified, p: Named) -> dict[str, Tensor]:
    """``next`` = A x + B v + c + [d; 0] and ``hidden`` = W1 [x, v] + b1, which a linear model lacks.

    x+ = next + W2 tanh(hidden), of x (..., n_x), d (..., n_y) and v (..., n_v), all scaled.
    """
    x, d, v = p["x"], p["d"], p["v"]
    found = {"next": x @ model.a.T + v @ model.b.T + model.c + pad(d, (0, model.n_x - model.n_y))}
    if model.n_hidden:
        found["hidden"] = torch.cat([x, v], dim=-1) @ model.w1.T + model.b1
    return found
