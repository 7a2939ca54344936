"""News of a loop, sent to every open page."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

from loopwright.serving.errors import LoopwrightError
from loopwright.serving.journal import JournalReader
from loopwright.serving.journal.entries import Entry
from loopwright.serving.page.trend import plain
from loopwright.serving.words import named

Ask: TypeAlias = Callable[[dict[str, Any]], dict[str, Any]]

QUIET = ": still here\n\n"
PAGE_POLL_S, STATE_S, QUIET_S = 0.3, 1.0, 15.0  # [s] between two looks, two states, and signs of life
MOST_PAGES = 60  # that are sent news at a time
LATER_MS = 30_000  # after which a page beyond them may come again
WAITING_MESSAGES = 100  # messages that a page that takes none may leave
MOST_SCANS = 2_000  # that fill a gap; beyond it the page asks for the trend anew
ENTRIES = 200  # of the journal that a page shows


class Live:
    """Reads the journal and asks the loop for all pages together, as long as there is one.

    A failure meanwhile is counted (``failed``), told when it is another thing than before, and tried again.
    """

    def __init__(self, journal: Path, ask: Ask, tell: Callable[[str], None] = lambda _: None) -> None:
        self.journal, self._ask, self._tell = journal, ask, tell
        self.failed, self._trouble = 0, ""
        self._pages: set[asyncio.Queue[str | None]] = set()
        self._task: asyncio.Task[None] | None = None
        self._beginning = asyncio.Lock()
        self._newest_state = Shared(self._asked_state)
        self._last_id, self._state_at = 0, 0.0
        self._log: dict[int, str] | None = None  # nobody has looked yet
        self._state: dict[str, Any] = {}

    async def state(self, longest_s: float = 0.5) -> dict[str, Any]:
        """The loop's state, at most so old; where the loop does not answer, one that says so."""
        if not self._state or time.monotonic() - self._state_at > longest_s:
            return await self._newest_state()
        return self._state

    async def _asked_state(self) -> dict[str, Any]:
        try:
            found = await asyncio.to_thread(self._ask, {"do": "state"})
        except LoopwrightError as error:
            found = {**self._state, "alive": False, "connection": str(error)}
            found.setdefault("time", time.time())
            found.setdefault("mode", "HOLD")
        self._state, self._state_at = found, time.monotonic()
        return found

    @property
    def full(self) -> bool:
        """Whether no further page is sent news."""
        return len(self._pages) >= MOST_PAGES

    async def messages(self, last_id: int | None) -> AsyncIterator[str]:
        """Server-sent events for one page; ``last_id`` is the last scan that it has seen."""
        if self.full:  # others came in at the same moment
            yield f"retry: {LATER_MS}\n\n"
            return
        queue = asyncio.Queue[str | None](WAITING_MESSAGES)
        self._pages.add(queue)
        try:
            await self._begin()
            yield "retry: 1000\n\n"
            yield _message("state", await self.state())
            if last_id is not None:
                for missed in (await asyncio.to_thread(self._read, last_id))[0]:
                    yield missed
            while True:
                text: str | None
                try:
                    async with asyncio.timeout(QUIET_S):
                        text = await queue.get()
                except TimeoutError:
                    text = QUIET
                if text is None:
                    return  # too slow: it connects again and gets what it lacks
                yield text
        finally:
            self._pages.discard(queue)

    async def _begin(self) -> None:
        """Look for news from here on, unless that is done already."""
        async with self._beginning:
            if self._task is None or self._task.done():
                self._last_id = (await asyncio.to_thread(self._read, None))[1]
                if self._log is None:
                    await asyncio.to_thread(self._entries)  # what is there already is no news
                self._task = asyncio.create_task(self._run())

    async def _run(self) -> None:
        began = 0.0
        while self._pages:
            await asyncio.sleep(PAGE_POLL_S)
            texts: list[str] = []
            # A journal that cannot be read now may be read the next time; the state is told meanwhile.
            try:
                texts, self._last_id = await asyncio.to_thread(self._read, self._last_id)
                texts += await asyncio.to_thread(self._entries)
            except Exception as error:
                self._fails(error)
            if time.monotonic() - began > STATE_S or any("event: log" in text for text in texts):
                began = time.monotonic()
                try:
                    texts.append(_message("state", await self.state(0.0)))
                except Exception as error:
                    self._fails(error)
            for text in texts:
                self._send(text)

    def _fails(self, error: Exception) -> None:
        self.failed += 1
        trouble = named(error)
        if trouble != self._trouble:
            self._trouble = trouble
            self._tell(f"page: some news could not be read, and are read again: {trouble}")

    def _send(self, text: str) -> None:
        for page in list(self._pages):
            try:
                page.put_nowait(text)
            except asyncio.QueueFull:
                self._pages.discard(page)
                while not page.empty():
                    page.get_nowait()
                page.put_nowait(None)

    # ------------------------------------------------------------------ the journal, in a thread
    def _read(self, after_id: int | None) -> tuple[list[str], int]:
        """Messages of the scans after an id, and the newest id; None: only that."""
        with closing(JournalReader(self.journal)) as reader:
            newest = reader.last_id()
            if after_id is None or newest <= after_id:
                return [], newest
            if newest - after_id > MOST_SCANS:
                return [_message("reset", {}, newest)], newest
            runs: dict[int, list[str]] = {}
            texts: list[str] = []
            rows: list[tuple[float, ...]] = []
            columns: list[str] = []
            last = after_id
            for id_, run, scan in reader.scans(after_id):
                # Of the same state of the file as the scans: another controller may take over meanwhile.
                runs = runs or {r["id"]: r["columns"] for r in reader.runs()}
                if rows and runs[run] != columns:
                    texts.append(_scans(columns, rows, last))
                    rows = []
                columns, last = runs[run], id_
                rows.append((scan.time_s, *scan.numbers))
            if rows:
                texts.append(_scans(columns, rows, last))
            return texts, last

    def _entries(self) -> list[str]:
        """Messages of the events that are new, over or acknowledged since the last time."""
        with closing(JournalReader(self.journal)) as reader:
            found = {entry.id: json.dumps(shown(entry)) for entry in reader.entries(ENTRIES)}
        before, self._log = self._log, found
        if before is None:
            return []
        return [f"event: log\ndata: {text}\n\n" for id_, text in sorted(found.items()) if before.get(id_) != text]


def shown(entry: Entry) -> dict[str, Any]:
    """An event for the page."""
    e, seen = entry.event, entry.acknowledged
    return {
        "id": entry.id, "time": e.time_s, "kind": e.kind, "who": e.who, "what": e.what, "reason": e.reason,
        "alarm": e.raised, "over": entry.over_s,
        "acknowledged": None if seen is None else {"who": seen.who, "time": seen.time_s, "reason": seen.reason},
    }  # fmt: skip


def _scans(columns: list[str], rows: list[tuple[float, ...]], last: int) -> str:
    times, *numbers = zip(*rows, strict=True)
    values = {name: plain(column) for name, column in zip(columns, numbers, strict=True)}
    return _message("scans", {"time": times, "columns": values}, last)


def _message(event: str, data: Any, id_: int | None = None) -> str:
    head = "" if id_ is None else f"id: {id_}\n"
    return f"{head}event: {event}\ndata: {json.dumps(data, allow_nan=False)}\n\n"


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
