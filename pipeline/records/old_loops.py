"""The loops of a record as it was made: the PI that ran each, and when it was at work."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.metrics import Array, mae


# -------------------------------------------------------------------------------------------------------------- the PI
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


# ------------------------------------------------------------------------------------------------- when it was at work
@dataclass(frozen=True, slots=True)
class Operated:
    """The loop of one PV over the rows of the record in automatic, or over all rows where no mode is known."""

    pv: str
    unit: str
    rows: int
    automatic: bool  # whether a mode says which rows these are
    mae: float  # of the measured PV against its set point, in the PV's unit
    travel: dict[str, float]  # MV -> mean change in a minute, in the MV's unit
    travel_units: dict[str, str]

    @property
    def words(self) -> str:
        """The operation in words, a clause on the record."""
        rows = f"over {self.rows} rows {'in automatic' if self.automatic else 'of the record, whose mode is not known'}"
        moves = ", ".join(
            f"{mv} moved by {f'{v:.3g} {self.travel_units[mv]}'.rstrip()} a minute" for mv, v in self.travel.items()
        )
        error = f"{self.mae:.3g} {self.unit}".rstrip()
        return f"the MAE of {self.pv}, as measured, against its set point was {error} {rows}; {moves}"


def operation(sp: Array, pv: Array, mv: Array, piece: NDArray[np.int64], period_s: float) -> tuple[float, Array]:
    """MAE of a PV (n,) against its set point (n,), and the mean change of each MV (n, n_mv) in a minute, (n_mv,).

    A change counts between two rows that follow each other within a ``piece`` (n,). 0 where there are none.
    """
    follows = np.diff(piece) == 0
    minutes = np.count_nonzero(follows) * period_s / 60
    moved = np.abs(np.diff(mv, axis=0))[follows].sum(axis=0)
    return mae(sp, pv), moved / minutes if minutes else np.zeros(mv.shape[1])
