"""Many steps of one controller file side by side: a row each, for simulations of many plants."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Array, Controller
from loopwright.serving.errors import ContractError


class StepRows(NamedTuple):
    """One step of every row. A row that ``Controller.step`` would refuse holds no number of worth, and is marked."""

    mv: Array  # shape: (n, n_mv)
    state: Array  # shape: (n, n_state)
    refused: NDArray[np.bool_]  # shape: (n,)


class ControllerRows:
    """Steps ``n`` loops of one controller, each with a state of its own.

    The graph is the one that the controller steps, in the same session and the same buffers, one row after the other:
    a row's numbers are those of ``Controller.step``, bit for bit. The checks of shapes, finite numbers and ranges are
    made for all rows at once, which is what makes it faster.
    """

    def __init__(self, controller: Controller, n: int) -> None:
        self.controller, self.n = controller, n
        c = controller
        base = c._in.ctypes.data
        self._given = np.zeros((n, len(c._in)))
        self._taken = np.zeros((n, len(c._out)))
        self._places = {
            name: slice((part.ctypes.data - base) // 8, (part.ctypes.data - base) // 8 + shape[0])
            for _, name, part, shape in c._inputs
        }
        self._low = np.array([s.low for s in c.manifest.mv])
        self._high = np.array([s.high for s in c.manifest.mv])

    def cold_state(self) -> Array:
        """States of zeros, shape (n, n_state): no past."""
        return np.zeros((self.n, self.controller.manifest.n_state))

    def step(self, *, sp: Array, pv: Array, dv: Array, mv_applied: Array, state: Array) -> StepRows:
        """One step of each row; all inputs (n, ...), in engineering units. An input that the law has not is ignored.

        Raises ContractError for an input of another shape. A row with an input that is not finite, or whose output is
        not finite or outside the MV's range, is marked as refused.
        """
        c, given = self.controller, {"sp": sp, "pv": pv, "dv": dv, "mv_applied": mv_applied, "state": state}
        for name, place in self._places.items():
            wanted = (self.n, place.stop - place.start)
            if given[name].shape != wanted:
                raise ContractError(f"{name} has the shape {given[name].shape}; {self.n} rows need {wanted}")
            self._given[:, place] = given[name]
        fit: NDArray[np.bool_] = np.all(np.isfinite(self._given), axis=1)
        with c._lock:
            run, binding, buffer, result = c._session.run_with_iobinding, c._binding, c._in, c._out
            for row, out, good in zip(self._given, self._taken, fit.tolist(), strict=True):
                if not good:
                    continue
                buffer[:] = row
                try:
                    run(binding)
                except Exception:
                    out[:] = np.nan
                    continue
                out[:] = result
        n_mv, a, b, *_ = c._cuts
        mv = self._taken[:, :n_mv].copy()
        allowed: NDArray[np.bool_] = np.all((mv >= self._low) & (mv <= self._high), axis=1)
        for i, signal in enumerate(c.manifest.mv):
            if signal.values is not None:
                allowed &= np.isin(mv[:, i], signal.values)
        allowed &= fit & np.all(np.isfinite(self._taken), axis=1)
        return StepRows(mv, self._taken[:, a:b].copy(), np.logical_not(allowed))
