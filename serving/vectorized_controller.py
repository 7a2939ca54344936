"""Many steps of one controller file side by side: a row each, for simulations of many plants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Array, Controller
from loopwright.serving.errors import ContractError
from loopwright.serving.operating import Operate
from loopwright.serving.preview.differences import Differences

ComputeRows = Callable[[Array], Array]
"""The graph's outputs (n, n_out) of rows (n, n_in), as ``Controller.compute`` gives them: nan for a row not finite."""
STEERING = frozenset({"operate", "fresh", "ahead"})  # inputs with defaults


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

    ``compute`` may be another host of the same law, such as its plain C; None: the controller's session.
    """

    def __init__(self, controller: Controller, n: int, compute: ComputeRows | None = None) -> None:
        self.controller, self.n = controller, n
        self._compute = controller.compute if compute is None else compute
        places = controller.places
        self._mv, self._next = places["mv"], places["state_next"]
        self._places = {name: places[name] for name in controller.manifest.inputs}
        self._given = np.zeros((n, controller.width))
        m = controller.manifest
        self._operate = Operate(m.operate)
        if m.ahead is not None:
            self._differences = Differences(m.ahead)
        self._checked: Array | None = None  # shape: (n, n_operate), the last rows of operate that were allowed
        usual = {name: np.array(controller.manifest.usual(name)) for name in STEERING}
        self._defaults: dict[str, Array] = {name: np.tile(values, (n, 1)) for name, values in usual.items()}

    def cold_state(self) -> Array:
        """States of zeros, shape (n, n_state): no past."""
        return np.zeros((self.n, self.controller.manifest.n_state))

    def step(
        self,
        *,
        sp: Array,
        pv: Array,
        dv: Array,
        mv_applied: Array,
        state: Array,
        operate: Array | None = None,
        fresh: Array | None = None,
        ahead: Array | None = None,
    ) -> VectorizedStep:
        """One step of each row; all inputs (n, ...), in engineering units. An input that the law has not is ignored.

        ``operate`` (n, n_operate) as the manifest's ``operate`` lists it, None: its defaults; ``fresh`` (n, n_pv), 1
        for a new and good reading, else 0, None: all are; ``ahead`` (n, N n_signals) as the manifest's ``ahead`` lists
        it, None: nothing changes.

        Raises ContractError for an input of another shape, for a value of ``operate``, ``fresh`` or ``ahead`` that is
        not allowed, with its row, and for an ``ahead`` that the law does not read.

        A row with an input that is not finite, or whose output is not finite, outside the MV's
        range or further from ``mv_applied`` than the MV moves in a period, is marked as refused.
        """
        given = {"sp": sp, "pv": pv, "dv": dv, "mv_applied": mv_applied, "state": state}
        given |= {"operate": self._steering("operate", operate), "fresh": self._steering("fresh", fresh)}
        given["ahead"] = self._steering("ahead", ahead)
        if ahead is not None and "ahead" not in self._places:
            raise ContractError(f"the law {self.controller.manifest.law!r} does not read ahead; leave ahead out")
        for name, place in self._places.items():
            wanted = (self.n, place.stop - place.start)
            if given[name].shape != wanted:
                raise ContractError(f"{name} has the shape {given[name].shape}; {self.n} rows need {wanted}")
            if name in STEERING:
                self._require_allowed(name, given)
            self._given[:, place] = given[name]
        taken = self._compute(self._given)
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

    def _steering(self, name: str, rows: Array | None) -> Array:
        """``rows`` (n, ...), or the defaults in each."""
        return self._defaults[name] if rows is None else np.asarray(rows, dtype=np.float64)

    def _require_allowed(self, name: str, given: Mapping[str, Array]) -> None:
        """ContractError, with its number, for the first row (n, ...) that ``Controller.step`` would not take."""
        rows = given[name]
        if rows is self._defaults[name]:
            return
        if name == "fresh":
            good = ((rows == 0) | (rows == 1)).all(axis=1)
            if not good.all():
                k = int(np.argmin(good))
                raise ContractError(f"row {k}: fresh is {rows[k].tolist()}; each is 1 for a new and good reading, or 0")
            return
        if name == "ahead":
            present = np.concatenate([given["sp"], given["dv"]], axis=1)
            bad = ~self._differences.allowed(rows, present).all(axis=1)
            for k in np.flatnonzero(bad).tolist():
                self._refused(k, partial(self._differences.checked, rows[k], present[k]))
            return
        if self._checked is not None and np.array_equal(rows, self._checked):
            return  # operators change little from one step to the next
        for k in np.unique(rows, axis=0, return_index=True)[1].tolist():  # most rows have the same values
            self._refused(k, partial(self._operate.checked, rows[k]))
        self._checked = rows.copy()

    @staticmethod
    def _refused(k: int, check: Callable[[], object]) -> None:
        """ContractError with the row k where ``check`` raises one."""
        try:
            check()
        except ContractError as error:
            raise ContractError(f"row {k}: {error}") from error
