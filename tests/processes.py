"""Processes of tests: whether they live, and waiting for what they do."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from threading import Event


def within(seconds: float, holds: Callable[[], bool]) -> bool:
    """Whether something comes to hold in time."""
    for _ in range(int(seconds / 0.02)):
        if holds():
            return True
        Event().wait(0.02)
    return False


def lives(pid: int) -> bool:
    """Whether a process of this machine runs, and is no zombie."""
    try:
        os.kill(pid, 0)
        status = Path(f"/proc/{pid}/status")
        return not (status.exists() and "\nState:\tZ" in status.read_text())
    except OSError:
        return False
