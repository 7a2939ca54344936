"""Settings of a PID in the forms in which control systems take them."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, sqrt

from loopwright.pipeline.tuning.rules import PidSettings
from loopwright.serving.manifest import Signal

WHOLE_RANGE = 100.0  # whole range of an MV in %


def whole_span(mv: Signal) -> float:
    """Range of an actuator [mv] that a proportional band counts by.

    A control system scales an MV in % from 0 to 100, whatever part of it a record moved or a law may command.
    """
    return max(WHOLE_RANGE, mv.high - mv.low) if mv.unit == "%" else mv.high - mv.low


@dataclass(frozen=True, slots=True)
class PidForms:
    """One PID in four forms; e the error, y the PV, u the MV, spans in the units of PV and MV.

        ideal     u = Kc (e + 1/(Ti s) e - Td s y)
        parallel  u = Kp e + Ki/s e - Kd s y         Kp = Kc,  Ki = Kc/Ti,  Kd = Kc Td
        series    u = Kc' (1 + 1/(Ti' s)) (1 + Td' s)      the error's; None where Ti < 4 Td: it has no such form
        band      PB = 100 % (MV span / PV span) / |Kc|    with Ti and Td of the ideal form

    Without an integral part Ti is infinite and Ki 0. Source: Astrom and Hagglund, Advanced PID Control, section 3.2.
    """

    kc: float
    ti_s: float
    td_s: float
    ki: float  # [mv/pv/s]
    kd: float  # [mv s/pv]
    series: tuple[float, float, float] | None  # Kc', Ti' [s], Td' [s]
    band_percent: float
    spans: tuple[float, float]  # of PV and MV that the band is of

    @classmethod
    def of(cls, settings: PidSettings, pv_span: float, mv_span: float) -> PidForms:
        """The forms of the ideal ``settings``; the filter, the weight of the set point and the anti-windup stay."""
        kc, ti, td = settings.kc, settings.ti_s, settings.td_s
        series: tuple[float, float, float] | None = kc, ti, td
        if td and isfinite(ti):
            root = sqrt(1 - 4 * td / ti) if ti >= 4 * td else None
            series = None if root is None else (kc * (1 + root) / 2, ti * (1 + root) / 2, ti * (1 - root) / 2)
        return cls(kc, ti, td, kc / ti, kc * td, series, 100 * mv_span / pv_span / abs(kc), (pv_span, mv_span))

    def words(self, pv_unit: str, mv_unit: str) -> str:
        """The forms beside the ideal one, in one clause."""
        below = f"({pv_unit})" if "/" in pv_unit else pv_unit or "1"
        per = f"{mv_unit or '1'}/{below}"
        kd = f", Kd {self.kd:.4g} {per} s" if self.td_s else ""
        parallel = f"parallel form: Kp {self.kc:.4g} {per}, Ki {self.ki:.4g} {per}/s{kd}"
        if not self.td_s:
            series = "series form: as the ideal one"
        elif self.series is None:
            series = "series form: none, as Ti is less than 4 Td"
        else:
            kc, ti, td = self.series
            series = f"series form: Kc {kc:.4g} {per}, {_times(ti, td)}"
        whole = [f"{span:.4g} {of}".rstrip() for span, of in zip(self.spans, (pv_unit, mv_unit), strict=True)]
        band = f"proportional band {self.band_percent:.4g} % where {' and '.join(whole)} are the whole ranges"
        return f"{parallel}; {series}; {band}; {_minutes(self.ti_s, self.td_s)}"


def _times(ti_s: float, td_s: float) -> str:
    """Integral and derivative time."""
    return f"Ti {ti_s:.4g} s, Td {td_s:.4g} s" if isfinite(ti_s) else f"no integral part, Td {td_s:.4g} s"


def _minutes(ti_s: float, td_s: float) -> str:
    """The times of the ideal form in minutes, and repeats a minute."""
    integral = f"Ti {ti_s / 60:.4g} min or {60 / ti_s:.4g} repeats a minute" if isfinite(ti_s) else "no integral part"
    return f"{integral}, Td {td_s / 60:.4g} min" if td_s else integral
