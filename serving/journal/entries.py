"""Entries of a journal: scans, and the events between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from loopwright.serving.manifest import Manifest

Kind: TypeAlias = Literal["change", "swap", "fault", "connection", "monitor", "acknowledged"]

GROUPS = ("sp", "pv", "mv", "applied", "law", "beside", "dv", "info")


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan. ``numbers`` are the columns of its run, NaN where there was none; no ``quality``: all is good."""

    time_s: float  # since 1970
    mode: str
    numbers: tuple[float, ...]
    quality: tuple[int, ...] = ()
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """A change by somebody, or an event.

    With ``alarm`` it begins (``raised``) or ends the alarm of that name; a new one of the same name ends the one
    before. ``about`` is the id of the event that is acknowledged.
    """

    time_s: float
    kind: Kind
    who: str
    what: str
    reason: str = ""
    alarm: str = ""
    raised: bool = False
    about: int = 0


def columns(manifest: Manifest) -> list[str]:
    """Names of a scan's numbers: group and signal, as ``pv T``."""
    m = manifest
    signals = dict(zip(GROUPS, (m.sp, m.pv, m.mv, m.mv, m.mv, m.mv, m.dv), strict=False))
    return [f"{g} {s.name}" for g, group in signals.items() for s in group] + [f"info {i}" for i in m.info]
