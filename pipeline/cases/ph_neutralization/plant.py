"""pH neutralization in a stirred tank: a static gain that varies ninefold over the operating range."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.serving.manifest import Signal

PH_RANGE = (0.0, 14.0)
HALVINGS, NEWTON_STEPS = 10, 4
PER_MINUTE = 1.0 / 60.0  # ml/min in ml/s


@dataclass(frozen=True)
class PhNeutralization(EquationPlant):
    """Acid, buffer and base streams meet in a tank; the base stream's flow controls the pH.

        A dh/dt    = q1 + q2 + q3 - Cv sqrt(h)
        A h dWa/dt = sum_i (Wa_i - Wa) q_i,     A h dWb/dt = sum_i (Wb_i - Wb) q_i

    with the level h [cm] and the reaction invariants Wa, Wb [mol/l] (charge and carbonate), and
    the pH as the root of the titration curve, see ``ph_of``. Flows are in ml/min, the unit in
    which the published tests state them.

    Source: [chen2004, eqs. 30-35 and Table 2] (the exponent of eq. 35 is
    pH - 14); the plant is that of Nahas, Henson and Seborg, 1992.
    """

    A: float = field(default=207.0, metadata={"unit": "cm2"})
    Cv: float = field(default=8.75, metadata={"unit": "ml/(s cm^0.5)"})
    q1: float = field(default=996.0, metadata={"unit": "ml/min"})
    q2: float = field(default=33.0, metadata={"unit": "ml/min"})
    Wa1: float = field(default=3e-3, metadata={"unit": "mol/l"})
    Wa2: float = field(default=-3e-2, metadata={"unit": "mol/l"})
    Wa3: float = field(default=-3.05e-3, metadata={"unit": "mol/l"})
    Wb1: float = field(default=0.0, metadata={"unit": "mol/l"})
    Wb2: float = field(default=3e-2, metadata={"unit": "mol/l"})
    Wb3: float = field(default=5e-5, metadata={"unit": "mol/l"})
    pK1: float = field(default=6.35, metadata={"unit": "-"})
    pK2: float = field(default=10.25, metadata={"unit": "-"})

    name: ClassVar[str] = "ph_neutralization"
    title: ClassVar[str] = "pH neutralization"
    state_signals: ClassVar[tuple[Signal, ...]] = (
        Signal("h", "cm", 5.0, 25.0),
        Signal("W_a", "mol/l", -2e-3, 2e-3),
        Signal("W_b", "mol/l", 0.0, 2e-3),
    )
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("pH", "-", 4.0, 11.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("pH", "-", 6.5, 9.3),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("q3", "ml/min", 850.0, 1050.0),)
    period_s: ClassVar[float] = 60.0
    substeps: ClassVar[int] = 8  # steps of 15 s are within 1e-5 pH

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt in cm/s and mol/(l s)."""
        h, wa, wb = x[0], x[1], x[2]
        q1, q2, q3 = PER_MINUTE * self.q1, PER_MINUTE * self.q2, PER_MINUTE * mv[0]
        volume = self.A * h
        return ca.vertcat(
            (q1 + q2 + q3 - self.Cv * ca.sqrt(h)) / self.A,
            ((self.Wa1 - wa) * q1 + (self.Wa2 - wa) * q2 + (self.Wa3 - wa) * q3) / volume,
            ((self.Wb1 - wb) * q1 + (self.Wb2 - wb) * q2 + (self.Wb3 - wb) * q3) / volume,
        )

    def output(self, x: Any) -> Any:
        """The pH."""
        return ph_of(x[1], x[2], self.pK1, self.pK2)


@dataclass(frozen=True)
class PhNeutralization15s(PhNeutralization):
    """The same tank, sampled four times as often."""

    name: ClassVar[str] = "ph_neutralization_15s"
    title: ClassVar[str] = "pH neutralization, sampled every 15 s"
    period_s: ClassVar[float] = 15.0
    substeps: ClassVar[int] = 2


def ph_of(wa: Any, wb: Any, pk1: Any, pk2: Any) -> Any:
    """The pH of a solution with reaction invariants Wa and Wb [mol/l], the root of its charge balance.

        Wa + 10^(pH - 14) + Wb (1 + 2 10^(pH - pK2)) / (1 + 10^(pK1 - pH) + 10^(pH - pK2)) - 10^(-pH) = 0

    which rises with the pH, so that there is one root, bracketed by 0..14. Ten halvings of the
    bracket bring Newton's method to where it converges in four steps (from further off it may
    not); a root beyond the bracket is not found. The last Newton step has the root's exact
    derivative, which the halvings lack: the same expression serves simulation and optimization.

    Source: [chen2004, eq. 35], with the sign of its exponent put right.
    """
    low, high = PH_RANGE
    ph, width = (low + high) / 2, (high - low) / 2
    for _ in range(HALVINGS):
        width /= 2
        ph = ph - width * ca.sign(_charge(ph, wa, wb, pk1, pk2)[0])
    for _ in range(NEWTON_STEPS):
        charge, slope = _charge(ph, wa, wb, pk1, pk2)
        ph = ph - charge / slope
    return ph


def _charge(ph: Any, wa: Any, wb: Any, pk1: Any, pk2: Any) -> tuple[Any, Any]:
    """Left side of the charge balance and its derivative with respect to the pH."""
    ln10 = math.log(10.0)

    def ten(exponent: Any) -> Any:
        return ca.exp(ln10 * exponent)

    acid, base = ten(-ph), ten(ph - 14.0)
    first, second = ten(pk1 - ph), ten(ph - pk2)
    s, top = 1 + first + second, 1 + 2 * second
    slope = base + acid + wb * (2 * second * s - top * (second - first)) / s**2
    return wa + base + wb * top / s - acid, ln10 * slope
