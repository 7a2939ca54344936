"""Defaults of laws that follow from the range of the controlled variable, so that its unit does not matter."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Self, TypeVar

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.simulator import Signals

P = TypeVar("P")


class OfRange(float):
    """A default that counts in the set point's range: the parameter is ``share * range**power``.

    A parameter that somebody states is a plain float, in the unit that its docstring names. Until ``in_units``
    has turned it into that unit the default has the value of its share, above 0 as the parameter itself.
    """

    power: int

    def __new__(cls, share: float, power: int = 1) -> Self:
        """A share (-) of the range to a power."""
        made = super().__new__(cls, share)
        made.power = power
        return made

    def __getnewargs__(self) -> tuple[float, int]:  # type: ignore[override]  # float has one argument
        return float(self), self.power

    def __repr__(self) -> str:
        words = {1: "* range", -1: "/ range"}
        return f"{float(self):g} " + words.get(self.power, f"* range^{self.power}")

    __str__ = __repr__

    def over(self, span: float) -> float:
        """The parameter for a range of width ``span`` [pv]."""
        return float(self) * span**self.power


def ascend(low: float, high: float) -> bool:
    """Whether ``low < high``; True while only one of them is stated, as ``in_units`` has them compared again."""
    return isinstance(low, OfRange) != isinstance(high, OfRange) or low < high


def in_units(params: P, signals: Signals, law: str) -> P:
    """The parameters of a law with every default of the type ``OfRange`` in the unit of the controlled variable.

    Raises LawError where a stated parameter does not fit a default, such as a lower bound above the upper one.
    """
    span = signals.sp[0].high - signals.sp[0].low
    values = {field.name: getattr(params, field.name) for field in fields(params)}  # type: ignore[arg-type]
    scaled = {name: _over(value, span) for name, value in values.items()}
    changed = {name: value for name, value in scaled.items() if value is not values[name]}
    if not changed:
        return params
    try:
        return replace(params, **changed)  # type: ignore[type-var]
    except ValueError as error:
        raise LawError(f"law {law!r}: {error}") from error


def _over(value: Any, span: float) -> Any:
    if isinstance(value, OfRange):
        return value.over(span)
    if isinstance(value, tuple) and any(isinstance(v, OfRange) for v in value):
        return tuple(_over(v, span) for v in value)
    return value
