"""The result of a loop's scan."""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.mode import Mode

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Command:
    """The result of one scan. ``reason`` names a fault; it is empty without one.

    A host that runs the loop itself writes ``mv`` where ``writes`` is true: not in SHADOW, and not while ``mv`` is NaN
    because no sample has told yet where the MV stands. Where ``hand_back`` is true, it gives the plant back to the
    plant's own controller, and then sets the mode to SHADOW.
    """

    scan: int
    mode: Mode
    sp: Array  # shape: (n_sp,)
    mv: Array  # shape: (n_mv,), to be written; NaN while it is not known where the MV stands
    law_mv: Array | None  # the law's MV, also in MANUAL; None if the law was not stepped or its step failed
    info: Array | None  # shape: (n_info,)
    reason: str = ""
    successor_mv: Array | None = None  # shape: (n_mv,), of a controller that is tried beside the law; else None
    hand_back: bool = False

    @property
    def writes(self) -> bool:
        """Whether ``mv`` is to be written."""
        return self.mode is not Mode.SHADOW and not isnan(self.mv[0])  # all of it is known, or none
