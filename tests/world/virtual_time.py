"""One time for a whole world: what waits is called in order, and nobody waits for real.

Connections are tasks of one asyncio loop whose clock is the world's. Whoever waits in a call of its own, as a loop
does between two scans, is an actor: a thread that runs only while it has the baton.
"""

from __future__ import annotations

import _thread
import asyncio
import heapq
import selectors
import threading
from collections.abc import Callable
from itertools import count
from typing import Any

BEGIN_S = 1_750_000_000.0  # seconds since 1970 at which a world begins
LONGEST_TURN_S = 120.0  # of this machine: an actor that computes longer hangs


class HangsError(Exception):
    """Somebody waits for what never comes."""


class _Selector(selectors.DefaultSelector):  # type: ignore[misc,valid-type]
    """Waits by letting the world's time pass."""

    def __init__(self, world: VirtualTime) -> None:
        super().__init__()
        self._world = world

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            raise HangsError("nothing is due")
        self._world.now_s += max(timeout, 0.0)
        return []


class _EventLoop(asyncio.SelectorEventLoop):
    def __init__(self, world: VirtualTime) -> None:
        super().__init__(_Selector(world))
        self._world = world

    def time(self) -> float:
        return self._world.now_s

    def _write_to_self(self) -> None:
        """Wake nobody: it runs only while all others wait."""


class _Clock:
    """A clock for scans whose sleep is a wait in the world."""

    def __init__(self, world: VirtualTime) -> None:
        self._world, self.ended = world, False

    def now(self) -> float:
        return self._world.now_s

    def sleep_until(self, time_s: float) -> None:
        if not self.ended:
            self._world.wait_until(time_s)

    def end(self) -> None:
        self.ended = True


class VirtualTime:
    """Time of a world, as ``loopwright.serving.clock.Time``; ``wall_s`` may be set by ``set_by_s``."""

    def __init__(self) -> None:
        self.now_s = self.set_by_s = 0.0
        self.loop = _EventLoop(self)
        self._waiting: list[tuple[float, int, int, _thread.LockType]] = []  # until when, its place, the actor's thread
        self._idle: asyncio.Future[None] | None = None  # over with the time that passes now
        self._left = set[int]()  # threads of actors that are never called again
        self._order, self._baton = count(), _thread.allocate_lock()
        self._baton.acquire()
        self._failed: list[BaseException] = []
        self.loop.set_exception_handler(self._raised)

    def _raised(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What a call of the event loop raises ends the world."""
        self._failed.append(context.get("exception") or HangsError(context["message"]))

    def task_ended(self, task: asyncio.Task[Any]) -> None:
        """Called at the end of a task: what it raised ends the world."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self._failed.append(error)

    # -------------------------------------------------------------------------------------- as a loop's machine has it
    def wall_s(self) -> float:
        return BEGIN_S + self.set_by_s + self.now_s

    def steady_s(self) -> float:
        return self.now_s

    def wait(self, seconds: float) -> None:
        self.wait_until(self.now_s + seconds)

    def paced(self, speed: float) -> _Clock:
        assert speed == 1.0
        return _Clock(self)

    # ------------------------------------------------------------------------------------------------------ the actors
    def wait_until(self, time_s: float) -> None:
        """Called by an actor: hand the baton on, and have it back at a time."""
        turn = _thread.allocate_lock()
        turn.acquire()
        heapq.heappush(self._waiting, (time_s, next(self._order), threading.get_ident(), turn))
        self._baton.release()
        turn.acquire()

    def act(self, work: Callable[[], object]) -> Callable[[], None]:
        """Have an actor do ``work`` from now on; call the result to leave it waiting for ever.

        What it raises is raised by ``pass_until``.
        """
        turn = _thread.allocate_lock()
        turn.acquire()

        def run() -> None:
            turn.acquire()
            try:
                work()
            except BaseException as error:
                self._failed.append(error)
            finally:
                self._baton.release()

        actor = threading.Thread(target=run, daemon=True)
        actor.start()
        assert actor.ident is not None
        self._left.discard(actor.ident)
        heapq.heappush(self._waiting, (self.now_s, next(self._order), actor.ident, turn))
        self._stir()
        return lambda: self._left.add(actor.ident or 0)

    def later(self, seconds: float, work: Callable[[], object]) -> None:
        """Call ``work`` after so many seconds, beside the actors."""
        self.loop.call_later(seconds, work)

    def pass_until(self, time_s: float) -> None:
        """Let time pass: all that is due is called, in order."""
        while True:
            while self._waiting and self._waiting[0][2] in self._left:
                heapq.heappop(self._waiting)
            due = min(time_s, self._waiting[0][0]) if self._waiting else time_s
            if self.now_s < due:
                self._idle_until(due)
            elif self._waiting and self._waiting[0][0] <= self.now_s:
                self._give(heapq.heappop(self._waiting)[3])
            else:
                return
            if self._failed:
                raise self._failed.pop()

    def _give(self, turn: _thread.LockType) -> None:
        """Hand the baton to an actor, and wait until it is back."""
        turn.release()
        if not self._baton.acquire(timeout=LONGEST_TURN_S):
            raise HangsError(f"an actor does not wait or end within {LONGEST_TURN_S:g} s")

    def _idle_until(self, time_s: float) -> None:
        """Only the event loop acts until then, or until it has called an actor."""
        self._idle = self.loop.create_future()
        ends = self.loop.call_at(time_s, self._stir)
        self.loop.run_until_complete(self._idle)
        ends.cancel()

    def _stir(self) -> None:
        if self._idle is not None and not self._idle.done():
            self._idle.set_result(None)

    def close(self) -> None:
        """End all tasks; actors that wait still are left waiting."""
        for task in asyncio.all_tasks(self.loop):
            task.cancel()
        self.loop.run_until_complete(asyncio.sleep(0))
        self.loop.close()
