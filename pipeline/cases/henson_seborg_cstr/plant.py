"""A stirred tank reactor whose product is held by its coolant flow: overdamped when hot, ringing when cool."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class HensonSeborgCstr(EquationPlant):
    """One irreversible exothermic reaction, cooled by a coil.

        dC/dt = (q/V) (C_f - C) - K0 C exp(-(E/R)/T)
        dT/dt = (q/V) (T_f - T) + K1 C exp(-(E/R)/T) + K2 q_c (1 - exp(-K3/q_c)) (T_cf - T)

    States C [mol/l] and T [K] are both measured; q_c [l/min] is the MV. Time in minutes. More
    coolant means less conversion, so the gain is positive. Between 11.1 and 119.7 l/min there are
    three steady states, one of them extinguished at C about 0.96 mol/l; the ignited branch loses
    its stability at C = 0.140 mol/l (a Hopf point).

    Source: [gao2002, section IV.A and Table 1], its exponents as in the plant
    of Henson and Seborg (E/R = 1e4 K, K0 = 7.2e10 1/min).
    """

    q: float = field(default=100.0, metadata={"unit": "l/min"})
    V: float = field(default=100.0, metadata={"unit": "l"})
    C_f: float = field(default=1.0, metadata={"unit": "mol/l"})
    T_f: float = field(default=350.0, metadata={"unit": "K"})
    T_cf: float = field(default=350.0, metadata={"unit": "K"})
    K0: float = field(default=7.2e10, metadata={"unit": "1/min"})
    K1: float = field(default=1.44e13, metadata={"unit": "K l/(min mol)"})
    K2: float = field(default=0.01, metadata={"unit": "1/l"})
    K3: float = field(default=700.0, metadata={"unit": "l/min"})
    E_R: float = field(default=1.0e4, metadata={"unit": "K"})

    name: ClassVar[str] = "henson_seborg_cstr"
    title: ClassVar[str] = "Exothermic CSTR under coolant flow"
    state_signals: ClassVar[tuple[Signal, ...]] = (Signal("C", "mol/l", 0.0, 1.0), Signal("T", "K", 340.0, 560.0))
    pv_signals: ClassVar[tuple[Signal, ...]] = state_signals
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("C", "mol/l", 0.005, 0.14),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("q_c", "l/min", 20.0, 150.0),)
    period_s: ClassVar[float] = 1.2
    substeps: ClassVar[int] = 10
    time_unit_s: ClassVar[float] = 60.0

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt in mol/(l min) and K/min."""
        c, t, q_c = x[0], x[1], mv[0]
        arrhenius = c * ca.exp(-self.E_R / t)
        feed = self.q / self.V
        cooling = self.K2 * q_c * (1 - ca.exp(-self.K3 / q_c)) * (self.T_cf - t)
        return ca.vertcat(
            feed * (self.C_f - c) - self.K0 * arrhenius,
            feed * (self.T_f - t) + self.K1 * arrhenius + cooling,
        )
