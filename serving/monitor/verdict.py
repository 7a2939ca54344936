"""What the monitor says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

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
