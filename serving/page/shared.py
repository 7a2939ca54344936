"""Answers that are made once for all who ask meanwhile."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Shared(Generic[T]):
    """Runs ``make`` once at a time; whoever asks while it runs gets its answer.

    However many pages ask, the loop is asked by one of them.
    """

    def __init__(self, make: Callable[[], Awaitable[T]]) -> None:
        self._make = make
        self._running: asyncio.Task[T] | None = None

    async def __call__(self) -> T:
        """The answer; raises what ``make`` raises."""
        if self._running is None or self._running.done():
            self._running = asyncio.create_task(self._run())
        return await asyncio.shield(self._running)  # who leaves ends it for nobody else

    async def _run(self) -> T:
        return await self._make()
