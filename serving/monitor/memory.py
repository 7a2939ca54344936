"""The knowledge of a detector, as JSON-ready values and back: a loop that starts again need not learn anew.

The text lies in a file that others may have written, so nothing of it is believed: each value must be of the kind,
the shape and the range that the detector could have given.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

Range: TypeAlias = tuple[float, float]
Kept: TypeAlias = Mapping[str, Range]

ANY: Range = (-1e100, 1e100)
POSITIVE: Range = (1e-100, 1e100)
SIZE: Range = (0.0, 1e100)  # what cannot be negative
COUNT: Range = (0, 10**12)
SIGN: Range = (-1, 1)
TIME_S: Range = (0.0, 1e11)  # since 1970: to the year 5138
LONGEST_LIST = 1_000


class Remembers:
    """Keeps the attributes in ``KEPT``, each with the range of its numbers.

    An attribute is a number, a bool, a list of numbers, an array, or another that remembers; of the last the range
    is its own affair.
    """

    KEPT: ClassVar[Kept] = {}

    def memory(self) -> dict[str, Any]:
        """The attributes, JSON-ready."""
        return {name: _out(getattr(self, name)) for name in self.KEPT}

    def recall(self, memory: Any) -> None:
        """Take them back. ValueError where one is missing, or of another kind, shape or range."""
        if not isinstance(memory, dict):
            raise ValueError(f"{_shown(memory)} in place of what a {type(self).__name__} keeps")
        for name, within in self.KEPT.items():
            if name not in memory:
                raise ValueError(f"{name} is missing")
            setattr(self, name, _in(getattr(self, name), memory[name], name, within))


def number(kept: Any, name: str, within: Range) -> float:
    """A finite number in a range. ValueError for anything else."""
    if type(kept) not in {int, float} or not within[0] <= kept <= within[1]:  # NaN lies in no range
        raise ValueError(f"{name} is {_shown(kept)}; it must be a number in {within[0]:g} .. {within[1]:g}")
    return float(kept)


def _out(value: Any) -> Any:
    if isinstance(value, Remembers):
        return value.memory()
    return value.tolist() if isinstance(value, np.ndarray) else value


def _in(present: Any, kept: Any, name: str, within: Range) -> Any:
    if isinstance(present, Remembers):
        present.recall(kept)
        return present
    if isinstance(present, np.ndarray):
        return _array(present, kept, name, within)
    if isinstance(present, list):
        if not isinstance(kept, list) or len(kept) > LONGEST_LIST:
            raise ValueError(f"{name} is {_shown(kept)}; it must be a list of numbers")
        return [number(k, name, within) for k in kept]
    if isinstance(present, bool | int) and type(kept) is not type(present):
        raise ValueError(f"{name} is {_shown(kept)}; it must be of the kind {type(present).__name__}")
    if isinstance(present, bool):
        return kept
    value = number(kept, name, within)
    return kept if isinstance(present, int) else value


def _array(present: NDArray[np.float64], kept: Any, name: str, within: Range) -> NDArray[np.float64]:
    if not isinstance(kept, list):
        raise ValueError(f"{name} is {_shown(kept)}; it must be a list of numbers")
    try:
        array = np.array(kept)
    except (ValueError, OverflowError, RecursionError):
        raise ValueError(f"{name} is no array") from None
    if array.dtype.kind not in "iuf" or array.shape != present.shape:
        raise ValueError(f"{name} has the shape {array.shape} of {array.dtype}; it must be {present.shape} of numbers")
    array = array.astype(np.float64)
    if not (np.isfinite(array).all() and (array >= within[0]).all() and (array <= within[1]).all()):
        raise ValueError(f"{name} has numbers outside {within[0]:g} .. {within[1]:g}")
    return array


def _shown(kept: Any) -> str:
    """A value in a message, however long it is."""
    if isinstance(kept, float) and not isfinite(kept):
        return str(kept)
    text = repr(kept) if isinstance(kept, str | float | bool) or kept is None else type(kept).__name__
    return text if len(text) <= 40 else text[:40] + "..."
