"""DVC's output, line by line: which stage begins, and the bars of a terminal."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from loopwright.pipeline.engine.capture_output import MARK

# --------------------------------------------------------------------------------------------------- stages that begin
RUNS = re.compile(r"Running stage '([^']+)':$")
CACHED = re.compile(r"Stage '([^']+)' is cached - skipping run")
SKIPPED = re.compile(r"Stage '([^']+)' didn't change, skipping$")
FAILED = re.compile(r"ERROR: failed to reproduce '([^']+)': failed to run: .*, exited with (\d+)$")
# What DVC says of its own files, and of git.
ASIDE = re.compile(
    r"(> python -m pipeline\.|(Generating|Updating) lock file|To track the changes with git|\tgit add |"
    r"To enable auto staging|\tdvc config core\.autostage|Use `dvc push`|WARNING: Process '.* had been killed)"
)


def words_of(file: Path) -> dict[str, str]:
    """Kind of stage -> what it makes, in the words of a dvc.yaml; none where there is no such file."""
    if not file.is_file():
        return {}
    stages = yaml.safe_load(file.read_text())["stages"]
    return {kind: entry.get("do", entry).get("desc", "") for kind, entry in stages.items()}


class Announcements:
    """Lines of DVC and its stages, as a person reads them.

    ``expected`` are the stages that may run. One that turns out to need no run is no longer counted, so that the
    number of stages only falls.
    """

    def __init__(self, expected: Iterable[str], words: Mapping[str, str]) -> None:
        self.left, self.words, self.begun = set(expected), words, 0

    def of(self, line: str) -> str | None:
        """The line to show for one that was written; None for none."""
        line = line.rstrip()
        if found := SKIPPED.match(line):
            self.left.discard(found[1])
            return None
        if found := RUNS.match(line):
            return self._stage(found[1])
        if found := CACHED.match(line):
            return f"{self._stage(found[1])}: made before from the same inputs, taken from the cache"
        if found := FAILED.match(line):
            return (
                f"{_name(found[1])} failed (exit status {found[2]}), its last line says why; finished stages are kept"
            )
        return line if line and not ASIDE.match(line) else None

    def _stage(self, stage: str) -> str:
        self.left.discard(stage)
        self.begun += 1
        words = self.words.get(stage.partition("@")[0])
        return f"stage {self.begun} of {self.begun + len(self.left)}: {_name(stage)}" + (f" ({words})" if words else "")


def _name(stage: str) -> str:
    """``fit@tank-identified`` as its lines of progress begin."""
    return stage.replace("@", " ")


# ---------------------------------------------------------------------------------------------------------------- bars
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
