"""A stirred tank reactor with a reversible reaction, whose product is held by the feed rate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.serving.manifest import Signal

R = 8.314  # J/(mol K)


@dataclass(frozen=True)
class ReversibleCstr(EquationPlant):
    """A <-> B in a jacketed tank of constant volume.

        dC_B/dt = -(F/V) C_B + r,   r = k1 exp(-E1/(R T)) (C_t - C_B) - k2 exp(-E2/(R T)) C_B
        dT/dt   = (F/V) (T_in - T) - h (T - T_c) + beta r

    States C_B [mol/l] and T [K] are both measured; the feed rate F [l/s] is the MV. The gain is
    negative: more feed, less time to react. Below 0.106 l/s it would change its sign.

    Source: [reference_ann, sections 4 and 5], whose numbers are partly illegible;
    read as the classic reactor of Economou and Morari, with 427 K as the feed's temperature.
    """

    V: float = field(default=100.0, metadata={"unit": "l"})
    C_t: float = field(default=1.0, metadata={"unit": "mol/l"})
    T_in: float = field(default=427.0, metadata={"unit": "K"})
    T_c: float = field(default=300.0, metadata={"unit": "K"})
    h: float = field(default=2.0e-3, metadata={"unit": "1/s"})
    beta: float = field(default=4.874, metadata={"unit": "K l/mol"})
    k1: float = field(default=5.24e3, metadata={"unit": "1/s"})
    k2: float = field(default=1.32e6, metadata={"unit": "1/s"})
    E1: float = field(default=41_840.0, metadata={"unit": "J/mol"})
    E2: float = field(default=62_760.0, metadata={"unit": "J/mol"})

    name: ClassVar[str] = "reversible_cstr"
    title: ClassVar[str] = "CSTR with a reversible reaction"
    state_signals: ClassVar[tuple[Signal, ...]] = (Signal("C_B", "mol/l", 0.0, 1.0), Signal("T", "K", 300.0, 520.0))
    pv_signals: ClassVar[tuple[Signal, ...]] = state_signals
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("C_B", "mol/l", 0.3, 0.6),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("F", "l/s", 1 / 3, 6.0),)
    period_s: ClassVar[float] = 2.0
    substeps: ClassVar[int] = 2

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt in mol/(l s) and K/s."""
        cb, t, feed = x[0], x[1], mv[0] / self.V
        forward = self.k1 * ca.exp(-self.E1 / (R * t)) * (self.C_t - cb)
        rate = forward - self.k2 * ca.exp(-self.E2 / (R * t)) * cb
        return ca.vertcat(
            -feed * cb + rate,
            feed * (self.T_in - t) - self.h * (t - self.T_c) + self.beta * rate,
        )
