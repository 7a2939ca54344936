"""The lines of a run for a person: each stage by number and in words, in place of DVC's lines."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import yaml

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
