"""Processes that do not outlive the one that started them, even where that one is killed outright."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys

_SET_PARENT_DEATH_SIGNAL = 1  # prctl's PR_SET_PDEATHSIG


def end_with_parent(parent: int | None = None) -> None:
    """Have the system end this process (SIGTERM) when its parent ends; does nothing outside Linux.

    ``parent`` is the parent's process id where the caller knows it: a parent that has ended already
    sends no signal any more.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):  # a C library without prctl
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
    if parent is not None and os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGTERM)


def hear_no_interrupt() -> None:
    """Ignore Ctrl-C in this process and in whatever it starts: the one that started it ends them all, in order."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
