"""How long a detector learns, and its knowledge as JSON-ready values: a loop that starts again need not learn anew."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil, isfinite
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest

# ---------------------------------------------------------------------------------------- knowledge as values and back
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


# ----------------------------------------------------------------------- how fast a loop is, and how long it is learnt
SETTLE, LEAST_SETTLE, MOST_SETTLE = 100, 20, 2000  # scans
DEAD, MOST_DEAD = 2, 200  # scans
DAY_S, WEEK_S = 86_400.0, 7 * 86_400.0
LEARN_S = 3 * DAY_S  # that rests and blocks are learnt at least: loads of a fast plant need not be fast
FINE_S = DAY_S  # that the fewest figures of a fast plant last at least
NOISE = "_noise"  # how the names of the validation's tests with noise end


def settle_scans(m: Manifest) -> int:
    """Scans of a settling time: the median over the evidence's tests without noise, which would hide it."""
    rows = m.evidence.get("scenarios")
    known = {n: row for n, row in rows.items() if isinstance(row, dict)} if isinstance(rows, dict) else {}
    found = [row.get("settling") for name, row in known.items() if not name.endswith(NOISE)]
    times = sorted(float(v) for v in found if isinstance(v, int | float) and v > 0)
    scans = round(times[len(times) // 2] / m.period_s) if times else SETTLE
    return min(max(scans, LEAST_SETTLE), MOST_SETTLE)


def dead_times(m: Manifest) -> list[int]:
    """Scans after which each controlled variable first answers a move: the evidence's; DEAD where nobody knows."""
    told = m.evidence.get("dead_time_periods")
    known = told if isinstance(told, list) and len(told) == len(m.sp) else [None] * len(m.sp)
    return [d if type(d) is int and 1 <= d <= MOST_DEAD else DEAD for d in known]


def pooled(least: int, figure_s: float) -> tuple[int, int]:
    """(figures to learn, figures that make one): ``least`` made ones last FINE_S, all of them LEARN_S."""
    pool = max(ceil(FINE_S / figure_s / least), 1)
    return max(least, ceil(LEARN_S / (pool * figure_s))) * pool, pool


def blocks(least: int, shortest_s: float) -> tuple[float, float]:
    """(seconds of a block, times ``least`` blocks that are learnt): ``least`` last FINE_S, all of them LEARN_S."""
    block_s = max(shortest_s, FINE_S / least)
    return block_s, max(LEARN_S / (least * block_s), 1.0)
