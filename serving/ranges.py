"""Values that somebody gives: whether they are numbers, and whether they lie in the ranges of their signals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.manifest import Signal

Array: TypeAlias = NDArray[np.float64]


def numbers(given: object) -> NDArray[Any]:
    """``given`` as an array of integers or floats, of any shape.

    TypeError, whose text goes on a name, for anything else. Numpy makes a number of a truth value among numbers; this
    does not.
    """
    try:
        array = np.asarray(given)
    except ValueError as error:
        raise TypeError(f"is no vector of numbers: {error}") from None
    if array.dtype.kind not in "fiu":
        raise TypeError(f"has the type {array.dtype}")
    if array is not given and any(map(is_truth, _entries(given))):
        raise TypeError("has the type bool in part")
    return array


def _entries(given: Any) -> Any:
    return () if hasattr(given, "dtype") or isinstance(given, int | float) else given


def is_truth(value: object) -> bool:
    """Whether a single value is a truth value, of Python or of numpy."""
    return type(value) is bool or getattr(getattr(value, "dtype", None), "kind", "") == "b"


def switched(given: object) -> object:
    """``given`` with truth values as 1 and 0: they are the words of a switch."""
    kind = getattr(getattr(given, "dtype", None), "kind", "")
    if kind == "b":
        return np.asarray(given, dtype=np.float64)
    return [float(v) if is_truth(v) else v for v in given] if isinstance(given, list | tuple) else given


def within(values: ArrayLike, signals: Sequence[Signal], what: str) -> Array:
    """``values`` as (n,); LoopError outside the signals' ranges."""
    try:
        vector = np.array(numbers(values), dtype=np.float64, ndmin=1)
    except (TypeError, OverflowError) as error:
        raise LoopError(f"the {what} {error}; it needs numbers") from error
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
