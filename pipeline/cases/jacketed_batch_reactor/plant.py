"""A vessel heated and cooled through its jacket: a flow that can be throttled, and a valve for hot or cold."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

HOT, COLD = 1.0, 2.0  # the values of the mode
GRID = 400  # points of the steady curve
LEAK = 1e-3  # of full flow that a shut valve of SignedFlow lets through, at most


@dataclass(frozen=True)
class JacketedBatchReactor(EquationPlant):
    """Core and jacket of a batch reactor; one throttled flow of hot or of cold water feeds the jacket.

        dT/dt   = a_c (T_w - T)
        dT_w/dt = (phi/m_w) k_M (T_in - T_w) + a_w (T - T_w) + a_0 (T_0 - T_w)
        T_in    = T_hot in mode 1, T_cold in mode 2

    States T (core) and T_w (jacket) [deg C], both measured. MVs: the throttle k_M in 0..1, and the
    mode, which is 1 or 2 and nothing between.

    Source: [karer], the reactor behind its fuzzy model; the numbers are those
    that agree best with the printed consequents (eqs. 30 and 31).
    """

    a_c: float = field(default=3.306e-4, metadata={"unit": "1/s"})
    a_w: float = field(default=3.967e-3, metadata={"unit": "1/s"})
    phi: float = field(default=0.036, metadata={"unit": "1/s"})
    a_0: float = field(default=1.4e-3, metadata={"unit": "1/s"})
    T_0: float = field(default=20.0, metadata={"unit": "degC"})
    T_hot: float = field(default=75.0, metadata={"unit": "degC"})
    T_cold: float = field(default=12.0, metadata={"unit": "degC"})

    name: ClassVar[str] = "jacketed_batch_reactor"
    title: ClassVar[str] = "Batch reactor with a hot and a cold valve"
    state_signals: ClassVar[tuple[Signal, ...]] = (Signal("T", "degC", 0.0, 90.0), Signal("T_w", "degC", 0.0, 90.0))
    pv_signals: ClassVar[tuple[Signal, ...]] = state_signals
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("T", "degC", 18.0, 68.0),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (
        Signal("k_M", "-", 0.0, 1.0),
        Signal("mode", "-", HOT, COLD, values=(HOT, COLD)),
    )
    period_s: ClassVar[float] = 10.0
    substeps: ClassVar[int] = 4

    @property
    def start(self) -> tuple[Array, Array]:
        """Everything at the temperature of the surroundings, the throttle shut, the hot valve chosen."""
        return np.full(2, self.T_0), np.array([0.0, HOT])

    @property
    def regions(self) -> dict[str, tuple[float, float]]:
        """One region: there is one steady state at every temperature."""
        return {"all": (-np.inf, np.inf)}

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt in K/s."""
        t, t_w, k_m = x[0], x[1], mv[0]
        t_in = ca.if_else(mv[1] < 0.5 * (HOT + COLD), self.T_hot, self.T_cold)
        jacket = self.phi * k_m * (t_in - t_w) + self.a_w * (t - t_w) + self.a_0 * (self.T_0 - t_w)
        return ca.vertcat(self.a_c * (t_w - t), jacket)

    def relaxed(self) -> SignedFlow:
        """The reactor with one signed flow in place of throttle and mode."""
        return SignedFlow(**{name: getattr(self, name) for name in self.parameter_names()})

    @cached_property
    def steady_curve(self) -> tuple[Array, Array, Array]:
        """(T (n,), x (n, 2), flow (n,)) over the set point's range; the flow counts below 0 where it is cold."""
        sp = self.sp_signals[0]
        t = np.linspace(sp.low, sp.high, GRID)
        flow = np.array([self._flow(v) for v in t])
        held = np.abs(flow) <= 1.0
        return t[held], np.column_stack([t, t])[held], flow[held]

    def steady_state_at(self, cv: float) -> tuple[Array, Array]:
        """(x (2,), mv (2,)) at the core temperature ``cv``; PlantError where full flow does not hold it."""
        flow = self._flow(cv)
        if not abs(flow) <= 1.0:
            ends = self.steady_curve[0]
            raise PlantError(
                f"plant {self.name!r} has no steady state at T = {cv} degC; it has some from {ends[0]:.4g} "
                f"to {ends[-1]:.4g}"
            )
        return np.array([cv, cv]), np.array([abs(flow), HOT if flow >= 0 else COLD])

    def _flow(self, t: float) -> float:
        """Throttle that makes up for the heat lost at a core and jacket of ``t``, below 0 in mode cold."""
        lost = self.a_0 * (t - self.T_0)
        t_in = self.T_hot if lost >= 0 else self.T_cold
        return lost / (self.phi * abs(t_in - t)) if t_in != t else np.inf


@dataclass(frozen=True)
class SignedFlow(JacketedBatchReactor):
    """The jacketed reactor with one continuous MV f in -1..1, hot water above 0 and cold below.

        dT_w/dt = (phi/m_w) [k_hot (T_hot - T_w) + k_cold (T_cold - T_w)] + ...,   k = (sqrt(f^2 + LEAK^2) +- f) / 2

    Every pair (k_M, mode) is one f, and every f one pair, so that nothing is gained over the real
    reactor and nothing lost: its best is the real one's best. Only where f is near 0 both valves
    leak LEAK / 2, which takes out a kink that no solver by derivatives passes well.
    """

    name: ClassVar[str] = "jacketed_batch_reactor_signed_flow"
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("flow", "-", -1.0, 1.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt in K/s."""
        t, t_w, flow = x[0], x[1], mv[0]
        size = ca.sqrt(flow**2 + LEAK**2)
        heat = 0.5 * self.phi * ((size + flow) * (self.T_hot - t_w) + (size - flow) * (self.T_cold - t_w))
        return ca.vertcat(self.a_c * (t_w - t), heat + self.a_w * (t - t_w) + self.a_0 * (self.T_0 - t_w))

    @property
    def start(self) -> tuple[Array, Array]:
        """Everything at the temperature of the surroundings, both valves shut."""
        return np.full(2, self.T_0), np.zeros(1)

    def relaxed(self) -> SignedFlow:
        """Itself: its MV is continuous."""
        return self

    def steady_state_at(self, cv: float) -> tuple[Array, Array]:
        """(x (2,), flow (1,)) at the core temperature ``cv``; PlantError where full flow does not hold it."""
        x, _ = super().steady_state_at(cv)
        return x, np.array([self._flow(cv)])

    def actual(self, mv: Array) -> Array:
        """Throttle and mode (n, 2) of flows (n, 1); a flow within the leak keeps the mode, at first the hot one."""
        flow = mv[:, 0]
        mode = np.where(flow > 0, HOT, COLD)
        known = np.maximum.accumulate(np.where(np.abs(flow) > LEAK, np.arange(len(flow)), -1))
        return np.column_stack([np.abs(flow), np.where(known >= 0, mode[known], HOT)])
