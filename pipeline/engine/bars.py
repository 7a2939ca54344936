"""One bar for each stage that runs, on a terminal; lines of text pass above them.

A stage cannot draw on a terminal that it shares with others. It writes marked lines instead (``progress``), from which
whoever runs the stages draws.
"""

from __future__ import annotations

import json
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from loopwright.pipeline.engine.spoken import MARK


class Bars:
    """The bars of the stages that run, each under a key; they are not ``shown`` where ``console`` is no terminal."""

    def __init__(self, console: Console) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[left]}"),
            TimeElapsedColumn(),
        )
        self.shown = console.is_terminal
        self._progress = Progress(*columns, console=console, transient=True, disable=not self.shown)
        self._tasks = dict[int, TaskID]()

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._progress.stop()

    def takes(self, key: int, line: str) -> bool:
        """Whether a line is one of progress, which then moves the bar of ``key``."""
        if not line.startswith(MARK):
            return False
        told = json.loads(line.removeprefix(MARK))
        if key not in self._tasks:
            self._tasks[key] = self._progress.add_task("", total=1.0, left="")
        self._progress.update(
            self._tasks[key], description=told["label"], completed=told["share"], left=told["left"], refresh=True
        )
        return True

    def ended(self, key: int) -> None:
        """Take the bar of ``key`` away; the next line of progress begins another."""
        if key in self._tasks:
            self._progress.remove_task(self._tasks.pop(key))

    def write(self, text: str) -> None:
        """A line of text above the bars."""
        self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)
