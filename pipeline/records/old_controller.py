"""The PI or PID that held a PV while its record was made: the first rival of a new controller."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class OldController:
    """The law that the record shows between a set point, its PV and the MV, in velocity form.

        mv(k) - mv(k-1) = Kc [ p(k) - p(k-1) + (h/Ti) (r(k) - y(k)) - (Td/h) (y(k) - 2 y(k-1) + y(k-2)) ],  p = b r - y

    with the period h of the record; y is the PV of ``late_rows`` rows before.
    ``pv``, ``mv``: the names of its signals, in ``pv_unit`` and ``mv_unit``; ``ti_s``, ``td_s`` [s]: integral and
    derivative time, of the ideal form; ``window_rows``: rows of a window, over which movements are compared.
    """

    pv: str
    mv: str
    pv_unit: str
    mv_unit: str
    kc: float  # [mv/pv]
    ti_s: float  # 0 without an integral part
    td_s: float
    set_point_weight: float  # b: 1 with P on the error, 0 with P on the PV
    late_rows: int
    rows: int  # of the windows that it was fitted on and scored on
    window_rows: int
    share: float  # of the MV's movement within a window, explained in windows that the fit never saw; at most 1
    same_name: bool = False  # whether PV and MV belong together by the names of their tags
    doubt: str = ""  # why it is not believed, a clause; empty where it is

    @property
    def believed(self) -> bool:
        """Whether it may stand for the old loop in tests."""
        return not self.doubt

    @property
    def words(self) -> str:
        """The old controller in words, a clause."""
        share = f"{100 * max(self.share, 0.0):.4g} % of its movement over {self.window_rows} rows"
        if not self.believed:
            best = f" (the best explains {share})" if self.rows else ""
            return f"no PI or PID that moves {self.mv} by {self.pv} is seen in the record{best}: {self.doubt}"
        form = "PID, derivative on the PV" if self.td_s else "PI"
        where = {1.0: "the error", 0.0: "the PV"}.get(
            round(self.set_point_weight, 2), f"{self.set_point_weight:.2g} of the set point less the PV"
        )
        below = f"({self.pv_unit})" if "/" in self.pv_unit else self.pv_unit or "1"
        unit = f"{self.mv_unit or '1'}/{below}"
        derivative = f", Td {self.td_s:.3g} s" if self.td_s else ""
        return (
            f"{self.mv} was moved by a {form}, P on {where}: Kc {self.kc:.3g} {unit}, Ti {self.ti_s:.3g} s"
            f"{derivative}; it explains {share}, in rows that its fit never saw"
        )
