"""How far a piece of work is: a bar on a terminal, elsewhere a line now and then.

A run of several stages shows lines, or draws bars from marked ones (``bars``), which it asks for by BARS in the
environment. Lines come when something ends, and at most one every ``LINE_EVERY_S`` seconds, so that a run of minutes
stays readable; short work says nothing.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import Lock

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from loopwright.pipeline.engine.output import BARS, MARK

LINE_EVERY_S, MARKED_EVERY_S = 10.0, 0.5  # [s] between two lines, for a person and for a program that draws the bar
SPEED_KNOWN = 0.2  # share of a piece after which its speed says how long the rest takes
SOON_S = 5.0  # time left that is not worth a word


@dataclass
class Lines:
    """Lines of progress of this process; ``marked`` ones are for a program that draws bars."""

    clock: Callable[[], float] = time.monotonic
    every: float | None = None  # [s] between two lines
    marked: bool = field(default_factory=lambda: bool(os.environ.get(BARS)))
    last: float = field(init=False)  # when the last line was due; the start of the process before the first
    lock: Lock = field(default_factory=Lock, init=False)

    def __post_init__(self) -> None:
        if self.every is None:
            self.every = MARKED_EVERY_S if self.marked else LINE_EVERY_S
        self.last = self.clock()

    def show(self, label: str, share: float | None = None, count: str = "", left: float = 0.0) -> None:
        """Say how far ``label`` is, unless a line was written a short while ago; ``left`` [s] where it is known."""
        assert self.every is not None
        with self.lock:
            now = self.clock()
            if now - self.last < self.every:
                return
            self.last = now
        rest = f"about {_rounded(left)} left" if left >= SOON_S else ""
        if self.marked:
            text = MARK + json.dumps({"label": label, "share": share or 0.0, "left": rest})
        else:
            words = (count, "" if share is None else f"{100 * share:.0f} % done", rest)
            text = label + ": " * any(words) + ", ".join(filter(None, words))
        print(text, file=sys.stderr, flush=True)


class WorkPiece:
    """A piece of work of ``total`` units, done at about the same speed, under ``label``."""

    def __init__(self, label: str, total: float, lines: Lines) -> None:
        self.label, self.total, self.lines = label, total, lines
        self.begun = lines.clock()
        lines.show(label)

    def show(self, done: float, count: str = "") -> None:
        """Say how much is done, and about how long the rest takes once that can be known."""
        share = min(done / self.total, 1.0) if self.total > 0 else 1.0
        left = (self.lines.clock() - self.begun) * (1 - share) / share if share >= SPEED_KNOWN else 0.0
        self.lines.show(self.label, share, count, left)


# Of a thread and not of a process: a worker's process holds several stages at a time.
_lines: ContextVar[Lines] = ContextVar("lines", default=Lines())  # noqa: B039 - one for whoever has none of its own
_label: ContextVar[str] = ContextVar("label", default="")  # of the work that this thread does; empty: others share it


@contextmanager
def lines_anew(every: float | None = None, *, marked: bool = False) -> Iterator[None]:
    """Within, a stage begins: its lines wait for no others. ``every`` seconds there is one; infinity: none."""
    token = _lines.set(Lines(every=every, marked=marked))
    try:
        yield
    finally:
        _lines.reset(token)


@contextmanager
def within(label: str) -> Iterator[None]:
    """Whatever ``steps`` shows inside belongs to ``label``; an empty label shows nothing."""
    token = _label.set(label)
    try:
        yield
    finally:
        _label.reset(token)


def piece(label: str, total: float) -> WorkPiece:
    """A piece of work of a stage, whose lines begin with ``label``."""
    return WorkPiece(label, total, _lines.get())


def steps(what: str, total: int) -> Callable[[int], None]:
    """Shows how many of ``total`` steps of one item of work are done; nothing outside ``within``."""
    if not _label.get():
        return lambda done: None
    own = piece(f"{_label.get()}: {what}", total)
    return own.show


def progress_bar() -> Progress:
    """A progress bar on stderr; silent where stderr is not a terminal."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
    )


def _rounded(seconds: float) -> str:
    """``35 s``, ``4 min``: no more digits than an estimate has."""
    return f"{5 * max(round(seconds / 5), 1)} s" if seconds < 90 else f"{seconds / 60:.0f} min"
