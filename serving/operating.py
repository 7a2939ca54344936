"""Values that operators may change of a running law: ranges, uses, ranks, resting values and costs, by one vector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.errors import ContractError
from loopwright.serving.fields import nearest, shown
from loopwright.serving.manifest import SWITCHES, OperateEntry
from loopwright.serving.ranges import is_truth, numbers

Array: TypeAlias = NDArray[np.float64]


def allowed(entry: OperateEntry) -> str:
    """The values that an entry may have, in words."""
    if entry.low == entry.high:
        return f"{entry.low:g} alone"
    return "0 or 1" if entry.what in SWITCHES else f"{entry.low:g} to {entry.high:g} {unit_words(entry)}".rstrip()


def unit_words(entry: OperateEntry, period_s: float | None = None) -> str:
    """The unit of an entry in words; ``period_s`` [s] of the law, where it is known.

    A cost is the price of one unit of its signal over one period.
    """
    period = "period" if period_s is None else f"period ({period_s:g} s)"
    if entry.what == "cost":
        return f"per {entry.unit.removeprefix('1/')} and {period}".replace("per  and", "per unit and")
    return f"{entry.unit} a {period}".lstrip() if entry.what == "max_move" else entry.unit


def written(text: str) -> float:
    """A value as somebody writes it: a number, or true or false for a switch; ValueError for anything else."""
    return SWITCH_WORDS[text.lower()] if text.lower() in SWITCH_WORDS else float(text)


SWITCH_WORDS = {"true": True, "false": False}
SWITCHED_ON = 0.85  # of drawn switches: with half of them off laws would mostly stand still


class Operate:
    """The entries of a law's ``operate``: defaults, values by name, and what is wrong with some."""

    def __init__(self, entries: Sequence[OperateEntry]) -> None:
        self.entries = tuple(entries)
        self.places = {e.name: i for i, e in enumerate(self.entries)}
        self.default: Array = np.array([e.default for e in self.entries])
        self._low, self._high = (np.array([getattr(e, end) for e in self.entries]) for end in ("low", "high"))
        self._switches = np.array([e.what in SWITCHES for e in self.entries], dtype=bool)
        pairs = [(i, self.places[f"{e.signal}.high"]) for i, e in enumerate(self.entries) if e.what == "low"]
        self._pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        self._right = b""  # the values that were found right last: a loop gives the same ones scan by scan

    def with_values(self, values: Mapping[str, float], base: ArrayLike | None = None) -> Array:
        """``base`` (the defaults) with some values by name; ContractError for an unknown name or a wrong value."""
        found = np.array(self.default if base is None else base, dtype=np.float64)
        for name, value in values.items():
            if name not in self.places:
                raise _wrong(str(name), f"operate has no entry {shown(name)}{nearest(name, self.places)}")
            try:
                number = numbers(float(value) if self._switches[self.places[name]] and is_truth(value) else value)
            except TypeError as error:
                raise _wrong(name, f"operate: {name} {error}; it needs a number") from error
            if number.shape:
                raise _wrong(name, f"operate: {name} has the shape {number.shape}; it needs one number")
            found[self.places[name]] = number
        return self.checked(found)

    def taken_over(self, wishes: Mapping[str, float]) -> Array:
        """The values (n,) of those ``wishes`` that this law has, and its own defaults for the rest.

        ContractError where one of them is outside its range here.
        """
        return self.with_values({name: value for name, value in wishes.items() if name in self.places})

    def checked(self, values: ArrayLike) -> Array:
        """``values`` as float64 (n,); ContractError with the name of the first that is wrong.

        A value must be finite and within its engineered range, a switch 0 or 1, and a low end at most the high one.
        The values that were found right last are not looked at again.
        """
        if isinstance(values, np.ndarray) and values.dtype == np.float64 and values.tobytes() == self._right:
            return values
        found = self._checked(values)
        self._right = found.tobytes()
        return found

    def _checked(self, values: ArrayLike) -> Array:
        try:
            given = np.asarray(numbers(self._unswitched(values)), dtype=np.float64)
        except TypeError as error:
            raise ContractError(f"operate {error}; it needs {len(self.entries)} numbers") from error
        if given.shape != self.default.shape:
            raise ContractError(f"operate has the shape {given.shape}; it needs ({len(self.entries)},)")
        good = (given >= self._low) & (given <= self._high) & (~self._switches | (given == 0) | (given == 1))
        if not good.all():
            i = int(np.argmin(good))
            e = self.entries[i]
            raise _wrong(e.name, f"operate: {e.name} is {given[i]:g}; allowed is {allowed(e)}")
        crossed = given[self._pairs[:, 0]] > given[self._pairs[:, 1]]
        if crossed.any():
            low, high = (int(k) for k in self._pairs[int(np.argmax(crossed))])
            raise _wrong(
                self.entries[low].name,
                f"operate: {self.entries[low].name} is {given[low]:g}, above {self.entries[high].name} = "
                f"{given[high]:g}; a low end must not be above the high one",
            )
        return given

    def _unswitched(self, values: Any) -> Any:
        """``values`` with True and False as 1 and 0 where a switch stands; there, they are its own words."""
        if not isinstance(values, list | tuple) or len(values) != len(self.entries):
            return values
        return [float(v) if is_truth(v) and s else v for v, s in zip(values, self._switches.tolist(), strict=True)]

    def drawn(self, rng: np.random.Generator, share: float = 1.0) -> Array:
        """Random values (n,) that are allowed: a ``share`` of the entries anywhere in their ranges, others by default.

        Switches are 0 or 1, ranks whole, and no low end is above its high one.
        """
        found = self.default.copy()
        for i, e in enumerate(self.entries):
            if rng.uniform() < share:
                value = rng.uniform(e.low, e.high)
                found[i] = round(value) if e.what == "rank" else value
                if e.what in SWITCHES:
                    found[i] = e.high if rng.uniform() < SWITCHED_ON else e.low
        return self.ordered(found)

    def ordered(self, values: ArrayLike) -> Array:
        """``values`` (n,) within their ranges, both ends exchanged where the low one is above the high one."""
        found = np.array(values, dtype=np.float64)
        found[self._pairs] = np.sort(found[self._pairs], axis=-1)
        return np.clip(found, self._low, self._high)


def _wrong(entry: str, words: str) -> ContractError:
    """The error that ``words`` say of an entry."""
    error = ContractError(words)
    error.entry = entry
    return error
