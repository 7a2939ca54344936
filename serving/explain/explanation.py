"""Courses that a law predicts and plans, and the parts of its next moves; as values and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
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
    MV to its resting value. ``mv_low`` and ``mv_high``: an MV is at a limit, now or ``in_s`` later, where only a later
    move of the plan gets there. ``max_move``: it moves no faster; ``not_in_use``: it must stay. ``plan``: the rest, by
    which the plan still hangs on the last one.
    """

    cause: Cause
    signal: str  # empty for ``plan``
    value: float  # [mv]
    in_s: float = 0.0  # [s] until the MV is at its limit, by the plan; 0 where it is now or after the next move


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
                "parts": [{"cause": p.cause, "signal": p.signal, "value": p.value, "in_s": p.in_s} for p in m.parts],
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


# ------------------------------------------------------------------------------------------------ a move in plain words
LEAST_SHARE = 0.05  # of a side's sum: a smaller part is not named, nor a side whose sum is smaller beside the other's
MOST_NAMED = 3  # parts of a side: more than that nobody reads
STANDS = 5e-4  # of an MV's range: a smaller move is none


def sentence_of(
    move: float,
    span: float,
    parts: Sequence[MovePart],
    news: Mapping[str, float],
    to_rest: Mapping[str, float] | None = None,
) -> str:
    """A move [mv] of an MV whose range is ``span`` [mv] wide, by its ``parts``.

    ``news`` by the name of a signal: by how much a measured disturbance changed, or a reading is above the
    predicted one. ``to_rest`` by the name of the MV itself: how far its resting value is above where it stands. The
    plan may go to that in a roundabout way, and its part of the first move points away from it; the words say so. A
    move towards the resting value is never said to be held back by it.
    """
    way = {} if to_rest is None else to_rest
    away = {p.signal for p in parts if p.cause == "rest" and p.value * way.get(p.signal, 0.0) < 0}
    names = {p: words(p, news, roundabout=p.signal in away) for p in parts}
    least = STANDS * span
    if abs(move) <= least:
        held = [p for p in parts if abs(p.value) > least]
        if not held:
            return "stands: nothing asks for a move"
        one, other = ([p for p in held if (p.value > 0) is up] for up in (True, False))
        both = "; against it ".join(filter(None, (_listed(one, names), _listed(other, names))))
        return f"stands: {both}"
    ahead, back = (
        [p for p in parts if (p.value * move > 0) is same and abs(p.value) > least] for same in (True, False)
    )
    back = [p for p in back if p.cause != "rest" or move * way.get(p.signal, 0.0) <= 0]
    least = LEAST_SHARE * max(_sum(ahead), _sum(back))
    return "; held back by ".join(_listed(side, names) for side in (ahead, back) if side and _sum(side) >= least)


def _sum(side: Sequence[MovePart]) -> float:
    return sum(abs(p.value) for p in side)


def _listed(parts: Sequence[MovePart], names: Mapping[MovePart, str]) -> str:
    """The largest parts of one side with their shares of that side's sum."""
    whole = _sum(parts)
    largest = sorted(parts, key=lambda p: -abs(p.value))[:MOST_NAMED]
    named = [p for p in largest if abs(p.value) >= LEAST_SHARE * whole] or largest[:1]
    return "; ".join(f"{100 * abs(p.value) / whole:.0f} %: {names[p]}" for p in named)


def words(part: MovePart, news: Mapping[str, float], *, roundabout: bool = False) -> str:
    """A cause in words; ``roundabout``: the part of a resting value points away from it."""
    name, up = part.signal, news.get(part.signal, 0.0) >= 0
    return {
        "setpoint": f"{name} towards its set point",
        "range_low": f"{name} towards its low limit",
        "range_high": f"{name} towards its high limit",
        "disturbance": f"{name} {'rose' if up else 'fell'}",
        "forecast": f"{name} as it is to come",
        "load": f"something not measured {'raises' if up else 'lowers'} {name}",
        "cost": f"cost of {name}",
        "rest": f"{name} to its resting value{', first the other way' if roundabout else ''}",
        "mv_low": f"{name} {_at('low', part.in_s)}",
        "mv_high": f"{name} {_at('high', part.in_s)}",
        "max_move": f"{name} moves no faster",
        "not_in_use": f"{name} is not in use",
        "plan": "what was planned before",
    }[part.cause]


def _at(end: str, in_s: float) -> str:
    """An MV at one of its limits, or when it will be."""
    if not in_s:
        return f"at its {end} limit"
    of, unit = next((size, name) for size, name in ((3600, "h"), (60, "min"), (0, "s")) if in_s >= size)
    return f"will reach its {end} limit in {in_s / (of or 1):.3g} {unit}"
