"""Many steps of one controller file side by side: a row each, for simulations of many plants."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Array, Controller
from loopwright.serving.errors import ContractError


class VectorizedStep(NamedTuple):
    """One step of every row. A row that ``Controller.step`` would refuse holds no number of worth, and is marked."""

    mv: Array  # shape: (n, n_mv)
    state: Array  # shape: (n, n_state)
    refused: NDArray[np.bool_]  # shape: (n,)


class VectorizedController:
    """Steps ``n`` loops of one controller, each with a state of its own.

    The graph is the one that the controller steps, in the same session and the same buffers, one row after the other:
    a row's numbers are those of ``Controller.step``, bit for bit. The checks of shapes, finite numbers and ranges are
    made for all rows at once, which is what makes it faster.
    """

    def __init__(self, controller: Controller, n: int) -> None:
        self.controller, self.n = controller, n
        places = controller.places
        self._mv, self._next = places.pop("mv"), places.pop("state_next")
        self._places = places
        self._given = np.zeros((n, controller.width))
        for name in {"operate", "fresh"} & set(places):  # as they are by default
            self._given[:, self._places.pop(name)] = controller.manifest.usual(name)

    def cold_state(self) -> Array:
        """States of zeros, shape (n, n_state): no past."""
        return np.zeros((self.n, self.controller.manifest.n_state))

    def step(self, *, sp: Array, pv: Array, dv: Array, mv_applied: Array, state: Array) -> VectorizedStep:
        """One step of each row; all inputs (n, ...), in engineering units. An input that the law has not is ignored.

        Raises ContractError for an input of another shape. A row with an input that is not finite, or whose output is
        not finite, outside the MV's range or further from ``mv_applied`` than the MV moves in a period, is marked as
        refused.
        """
        given = {"sp": sp, "pv": pv, "dv": dv, "mv_applied": mv_applied, "state": state}
        for name, place in self._places.items():
            wanted = (self.n, place.stop - place.start)
            if given[name].shape != wanted:
                raise ContractError(f"{name} has the shape {given[name].shape}; {self.n} rows need {wanted}")
            self._given[:, place] = given[name]
        taken = self.controller.compute(self._given)
        mv = taken[:, self._mv].copy()
        allowed: NDArray[np.bool_] = np.all(np.isfinite(taken), axis=1)
        for signal, moved, applied in zip(self.controller.manifest.mv, mv.T, mv_applied.T, strict=True):
            allowed &= (moved >= signal.low) & (moved <= signal.high)
            if signal.values is not None:
                allowed &= np.isin(moved, signal.values)
            if signal.most < np.inf:
                pairs = zip(applied.tolist(), moved.tolist(), strict=True)
                allowed &= np.array([signal.moves(before, after) for before, after in pairs])
        return VectorizedStep(mv, taken[:, self._next].copy(), np.logical_not(allowed))
