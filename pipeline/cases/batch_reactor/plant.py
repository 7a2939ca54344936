"""A batch reactor A -> B -> C whose temperature follows an optimal profile."""

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

KELVIN = 273.15
GRID = 400  # points of the steady curve


@dataclass(frozen=True)
class BatchReactor(EquationPlant):
    """Consecutive reactions of second and first order, heated and cooled by one split-range signal.

        dCA/dt = -k1 CA^2,     dCB/dt = k1 CA^2 - k2 CB
        dT/dt  = g1 k1 CA^2 + g2 k2 CB + (a1 + a2 T) + (b1 + b2 T) u
        k_i    = A_i0 exp(-E_i / (R (T + 273.15)))

    States C_A, C_B [kmol/m3] and T [deg C], the process variable; u in 0..1 runs from full cooling
    to full heating. A batch starts with A alone at 25 deg C.

    A batch has no steady state with A left. Where a steady state is asked for (tuning a PID, starting a test at a
    temperature), the reactor with A and B used up takes its place: u = -(a1 + a2 T) / (b1 + b2 T).

    Source: [chen2004, eqs. 37-41 and Table 4] (E in kJ/kmol).
    """

    A10: float = field(default=1.1, metadata={"unit": "m3/(kmol s)"})
    A20: float = field(default=172.2, metadata={"unit": "1/s"})
    E1: float = field(default=20_900.0, metadata={"unit": "kJ/kmol"})
    E2: float = field(default=41_800.0, metadata={"unit": "kJ/kmol"})
    R: float = field(default=8.3143, metadata={"unit": "kJ/(kmol K)"})
    gamma1: float = field(default=41.8, metadata={"unit": "degC m3/kmol"})
    gamma2: float = field(default=83.6, metadata={"unit": "degC m3/kmol"})
    alpha1: float = field(default=4.3145, metadata={"unit": "degC/s"})
    alpha2: float = field(default=-0.1099, metadata={"unit": "1/s"})
    beta1: float = field(default=1.4962, metadata={"unit": "degC/s"})
    beta2: float = field(default=0.0515, metadata={"unit": "1/s"})

    name: ClassVar[str] = "batch_reactor"
    title: ClassVar[str] = "Batch reactor A -> B -> C"
    state_signals: ClassVar[tuple[Signal, ...]] = (
        Signal("C_A", "kmol/m3", 0.0, 1.0),
        Signal("C_B", "kmol/m3", 0.0, 1.0),
        Signal("T", "degC", 0.0, 130.0),
    )
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("T", "degC", 0.0, 130.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("T", "degC", 20.0, 130.0),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("u", "-", 0.0, 1.0),)
    period_s: ClassVar[float] = 20.0
    substeps: ClassVar[int] = 20

    @property
    def start(self) -> tuple[Array, Array]:
        """A fresh batch: A alone, 25 deg C, full cooling."""
        return np.array([1.0, 0.0, 25.0]), np.array([0.0])

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt in kmol/(m3 s) and deg C/s."""
        ca_, cb, t, u = x[0], x[1], x[2], mv[0]
        rt = self.R * (t + KELVIN)
        first = self.A10 * ca.exp(-self.E1 / rt) * ca_**2
        second = self.A20 * ca.exp(-self.E2 / rt) * cb
        jacket = self.alpha1 + self.alpha2 * t + (self.beta1 + self.beta2 * t) * u
        return ca.vertcat(-first, first - second, self.gamma1 * first + self.gamma2 * second + jacket)

    def output(self, x: Any) -> Any:
        """The temperature."""
        return x[2]

    @cached_property
    def steady_curve(self) -> tuple[Array, Array, Array]:
        """(T (n,), x (n, 3), u (n,)) of the reactor with A and B used up, over the MV's range."""
        u = np.linspace(0.0, 1.0, GRID)
        t = -(self.alpha1 + self.beta1 * u) / (self.alpha2 + self.beta2 * u)
        return t, np.column_stack([np.zeros((GRID, 2)), t]), u

    def steady_state_at(self, cv: float) -> tuple[Array, Array]:
        """(x (3,), u (1,)) at the temperature ``cv`` with A and B used up; PlantError where u would leave 0..1."""
        ends = self.steady_curve[0]
        if not ends[0] <= cv <= ends[-1]:
            raise PlantError(
                f"plant {self.name!r} has no steady state at T = {cv} degC; it has some from {ends[0]:.4g} "
                f"to {ends[-1]:.4g}"
            )
        return np.array([0.0, 0.0, cv]), np.array([-(self.alpha1 + self.alpha2 * cv) / (self.beta1 + self.beta2 * cv)])
