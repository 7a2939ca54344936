"""The jacketed batch reactor as its printed hybrid fuzzy model has it: a plant in discrete time."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from loopwright.pipeline.cases.jacketed_batch_reactor.plant import COLD, GRID, HOT, JacketedBatchReactor
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

CENTRES = (12, 20, 40, 60, 70)  # jacket temperatures of the rules [degC]
ROWS = {"a1": "-", "a2": "-", "b": "degC", "r": "degC"}  # and their units
CORE = {"core_jacket": 0.0033, "core_core": 0.9967}
CONSEQUENTS = {  # mode -> row -> its values at the centres
    "hot": {
        "a1": (0.9453, 0.9431, 0.9429, 0.9396, 0.7910),
        "a2": (0.0376, 0.0458, 0.0395, 0.0339, 0.0225),
        "b": (19.6748, 16.7605, 10.5969, 3.9536, 1.6856),
        "r": (0.3021, 0.2160, 0.5273, 1.2701, 12.0404),
    },
    "cold": {
        "a1": (0.9803, 0.9740, 0.9322, 0.9076, 0.8945),
        "a2": (0.0025, 0.0153, 0.0466, 0.0466, 0.0111),
        "b": (-0.0704, -0.6956, -7.8013, -12.2555, -18.7457),
        "r": (0.2707, 0.2033, 0.5650, 1.9179, 5.6129),
    },
}
MODES = tuple(CONSEQUENTS)


def _of(name: str, value: float, unit: str = "-") -> tuple[str, type, Any]:
    return name, float, field(default=value, metadata={"unit": unit})


_PRINTED = [_of(name, value) for name, value in CORE.items()] + [
    _of(f"{row}_{mode}_{centre}", value, ROWS[row])
    for mode, rows in CONSEQUENTS.items()
    for row, values in rows.items()
    for centre, value in zip(CENTRES, values, strict=True)
]
_Coefficients: Any = make_dataclass("_Coefficients", _PRINTED, frozen=True)


@dataclass(frozen=True)
class FuzzyBatchReactor(_Coefficients, EquationPlant):
    """Core and jacket of a batch reactor, sampled every 10 s, by rules on the jacket's temperature.

        T(k+1)   = core_jacket T_w(k) + core_core T(k)
        T_w(k+1) = sum_j beta_j(T_w) [a1_j T_w(k) + a2_j T(k) + b_j k_M(k) + r_j]

    with triangles beta_j that meet at 12, 20, 40, 60 and 70 degC and keep 1 beyond the outer ones,
    and one set of coefficients in the hot mode (1) and another in the cold one (2): the parameter
    ``b_hot_40`` is b of the rule at 40 degC in mode hot. States, signals and period are those of
    the plant jacketed_batch_reactor.

    It is a map from sample to sample: ``transition`` is that map itself, and ``derivative`` is
    its difference quotient, whose zeros are the map's steady states.

    Source: [karer, eqs. 24-31].
    """

    name: ClassVar[str] = "fuzzy_batch_reactor"
    title: ClassVar[str] = "Batch reactor as its hybrid fuzzy model has it"
    state_signals: ClassVar[tuple[Signal, ...]] = JacketedBatchReactor.state_signals
    pv_signals: ClassVar[tuple[Signal, ...]] = JacketedBatchReactor.pv_signals
    sp_signals: ClassVar[tuple[Signal, ...]] = JacketedBatchReactor.sp_signals
    mv_signals: ClassVar[tuple[Signal, ...]] = JacketedBatchReactor.mv_signals
    period_s: ClassVar[float] = 10.0
    substeps: ClassVar[int] = 1

    @property
    def start(self) -> tuple[Array, Array]:
        """Core and jacket at 20 degC, the throttle shut, the hot valve chosen."""
        return np.full(2, 20.0), np.array([0.0, HOT])

    @property
    def regions(self) -> dict[str, tuple[float, float]]:
        """One region: the paper tells no branches apart."""
        return {"all": (-np.inf, np.inf)}

    @property
    def core(self) -> tuple[float, float]:
        """Theta_c: the weights of T_w and of T in the next core temperature."""
        return self.core_jacket, self.core_core

    def consequents(self) -> list[list[list[float]]]:
        """Theta_w of the modes hot and cold, shape (2, 4, 5): rows a1, a2, b, r, one column a rule."""
        return [[[getattr(self, f"{row}_{mode}_{c}") for c in CENTRES] for row in ROWS] for mode in MODES]

    def following(self, x: Any, mv: Any) -> Any:
        """The state [T, T_w] one period later [degC], a CasADi column, from x (2,) and mv (2,)."""
        t, t_w, k_m = x[0], x[1], mv[0]
        beta = self._memberships(t_w)

        def jacket(theta: list[list[Any]]) -> Any:
            a1, a2, b, r = (sum(w * v for w, v in zip(beta, row, strict=True)) for row in theta)
            return a1 * t_w + a2 * t + b * k_m + r

        hot, cold = (jacket(theta) for theta in self.consequents())
        t_w_next = ca.if_else(mv[1] < 0.5 * (HOT + COLD), hot, cold)
        return ca.vertcat(self.core_jacket * t_w + self.core_core * t, t_w_next)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """(x(k+1) - x(k)) / period in K/s, which stands for a derivative where one is asked for."""
        return (self.following(x, mv) - x) / self.period_s

    @cached_property
    def transition(self) -> ca.Function:
        """CasADi function (x, mv, dv, p) -> x one period later: the map itself."""
        x, mv, dv, p, _ = self._symbols
        symbols: dict[str, Any] = {n: p[i] for i, n in enumerate(self.parameter_names())}
        symbolic = replace(self, **symbols)
        return ca.Function("transition", [x, mv, dv, p], [ca.densify(symbolic.following(x, mv))])

    @cached_property
    def steady_curve(self) -> tuple[Array, Array, Array]:
        """(T (n,), x (n, 2), flow (n,)) over the set point's range; the flow counts below 0 where it is cold."""
        sp = self.sp_signals[0]
        t = np.linspace(sp.low, sp.high, GRID)
        solved = [(v, *found) for v in t if (found := self._held(float(v))) is not None]
        if not solved:
            raise PlantError(f"plant {self.name!r} has no steady state in its set-point range")
        ts, xs, mvs = (np.array(column) for column in zip(*solved, strict=True))
        return ts, xs, np.where(mvs[:, 1] == HOT, mvs[:, 0], -mvs[:, 0])

    def steady_state_at(self, cv: float) -> tuple[Array, Array]:
        """(x (2,), mv (2,)) at the core temperature ``cv``, hot where both modes hold it; PlantError where none does.

        The modes' ranges leave gaps between them, where the throttle's end of one mode is too much and
        that of the other too little.
        """
        found = self._held(cv)
        if found is None:
            raise PlantError(
                f"plant {self.name!r} has no steady state at T = {cv} degC: neither mode holds it with a throttle "
                "from 0 to 1"
            )
        return found

    def _held(self, t: float) -> tuple[Array, Array] | None:
        """State and MVs that keep the core at ``t``."""
        x = np.array([t, (1 - self.core_core) / self.core_jacket * t])
        for mode in (HOT, COLD):
            shut, open_ = (
                float(self.transition(x, [k, mode], self.dv_nominal, self.parameters())[1]) for k in (0.0, 1.0)
            )
            k_m = (x[1] - shut) / (open_ - shut) if open_ != shut else np.inf
            if 0.0 <= k_m <= 1.0:
                return x, np.array([k_m, mode])
        return None

    def _memberships(self, t_w: Any) -> list[Any]:
        """The triangles beta_j at a jacket temperature."""
        into = [ca.fmin(ca.fmax((t_w - a) / (b - a), 0), 1) for a, b in pairwise(CENTRES)]
        return [one - other for one, other in zip([1, *into], [*into, 0], strict=True)]
