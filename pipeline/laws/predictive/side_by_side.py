"""Several laws of one structure as one module, so that a search tries them all in one simulation."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import nn

M = TypeVar("M", bound=nn.Module)


def side_by_side(laws: Sequence[M]) -> M:
    """A law for inputs (C, loops, n) whose first index is that of the law among ``laws``.

    A buffer in which the laws differ has all their values, (C, 1, ...), or (C, 1, 1, n) of vectors. They must have the
    same shapes, as laws of one model with the same horizon and moves do.
    """
    together = copy.deepcopy(laws[0])
    buffers = [dict(law.named_buffers()) for law in laws]
    for name, values in buffers[0].items():
        if any(not torch.equal(values, other[name]) for other in buffers[1:]):
            owner, _, leaf = name.rpartition(".")
            stacked = torch.stack([b[name] for b in buffers]).unsqueeze(1)
            # The laws compute with rows (..., 1, n), whose second last index a vector lacks.
            setattr(together.get_submodule(owner), leaf, stacked.unsqueeze(1) if values.ndim == 1 else stacked)
    return together
