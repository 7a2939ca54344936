"""Entries that wait for a journal: a bounded number of scans and events, in the order in which they came."""

from __future__ import annotations

import threading
from collections import deque
from itertools import count
from typing import Any, TypeAlias

Item: TypeAlias = tuple[str, Any]  # kind, row
Numbered: TypeAlias = tuple[int, Item]

DROPPED = ("scan", "event")  # in this order; a run stays, since scans need it, and so does what was learnt


class EntryQueue:
    """Beyond ``most`` the oldest are dropped, scans before events; ``lost`` counts them.

    An entry that is taken counts until it is given back or written: a writer that hangs makes nothing grow.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._lock = threading.Lock()
        self._some = threading.Event()
        self._numbers = count()
        self._kinds: dict[str, deque[Numbered]] = {}
        self._taken: list[Numbered] = []

    def __len__(self) -> int:
        return len(self._taken) + sum(map(len, self._kinds.values()))

    def put(self, item: Item, most: int) -> bool:
        """Add an item; whether it is the first one for which another was dropped."""
        with self._lock:
            before = self.lost
            self._kinds.setdefault(item[0], deque()).append((next(self._numbers), item))
            self._shorten(most)
        self._some.set()
        return before == 0 < self.lost

    def wake(self) -> None:
        """Let ``wait`` return."""
        self._some.set()

    def wait(self) -> None:
        """Until there is something, or somebody says ``wake``."""
        self._some.wait()

    def take(self, most: int) -> list[Item]:
        """The oldest items, at most so many."""
        with self._lock:
            self._some.clear()
            while len(self._taken) < most and (full := [kind for kind in self._kinds.values() if kind]):
                self._taken.append(min(full, key=lambda kind: kind[0][0]).popleft())
            if any(self._kinds.values()):
                self._some.set()
            return [item for _, item in self._taken]

    def written(self) -> None:
        """The entries that were taken are in the journal."""
        with self._lock:
            self._taken = []

    def give_back(self, most: int) -> None:
        """The entries that were taken wait again."""
        with self._lock:
            for numbered in reversed(self._taken):
                self._kinds[numbered[1][0]].appendleft(numbered)
            self._taken = []
            self._shorten(most)
        self._some.set()

    def give_up(self) -> int:
        """Nothing will be written any more: how many scans and events are lost by that."""
        with self._lock:
            n = self._rows()
            self.lost += n
            self._kinds, self._taken = {}, []
        return n

    def _rows(self) -> int:
        return sum(kind in DROPPED for kind, _ in (item for _, item in self._taken)) + sum(
            len(self._kinds.get(kind, ())) for kind in DROPPED
        )

    def _shorten(self, most: int) -> None:
        for kind in DROPPED:
            old = self._kinds.get(kind)
            while old and len(self) > most:
                old.popleft()
                self.lost += 1
