"""The lock of a controller's steps, which a forked child finds free.

A child of a fork has one thread: a lock that another thread held would never be released there. So a fork waits for the
steps that are under way. Their buffers, and onnxruntime's own locks, are then as between two steps.
"""

from __future__ import annotations

import os
from threading import Lock
from weakref import WeakSet

LONGEST_STEP_S = 1.0  # a fork waits no longer for a step
_locks: WeakSet[Lock] = WeakSet()  # of all controllers of this process
_held: list[Lock] = []  # by the thread that forks
_forking = Lock()


def step_lock() -> Lock:
    """A lock that is free in every child of this process, whoever holds it at the fork."""
    lock = Lock()
    _locks.add(lock)
    return lock


def _before() -> None:
    _forking.acquire()
    _held.extend(lock for lock in list(_locks) if lock.acquire(timeout=LONGEST_STEP_S))


def _in_parent() -> None:
    while _held:
        _held.pop().release()
    _forking.release()


def _in_child() -> None:
    _held.clear()
    for lock in (*_locks, _forking):
        if lock.locked():  # by this thread, or by one whose step took too long and that the child has not
            lock.release()


if hasattr(os, "register_at_fork"):  # where processes fork
    os.register_at_fork(before=_before, after_in_parent=_in_parent, after_in_child=_in_child)
