"""Where a loop begins: on the plant as it is, as far as the first values tell, and after whom."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError
from loopwright.serving.guard import implausible
from loopwright.serving.journal import Journal, JournalReader
from loopwright.serving.manifest import Signal
from loopwright.serving.opcua.nameplates import Seen
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.station.lease import address_of

Array: TypeAlias = NDArray[np.float64]

NAMESPACES, NODES = "namespaces", "nodes"  # what they are kept under


def usable(values: Values | None) -> bool:
    """Whether a loop may begin where these values say that the plant is."""
    return (
        values is not None and not values.fault and bool(np.isfinite(values.pv).all() and np.isfinite(values.mv).all())
    )


def near(values: Array | None, signals: tuple[Signal, ...]) -> list[float]:
    """A start within the ranges: what the plant has, or the middle where it is not known."""
    if values is None or not np.isfinite(values).all():
        return [s.middle for s in signals]
    return [_allowed(v, s) for v, s in zip(values.tolist(), signals, strict=True)]


def begun_at(mv: Array, signals: tuple[Signal, ...]) -> list[float] | None:
    """The MVs that a loop begins with; None where no actuator can stand there: the first good sample then tells."""
    if implausible(signals, mv.tolist()):
        return None
    return [_allowed(v, s) for v, s in zip(mv.tolist(), signals, strict=True)]


def another_before(journal: Path, controller: Controller) -> str:
    """Notice that the last loop of a journal ended with another controller, in one line; else empty."""
    runs: list[dict[str, object]] = []
    with suppress(LoopError, sqlite3.Error), closing(JournalReader(journal)) as reader:
        runs = reader.runs()
    if not runs or runs[-1]["sha256"] == controller.sha256:
        return ""
    last = f"{runs[-1]['controller']} ({str(runs[-1]['sha256'])[:12]})"
    return f"begins with {controller.path.name} ({controller.sha256[:12]}); the journal's last controller was {last}"


def keep_namespaces(journal: Journal, endpoint: str, spaces: Mapping[int, str]) -> None:
    """Write down which namespace each number stands for at a server, for the next run of the loop."""
    journal.keep(NAMESPACES, json.dumps({"endpoint": endpoint, "spaces": spaces}))


def namespaces_before(journal: Path, endpoint: str) -> dict[int, str]:
    """The namespaces by number that the last run found at this server; empty where a journal tells of none.

    The server is the same one however its address is spelt.
    """
    with suppress(LoopError, sqlite3.Error, ValueError, RecursionError), closing(JournalReader(journal)) as reader:
        kept = json.loads(reader.learnt(NAMESPACES) or "{}")
        spaces, at = (kept.get("spaces"), kept.get("endpoint")) if isinstance(kept, dict) else (None, None)
        same = isinstance(at, str) and (at == endpoint or address_of(at) == address_of(endpoint))
        if same and isinstance(spaces, dict):
            return {int(number): uri for number, uri in spaces.items() if isinstance(uri, str) and uri}
    return {}


def keep_nodes(journal: Journal, seen: Mapping[str, Seen]) -> None:
    """Write down as what the loop's nodes were seen, for its next run."""
    journal.keep(NODES, json.dumps(seen))


def nodes_before(journal: Path) -> dict[str, Seen]:
    """The nodes by row as the last run of the loop saw them; empty where a journal tells of none."""
    with suppress(LoopError, sqlite3.Error, ValueError, RecursionError), closing(JournalReader(journal)) as reader:
        kept = json.loads(reader.learnt(NODES) or "{}")
        if isinstance(kept, dict):
            whole = {
                row: seen for row, seen in kept.items() if isinstance(seen, list) and len(seen) == len(Seen._fields)
            }
            return {row: Seen(*map(str, seen)) for row, seen in whole.items()}
    return {}


def _allowed(value: float, signal: Signal) -> float:
    """The nearest value that the signal may have."""
    if signal.values is not None:
        return min(signal.values, key=lambda a: abs(a - value))
    return min(max(value, signal.low), signal.high)
