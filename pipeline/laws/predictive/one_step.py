"""One step of an identified model with loads, in the pieces that are affine."""

from __future__ import annotations

import torch
from torch import Tensor

from loopwright.pipeline.laws.predictive.loads import Loads
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.memory import Named


def one_step(model: Identified, loads: Loads, p: Named) -> dict[str, Tensor]:
    """``next`` = A x + B v' + c + X d and ``hidden`` = W1 [x, v'] + b1, which a linear model lacks; v' = v + V d.

    x+ = next + W2 tanh(hidden), of x (..., n_x), d (..., n_d) and v (..., n_v), all scaled.
    """
    x, d = p["x"], p["d"]
    v = p["v"] + d @ loads.into_v.T
    found = {"next": x @ model.a.T + v @ model.b.T + model.c + d @ loads.into_x.T}
    if model.n_hidden:
        found["hidden"] = torch.cat([x, v], dim=-1) @ model.w1.T + model.b1
    return found
