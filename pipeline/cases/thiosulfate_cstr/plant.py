"""The thiosulfate CSTR: three steady states, the middle one unstable."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class ThiosulfateCstr(EquationPlant):
    """Oxidation of sodium thiosulfate by hydrogen peroxide in a cooled stirred tank.

        dCA/dt = F/V (CA_in - CA) - 2 k0 exp(-E/RT) CA^2
        dT/dt  = F/V (Tin - T) + 2 (-dH)/(rho cp) k0 exp(-E/RT) CA^2 - UA/(V rho cp) (T - Tj)

    States and process variables CA [mol/l] and T [K]; manipulated variable Tj [K], whose range
    0..500 K is absurd physically but is what the published tests need.

    Source: [inverse_rbf, eq. 25 and Table 1] (the R beside -dH is a subscript).
    """

    V: float = field(default=100.0, metadata={"unit": "l"})
    F: float = field(default=20.0, metadata={"unit": "l/s"})
    CA_in: float = field(default=1.0, metadata={"unit": "mol/l"})
    T_in: float = field(default=275.0, metadata={"unit": "K"})
    UA: float = field(default=20_000.0, metadata={"unit": "J/(s K)"})
    rho: float = field(default=1000.0, metadata={"unit": "g/l"})
    cp: float = field(default=4.2, metadata={"unit": "J/(g K)"})
    minus_dH: float = field(default=596_619.0, metadata={"unit": "J/mol"})
    k0: float = field(default=6.85e11, metadata={"unit": "l/(s mol)"})
    E: float = field(default=76_534.704, metadata={"unit": "J/mol"})
    R: float = field(default=8.314, metadata={"unit": "J/(mol K)"})

    name: ClassVar[str] = "thiosulfate_cstr"
    title: ClassVar[str] = "Thiosulfate CSTR"
    state_signals: ClassVar[tuple[Signal, ...]] = (Signal("C_A", "mol/l", 0.0, 1.0), Signal("T", "K", 200.0, 600.0))
    pv_signals: ClassVar[tuple[Signal, ...]] = state_signals
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("C_A", "mol/l", 0.0, 1.0),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("T_j", "K", 0.0, 500.0),)
    period_s: ClassVar[float] = 0.5
    substeps: ClassVar[int] = 50  # 20 are enough, 5 give NaN

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt in mol/(l s) and K/s."""
        c, t, tj = x[0], x[1], mv[0]
        rate = self.k0 * ca.exp(-self.E / (self.R * t)) * c**2
        heat = self.rho * self.cp
        return ca.vertcat(
            self.F / self.V * (self.CA_in - c) - 2 * rate,
            self.F / self.V * (self.T_in - t) + 2 * self.minus_dH / heat * rate - self.UA / (self.V * heat) * (t - tj),
        )
