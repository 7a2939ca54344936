"""Numbers that operators of a new plant's predictive law start from, by the table of tags or the record."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.new_readings import rows_between
from loopwright.pipeline.historian.cleaning.tags import Tag, commanded_range
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

KEPT_SHARE = 0.99  # of a record's rows within the range of a constraint for which nobody gave one
RANGE_DIGITS = 100.0  # steps of a range's width, at least, to which its ends are rounded


@dataclass(frozen=True, slots=True)
class OperatorDefaults:
    """Defaults of ``operate`` by name, and a line for each that nobody gave. None: the plant's law has no ``operate``.

    ``controlled`` is the number of process variables with a set point where some have none by their role.
    """

    defaults: dict[str, float] | None = None
    lines: list[str] = field(default_factory=list)
    controlled: int | None = None

    @classmethod
    def of(cls, record: Record, tags: Sequence[Tag]) -> OperatorDefaults:
        """The defaults for the signals of a record, of which ``tags`` hold the roles and the numbers that were given.

        There are none, and no ``operate``, where no tag is a constraint or an analyser or has such a number. A
        constraint has a range in any case: where nobody gave an end, the one that ``KEPT_SHARE`` of the record's rows
        lie within. RecordError for a number outside of what its signal can have.
        """
        own = {t.name: t for t in tags}
        if not any(t.constraint or t.analyser or t.operated for t in own.values()):
            return cls()
        found = cls({})
        for signal, values in zip(record.pv_signals, record.pv.T, strict=True):
            found._of_pv(signal, values, own.get(signal.name))
        for signal in record.mv_signals:
            if (tag := own.get(signal.name)) is not None:
                found._of_mv(signal, tag, commanded_range(signal, tags))
        for i, fresh in record.seldom.items():
            found._say_no_pid(record.pv_signals[i], rows_between(fresh), own.get(record.pv_signals[i].name))
        without = sum(s.name in own and own[s.name].constraint for s in record.pv_signals)
        most = min(len(record.pv_signals) - without, len(record.mv_signals))
        return cls(found.defaults, found.lines, most if without else None)

    def _of_pv(self, signal: Signal, values: Array, tag: Tag | None) -> None:
        """The range, the rank and the cost of a process variable with its readings (n,)."""
        ends: dict[str, float | None] = (
            {"low": None, "high": None} if tag is None else {"low": tag.range_low, "high": tag.range_high}
        )
        if tag is not None and tag.constraint and None in ends.values():
            shown = dict(zip(("low", "high"), usual_range(values, signal), strict=True))
            ends = {end: shown[end] if value is None else value for end, value in ends.items()}
            self.lines.append(
                f"{signal.name}: kept between {ends['low']:g} and {ends['high']:g} {signal.unit}".rstrip(" -")
                + f", as {100 * KEPT_SHARE:g} % of the record's rows are; operators may change it, and "
                f"--range {shlex.quote(f'{tag.tag}=LOW..HIGH')} gives another"
            )
        low, high = (
            (signal.low if ends["low"] is None else ends["low"]),
            (signal.high if ends["high"] is None else ends["high"]),
        )
        if not low < high:
            raise RecordError(f"{signal.name}: the range is {low:g} to {high:g}; low must be below high")
        for end, value in ends.items():
            if value is not None:
                self._put(signal, end, value, (signal.low, signal.high))
        for what in ("rank", "cost"):
            if tag is not None and (number := getattr(tag, what)) is not None:
                self._put(signal, what, number)

    def _say_no_pid(self, signal: Signal, every: int, tag: Tag | None) -> None:
        """A line on the law that is not built for an analyser with a set point."""
        if tag is None or not tag.constraint:
            self.lines.append(
                f"{signal.name}: no PID is built, as it has a new reading every {every} rows and a PID would wind "
                "up on the number that stands between; predictive control goes on by its model"
            )

    def _of_mv(self, signal: Signal, tag: Tag, commands: tuple[float, float]) -> None:
        """The rest and the cost of an MV that may be commanded within ``commands``."""
        if tag.rest is not None:
            self._put(signal, "rest", tag.rest, commands)
            self._put(signal, "rest_use", 1.0)
        if tag.cost is not None:
            self._put(signal, "cost", tag.cost)

    def _put(
        self, signal: Signal, what: str, value: float, within: tuple[float, float] = (-math.inf, math.inf)
    ) -> None:
        if not within[0] <= value <= within[1]:
            raise RecordError(
                f"{signal.name}: {what} is {value:g} {signal.unit}, outside of its {within[0]:g} to {within[1]:g}; "
                "give one within, or widen the range of the signal"
            )
        assert self.defaults is not None
        self.defaults[f"{signal.name}.{what}"] = float(value)


def usual_range(values: Array, signal: Signal) -> tuple[float, float]:
    """The range that ``KEPT_SHARE`` of the values (n,) lie in, its ends rounded, within the signal's own."""
    low, high = np.quantile(values, (0.5 * (1 - KEPT_SHARE), 0.5 * (1 + KEPT_SHARE)))
    width = float(high - low)
    if not width > 0:
        return signal.low, signal.high
    step = 10.0 ** math.floor(math.log10(width / RANGE_DIGITS))
    digits = max(0, -math.floor(math.log10(step)))
    rounded = (round(math.floor(low / step) * step, digits), round(math.ceil(high / step) * step, digits))
    return max(rounded[0], signal.low), min(rounded[1], signal.high)
