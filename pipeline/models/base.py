"""Base of every model: a float64 torch module with its scaling inside, and a file."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from loopwright.pipeline.files import draft_of


class Model(nn.Module, ABC):
    """A static map from engineering units to engineering units, ``(..., n_in) -> (..., n_out)``.

    Every number that the map needs, scaling included, is a float64 parameter or buffer, so that a
    law which holds the model holds all of it. Each argument of the constructor stays as an attribute
    of the same name: with the state dictionary they rebuild the model.
    """

    kind: ClassVar[str]

    def config(self) -> dict[str, Any]:
        """JSON-ready arguments of the constructor."""
        return {name: getattr(self, name) for name in signature(type(self)).parameters}

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """Prediction, shape (..., n_out), for inputs of shape (..., n_in)."""

    def save(self, path: Path) -> None:
        """Write the model as one .npz, whole or not at all."""
        header = json.dumps({"kind": self.kind, "config": self.config()})
        arrays = {k: v.detach().cpu().numpy() for k, v in self.state_dict().items()}
        with draft_of(path) as draft:
            np.savez(draft, __model__=np.array(header), **arrays)

    def reserve(self, **shapes: tuple[int, ...]) -> None:
        """Register a float64 buffer of each shape; ``from_arrays`` brings the numbers."""
        for name, shape in shapes.items():
            if hasattr(self, name):
                raise ValueError(f"{name!r} cannot name a buffer: every torch module has something of that name")
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    @classmethod
    def from_arrays(cls, config: Mapping[str, Any], arrays: Mapping[str, np.ndarray[Any, Any]]) -> Self:
        """The model with these arguments of the constructor and these parameters and buffers."""
        model = cls(**config).double()
        model.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in arrays.items()})
        return model.eval()


def simulate(model: Model, start: Tensor, mv: Tensor) -> Tensor:
    """States (..., k, n) after each of the moves mv (..., k, n_mv), free run from start (..., n).

    ``model`` maps [state, mv] to the state one period later.
    """
    states = [start]
    for move in mv.unbind(dim=-2):
        states.append(model(torch.cat([states[-1], move], dim=-1)))
    return torch.stack(states[1:], dim=-2)
