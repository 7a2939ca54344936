"""Entries of a journal: scans, and the events between them."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

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


# ------------------------------------------------------------------------------------------ scans as compressed blocks
Array: TypeAlias = NDArray[np.float64]


def packed(rows: Sequence[Sequence[Any]]) -> bytes:
    """Scans as one compressed value: a column after the other, of each all first bytes, then all second ones."""
    numbers = np.stack([np.frombuffer(row[4]) for row in rows])
    table = np.column_stack([[row[2] for row in rows], numbers]).astype("<f8")
    planes = table.T.copy().view(np.uint8).reshape(table.shape[1], len(rows), 8).transpose(0, 2, 1)
    head = {
        "rows": len(rows),
        "modes": _runs([row[3] for row in rows]),
        "quality": {i: json.loads(row[5]) for i, row in enumerate(rows) if row[5]},
        "reason": {i: row[6] for i, row in enumerate(rows) if row[6]},
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    return zlib.compress(len(text).to_bytes(4, "little") + text + planes.tobytes(), 6)


def unpacked(data: bytes) -> list[Scan]:
    """The scans that ``packed`` made one value of."""
    head, numbers = _opened(data)
    modes = [mode for mode, times in head["modes"] for _ in range(times)]
    return [
        Scan(row[0], modes[i], tuple(row[1:]), tuple(head["quality"].get(str(i), ())), head["reason"].get(str(i), ""))
        for i, row in enumerate(numbers.tolist())
    ]


def table(data: bytes) -> tuple[Array, list[str]]:
    """Times and numbers of a packed value, shape (scans, 1 + columns), and the mode of each scan."""
    head, numbers = _opened(data)
    return numbers, [mode for mode, times in head["modes"] for _ in range(times)]


def _opened(data: bytes) -> tuple[dict[str, Any], Array]:
    content = zlib.decompress(data)
    size = int.from_bytes(content[:4], "little")
    head = json.loads(content[4 : 4 + size])
    planes = np.frombuffer(content, dtype=np.uint8, offset=4 + size).reshape(-1, 8, head["rows"])
    return head, planes.transpose(0, 2, 1).copy().view("<f8")[..., 0].T


def _runs(values: Sequence[str]) -> list[tuple[str, int]]:
    found: list[tuple[str, int]] = []
    for value in values:
        if found and found[-1][0] == value:
            found[-1] = (value, found[-1][1] + 1)
        else:
            found.append((value, 1))
    return found
