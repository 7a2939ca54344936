"""How a plant was run while its record was made: the figure that a new controller is compared with first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.metrics import Array, mae


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
