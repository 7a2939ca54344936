"""When a stage ran, and for how long: from its receipt, which ``pipeline.engine.start`` writes.

Outputs hold no time, so that an equal result is an equal file. A receipt lies outside of them, in
``receipts/<stage>.json``: the start [s since 1970] and the duration [s] of the stage's last run. It
belongs to the files on disk only if they were written while that run lasted; files that DVC took
from its cache have no duration here.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from pipeline.engine.start import receipt_path
from pipeline.tracking.lock import StageResult

SLACK_S = 60.0
"""DVC may copy the outputs into its cache and back before its next stage starts."""


@dataclass(frozen=True, slots=True)
class Times:
    """Start and end of a stage in ms since 1970; where the duration is not known, both are when the files came."""

    start_ms: int
    end_ms: int
    measured: bool

    @classmethod
    def of(cls, result: StageResult, root: Path) -> Times:
        """The times of the run that wrote the files of ``result``."""
        written = _written(result, root)
        try:
            row = json.loads(receipt_path(root, result.name).read_text(encoding="utf-8"))
            start, end = float(row["started"]), float(row["started"]) + float(row["seconds"])
        except (OSError, ValueError, KeyError, TypeError):
            start, end = written, written
        measured = start < end and start - 1.0 <= written <= end + SLACK_S
        if not measured:
            start = end = written
        return cls(round(1000 * start), round(1000 * end), measured)


def _written(result: StageResult, root: Path) -> float:
    """When the newest file of the outputs was written [s since 1970]."""
    tops = [root / out for out in result.outs]
    files = [f for top in tops for f in ([top] if top.is_file() else top.rglob("*")) if f.is_file()]
    return max((f.stat().st_mtime for f in files), default=0.0)
