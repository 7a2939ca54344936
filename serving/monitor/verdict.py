"""Verdict of the monitor."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal, TypeAlias

import numpy as np

from loopwright.serving.manifest import Signal

Level: TypeAlias = Literal["as validated", "watch", "retrain", "not known yet"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """One plain line on one thing. ``value`` is what was measured and ``limit`` what it may be; None: not known."""

    name: str
    level: Level
    text: str
    value: float | None = None
    limit: float | None = None


def unknown(name: str, text: str) -> Verdict:
    """Nothing can be said yet."""
    return Verdict(name, "not known yet", text)


def failed(trouble: str) -> Verdict:
    """The monitor itself has an error."""
    return Verdict("monitor", "watch", f"the monitor itself failed: {trouble}")


def when(time_s: float | np.floating[Any]) -> str:
    """A time [s since 1970] in UTC; the page writes what it finds in this form in the zone of its own clock."""
    return datetime.fromtimestamp(float(time_s), UTC).strftime("%Y-%m-%d %H:%M UTC")


def unit_of(s: Signal) -> str:
    """The unit and a blank; nothing of a signal without one."""
    return "" if s.unit == "-" else f"{s.unit} "
