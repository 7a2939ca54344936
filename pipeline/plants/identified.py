"""A plant that was identified from a record, as a simulator: plain arrays, and parameters that spoil it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.steady_state import START_REST_PERIODS, STATE_CHANGE, STILL_WITHIN, run_to_rest
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.simulator import AdvanceMany, Array, Signals, Simulator

NEWTON_STEPS, NEWTON_SINGULAR, NEWTON_WITHIN = 12, 1e6, 10.0
"""Steps; condition of their equations beyond which a plant integrates; scaled outputs beyond which none is at rest."""


@dataclass(frozen=True, slots=True, eq=False)
class StateEquation:
    """x+ = A x + B v + c + W2 tanh(W1 [x, v] + b1) in scaled numbers, with v = [mv, dv]."""

    a: Array  # (n_x, n_x)
    b: Array  # (n_x, n_v)
    c: Array  # (n_x,)
    w1: Array  # (n_hidden, n_x + n_v)
    b1: Array  # (n_hidden,)
    w2: Array  # (n_x, n_hidden)

    def advance(self, x: Array, v: Array) -> Array:
        """The next states (..., n_x) of scaled states (..., n_x) under scaled inputs (..., n_v)."""
        linear = x @ self.a.T + v @ self.b.T + self.c
        if not len(self.b1):
            return linear
        z = np.concatenate([x, v], axis=-1)
        return linear + np.tanh(z @ self.w1.T + self.b1) @ self.w2.T

    def slope(self, x: Array, v: Array) -> Array:
        """dx+/dx (n_x, n_x) at one state x (n_x,) under v (n_v,)."""
        t = np.tanh(self.w1 @ np.concatenate([x, v]) + self.b1)
        return self.a + (self.w2 * (1 - t * t)) @ self.w1[:, : len(self.a)]


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedArrays(StateEquation):
    """The equation whose first n_y states are the scaled outputs, and its scales."""

    y_center: Array  # (n_y,)
    y_scale: Array  # (n_y,)
    v_center: Array  # (n_v,)
    v_scale: Array  # (n_v,)
    rest: Array  # (n_x, n_y + n_v + 1) state of a rest from [y, v, 1], scaled


class IdentifiedPlant(Simulator):
    """One member of an ensemble of identified models as a plant, with a load, and errors of gain, speed and dead time.

    Its state is [x scaled, the last ``most_dead_time`` MVs scaled, newest first]. Each period, with v the inputs
    of ``dead_time`` periods ago and v0 those at the start,

        x+ = x + (F(x, v0 + gain (v - v0)) - x) / time_constant + load / y_scale   (the load on the outputs only)

    and where ``time_constant`` is below 1, a part of a second step under the same inputs, which leaves a stable plant
    stable: x+ = F(x) + (1 / time_constant - 1) (F(F(x)) - F(x)).

    The parameters are, by name: ``gain_MV`` of each MV (1), ``time_constant`` (1), ``dead_time`` (0, whole or
    fractional periods up to ``most_dead_time``), ``load_PV`` of each output (0, in the PV's unit a period). States
    that only remember an input or another state (a dead time inside the model) are not slowed down.

    ``signals`` hold the n_y outputs first among the PVs; only these are measured. The start is the rest at ``mv``
    (n_mv,) (None: the middle of each range) under ``dv`` (n_dv,) (None: the centre of the data); where the plant
    does not settle (an integrator), it is the rest of the model that is nearest to the centre of the outputs.

    Raises PlantError for shapes that do not fit.
    """

    name = "identified"
    title = "Identified plant"

    def __init__(
        self,
        signals: Signals,
        arrays: IdentifiedArrays,
        *,
        name: str = "identified",
        mv: Array | None = None,
        dv: Array | None = None,
        most_dead_time: int = 0,
    ) -> None:
        n_y, n_mv, n_dv = len(arrays.y_scale), len(signals.mv), len(signals.dv)
        if len(signals.pv) < n_y or len(arrays.v_scale) != n_mv + n_dv:
            raise PlantError(
                f"an identified plant of {n_y} outputs and {len(arrays.v_scale)} inputs got {len(signals.pv)} PVs, "
                f"{n_mv} MVs and {n_dv} measured disturbances; give the signals of its record"
            )
        # The attributes that other plants have by their class, this one has by its record.
        vars(self).update(
            name=name,
            period_s=signals.period_s,
            pv_signals=signals.pv[:n_y],
            sp_signals=signals.sp,
            mv_signals=signals.mv,
            dv_signals=signals.dv,
        )
        self.arrays, self.most_dead_time, self.n_mv = arrays, most_dead_time, n_mv
        self._mv = np.array([s.middle for s in signals.mv]) if mv is None else np.asarray(mv, dtype=np.float64)
        self._dv = arrays.v_center[n_mv:] if dv is None else np.asarray(dv, dtype=np.float64)
        self._v0 = self._scaled(self._mv, self._dv)
        self.remembers = shift_rows(arrays)
        self._x0 = self._rest()

    def _scaled(self, mv: Array, dv: Array) -> Array:
        v = np.empty((*mv.shape[:-1], self.n_mv + len(self.dv_signals)))  # a broadcast array costs three times as much
        v[..., : self.n_mv], v[..., self.n_mv :] = mv, dv
        return (v - self.arrays.v_center) / self.arrays.v_scale

    @property
    def start_inputs(self) -> Array:
        """The inputs (n_v,) at the start, scaled: errors of gain turn about them."""
        return self._v0

    def _rest(self) -> Array:
        seen = np.zeros(len(self.arrays.y_scale))
        start = self.arrays.rest @ np.concatenate([seen, self._v0, [1.0]])

        def hold(x: Array) -> tuple[Array, Array]:
            ahead = self.arrays.advance(x, self._v0)
            return ahead, np.abs(ahead - x)

        x, moved = run_to_rest(hold, start, START_REST_PERIODS, STATE_CHANGE, within=STILL_WITHIN)
        if np.all(np.abs(x) < STILL_WITHIN) and np.all(moved <= STATE_CHANGE):
            return x
        found = self._rest_near(x)
        return np.concatenate([seen, start[len(seen) :]]) if found is None else found

    def _rest_near(self, x: Array) -> Array | None:
        """The rest (n_x,) that a slow plant was on its way to; None where it integrates, or would rest far outside."""
        for _ in range(NEWTON_STEPS):
            ahead = self.arrays.advance(x, self._v0)
            gap = np.eye(len(x)) - self.arrays.slope(x, self._v0)
            if not np.all(np.isfinite(ahead)) or np.linalg.cond(gap) > NEWTON_SINGULAR:
                return None
            if np.max(np.abs(ahead - x)) < STATE_CHANGE:
                far = np.max(np.abs(x[: len(self.arrays.y_scale)]))
                returns = np.max(np.abs(np.linalg.eigvals(np.eye(len(x)) - gap))) < 1
                return x if returns and far < NEWTON_WITHIN else None
            x = x + np.linalg.solve(gap, ahead - x)
        return None

    # ------------------------------------------------------------------ what a closed loop needs
    @property
    def start(self) -> tuple[Array, Array]:
        """(state (n_x,), mv (n_mv,)) of a rest."""
        return np.concatenate([self._x0, np.tile(self._v0[: self.n_mv], self.most_dead_time)]), self._mv.copy()

    def start_at(self, y: Array) -> Array:
        """The state (n_x,) of the rest that is nearest to outputs y (n_y,) [unit of the PVs] under the MV of the start.

        For integrating plants, which rest at any level.
        """
        seen = (np.asarray(y, dtype=np.float64) - self.arrays.y_center) / self.arrays.y_scale
        x = self.arrays.rest @ np.concatenate([seen, self._v0, [1.0]])
        return np.concatenate([seen, x[len(seen) :], np.tile(self._v0[: self.n_mv], self.most_dead_time)])

    @property
    def dv_nominal(self) -> Array:
        """Measured disturbances at the start, shape (n_dv,)."""
        return self._dv.copy()

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        """The state (..., n_x) one period later; shapes as in Simulator, or with leading dimensions."""
        n, m, f = len(self.arrays.a), self.n_mv, self.arrays
        gain, tau, dead, load = p[:m], p[m], p[m + 1], p[m + 2 :]
        v = self._scaled(mv, dv)
        held = np.concatenate([v[..., :m], x[..., n:]], axis=-1)
        whole = min(int(dead), self.most_dead_time)
        part = min(dead, self.most_dead_time) - whole
        acting = held[..., whole * m : (whole + 1) * m]
        if part > 0:
            acting = (1 - part) * acting + part * held[..., (whole + 1) * m : (whole + 2) * m]
        spoilt = self._v0[:m] + gain * (acting - self._v0[:m])
        inputs = np.concatenate([spoilt, v[..., m:]], axis=-1)
        ahead = f.advance(x[..., :n], inputs)
        if tau > 1.0:
            ahead = np.where(self.remembers, ahead, x[..., :n] + (ahead - x[..., :n]) / tau)
        elif tau < 1.0:
            second = f.advance(np.where(self.remembers, x[..., :n], ahead), inputs)
            ahead = np.where(self.remembers, ahead, ahead + (1 / tau - 1) * (second - ahead))
        ahead[..., : len(load)] += load / f.y_scale
        if not self.most_dead_time:
            return ahead
        return np.concatenate([ahead, held[..., : self.most_dead_time * m]], axis=-1)

    def measure(self, x: Array) -> Array:
        """The outputs (n_y,) of a state, in their units."""
        return self.measured(x)

    def measured(self, x: Array) -> Array:
        """Outputs (..., n_y) of states (..., n_x), in their units."""
        return x[..., : len(self.arrays.y_scale)] * self.arrays.y_scale + self.arrays.y_center

    def many(self, n: int, p: Array | None = None) -> AdvanceMany:
        """``step`` of ``n`` runs side by side, in one product; as in Simulator."""
        dv, known = self.dv_nominal, self.parameters() if p is None else p
        return lambda x, mv: self.step(x, mv, dv, known)

    # ------------------------------------------------------------------ parameters
    def parameter_names(self) -> tuple[str, ...]:  # type: ignore[override]  # they follow the signals of the record
        """Names of the plant's parameters, in the order of the parameter vector."""
        gains = (f"gain_{s.name}" for s in self.mv_signals)
        return (*gains, "time_constant", "dead_time", *(f"load_{s.name}" for s in self.pv_signals))

    def parameter_units(self) -> dict[str, str]:  # type: ignore[override]
        """Unit of each parameter: factors have none, the dead time counts periods, a load is in its PV's unit."""
        units = dict.fromkeys(self.parameter_names(), "1")
        return {**units, "dead_time": "periods", **{f"load_{s.name}": s.unit for s in self.pv_signals}}

    def parameters(self, changed: Mapping[str, float] | None = None) -> Array:
        """The parameter vector, shape (n_p,), with some of them changed by name.

        Raises PlantError for a name that the plant does not have, and for a value that cannot be.
        """
        names = self.parameter_names()
        values = {n: 1.0 if n == "time_constant" or n.startswith("gain_") else 0.0 for n in names}
        for key, value in (changed or {}).items():
            if key not in values:
                raise PlantError(f"plant {self.name!r} has no parameter {key!r}; it has {', '.join(names)}")
            values[key] = float(value)
        if not 0 <= values["dead_time"] <= self.most_dead_time:
            raise PlantError(
                f"plant {self.name!r}: dead_time is {values['dead_time']:g} periods; it must be 0 to "
                f"{self.most_dead_time}, the plant's most_dead_time: make the plant with a larger one"
            )
        if values["time_constant"] <= 0.5:
            raise PlantError(
                f"plant {self.name!r}: time_constant is {values['time_constant']:g}; it is a factor above 0.5"
            )
        return np.array([values[n] for n in names])


def shift_rows(arrays: StateEquation) -> NDArray[np.bool_]:
    """The states (n_x,) that are copies of another state or an input of the period before."""
    table = np.concatenate([arrays.a, arrays.b], axis=1)
    copies = (np.count_nonzero(table, axis=1) == 1) & (table.max(axis=1) == 1) & (np.diag(arrays.a) == 0)
    return copies & (arrays.c == 0) & ~arrays.w2.any(axis=1)


def longest_memory(arrays: StateEquation) -> int:
    """Periods that the longest chain of copies remembers: no less than any dead time, and the lags of a difference."""
    chain, periods = arrays.a * shift_rows(arrays)[:, None], 0
    reached = shift_rows(arrays)
    while reached.any() and periods < len(reached):
        reached, periods = (chain @ reached) > 0, periods + 1
    return periods
