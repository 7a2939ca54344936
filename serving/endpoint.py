"""The plant's side of a loop: a device, a server, or a plant in memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.guard import Sample

Array: TypeAlias = NDArray[np.float64]


class Endpoint(Protocol):
    """The plant's side. Both calls raise EndpointError when the plant cannot be reached.

    Any other exception is taken the same way: the loop holds, names it and tries again.
    """

    def read(self) -> Sample:
        """The present sample."""

    def write(self, mv: Array) -> None:
        """Send an MV, shape (n_mv,)."""


@runtime_checkable
class HandsBack(Protocol):
    """An endpoint that can give the plant to the plant's own controller, for ``loopwright.serving.modes``."""

    def hand_back(self) -> None:
        """Give the plant back."""


class SimulatedEndpoint:
    """A plant in memory: ``step(mv) -> pv`` is called at each write and gives the PV one period later.

    Parameters
    ----------
    step
        (n_mv,) -> (n_pv,)
    pv, mv
        PV at the start, and the MV that was applied before it.
    """

    def __init__(self, step: Callable[[Array], Array], *, pv: ArrayLike, mv: ArrayLike) -> None:
        self._step = step
        self._pv = np.array(pv, dtype=np.float64, ndmin=1)
        self._mv = np.array(mv, dtype=np.float64, ndmin=1)

    def read(self) -> Sample:
        """PV and applied MV."""
        return Sample(pv=self._pv, mv_applied=self._mv)

    def write(self, mv: Array) -> None:
        """Apply the MV for one period."""
        self._mv = np.array(mv, dtype=np.float64)
        self._pv = np.asarray(self._step(self._mv), dtype=np.float64)
