"""Courses that a law predicts and plans, and the parts of its next moves; as values and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

Cause: TypeAlias = Literal[
    "setpoint", "range_low", "range_high", "disturbance", "forecast", "load", "cost", "rest", "mv_low", "mv_high",
    "max_move", "not_in_use", "plan",
]  # fmt: skip

HOLDING = frozenset({"mv_low", "mv_high", "max_move", "not_in_use"})  # causes that hold an MV back
BALANCED_MOVE = 1e-3  # of its largest part: a smaller move is what two parts leave of each other


@dataclass(frozen=True, slots=True)
class SignalCourse:
    """A course of one signal: a CV as it is predicted, or an MV as it is planned.

    ``times_s`` [s] count from now. An MV goes to each value at its time, and stays there until the next one.
    """

    signal: str
    group: Literal["cv", "mv"]
    unit: str
    times_s: tuple[float, ...]
    values: tuple[float, ...]  # [unit]


@dataclass(frozen=True, slots=True)
class MovePart:
    """A part of an MV's next move, in the MV's unit: what this cause alone adds to it.

    ``setpoint``: a CV is predicted off its set point while the MVs stand still. ``range_low`` and ``range_high``: an
    end of a CV's range. ``disturbance``: a measured disturbance changed since the last step. ``load``: a reading
    of a CV is not the predicted one, so that something not measured acts. ``cost`` of a CV or an MV, ``rest``: of an
    MV to its resting value. ``mv_low`` and ``mv_high``: an MV is at a limit, ``max_move``: it moves no faster;
    ``not_in_use``: it must stay. ``plan``: the rest, by which the plan still hangs on the last one.
    """

    cause: Cause
    signal: str  # empty for ``plan``
    value: float  # [mv]


@dataclass(frozen=True, slots=True)
class ExplainedMove:
    """The next move of one MV, and its parts, the largest first; they sum to the move."""

    mv: str
    unit: str
    move: float  # [unit]
    parts: tuple[MovePart, ...]
    sentence: str  # such as "70 %: LI-1 towards its high limit; 20 %: FI-7 rose"

    @property
    def first(self) -> MovePart:
        """The first cause: the largest part in the direction of the move; of an MV that stands, what holds it there.

        ``plan`` is no cause, and is only named where there is no other.
        """
        named = [p for p in self.parts if p.cause != "plan"] or [*self.parts]
        if abs(self.move) <= BALANCED_MOVE * abs(self.parts[0].value):
            return next((p for p in named if p.cause in HOLDING), named[0])
        return next((p for p in named if p.value * self.move > 0), self.parts[0])


@dataclass(frozen=True, slots=True)
class Explanation:
    """All that a law predicts, plans and does next. Parts of its plan, not causes in the plant."""

    period_s: float
    courses: tuple[SignalCourse, ...]
    moves: tuple[ExplainedMove, ...]

    def course(self, signal: str) -> SignalCourse:
        """The course of a signal; KeyError where it has none."""
        return {c.signal: c for c in self.courses}[signal]

    def move(self, mv: str) -> ExplainedMove:
        """The next move of an MV; KeyError where there is none of this name."""
        return {m.mv: m for m in self.moves}[mv]

    def row(self) -> dict[str, Any]:
        """The explanation as JSON-ready values."""
        courses = [
            {"signal": c.signal, "group": c.group, "unit": c.unit, "times_s": [*c.times_s], "values": [*c.values]}
            for c in self.courses
        ]
        moves = [
            {
                "mv": m.mv,
                "unit": m.unit,
                "move": m.move,
                "parts": [{"cause": p.cause, "signal": p.signal, "value": p.value} for p in m.parts],
                "sentence": m.sentence,
            }
            for m in self.moves
        ]
        return {"period_s": self.period_s, "courses": courses, "moves": moves}

    def to_json(self) -> str:
        """The explanation as JSON."""
        return json.dumps(self.row(), allow_nan=False)


@dataclass(frozen=True, slots=True)
class WhatIf:
    """The courses after ``changes`` by name, beside what it does without them.

    The courses of both have a value at every sample: the law is stepped over its own model, which gives the readings.
    """

    changes: Mapping[str, float]
    before: Explanation
    after: Explanation

    def row(self) -> dict[str, Any]:
        """Both as JSON-ready values: ``changes``, ``before``, ``after``."""
        return {"changes": dict(self.changes), "before": self.before.row(), "after": self.after.row()}

    def to_json(self) -> str:
        """Both as JSON."""
        return json.dumps(self.row(), allow_nan=False)
