"""Values that somebody sets, held against the ranges of their signals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from serving.errors import LoopError
from serving.manifest import Signal

Array: TypeAlias = NDArray[np.float64]


def within(values: ArrayLike, signals: Sequence[Signal], what: str) -> Array:
    """``values`` as (n,); LoopError outside the signals' ranges."""
    try:
        vector = np.array(values, dtype=np.float64, ndmin=1)
    except (TypeError, ValueError, OverflowError) as error:
        raise LoopError(f"the {what} is no vector of numbers: {error}") from error
    if vector.shape != (len(signals),):
        names = ", ".join(f"{s.name} [{s.unit}]" for s in signals)
        raise LoopError(f"the {what} has the shape {vector.shape}; it needs ({len(signals)},): {names}")
    for s, value in zip(signals, vector.tolist(), strict=True):
        if s.values is not None and value not in s.values:
            raise LoopError(f"the {what} {s.name} = {value:g} is none of {', '.join(f'{v:g}' for v in s.values)}")
        if not s.low <= value <= s.high:
            unit = "" if s.unit == "-" else f" {s.unit}"
            raise LoopError(f"the {what} {s.name} = {value}{unit} is outside [{s.low:g}, {s.high:g}]{unit}")
    return vector
