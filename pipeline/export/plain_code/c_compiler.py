"""The C compiler of this machine: which one it is, and its first error where it refuses."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from loopwright.pipeline.errors import HostError

COMPILERS = ("cc", "gcc", "clang")  # looked for in this order where CC names none


@dataclass(frozen=True, slots=True)
class CCompiler:
    """A program that compiles C, and the options that ``CC`` gives it."""

    words: tuple[str, ...]

    @classmethod
    def here(cls) -> CCompiler:
        """The one that ``CC`` names, else the first of ``COMPILERS`` that is there; HostError where there is none."""
        try:
            named = shlex.split(os.environ.get("CC", ""))
        except ValueError as error:
            raise HostError(
                f"CC is {os.environ['CC']!r}, which is no command line: {error}; unset or mend it"
            ) from None
        for words in [named] if named else [[name] for name in COMPILERS]:
            found = shutil.which(words[0])
            if found:
                return cls((str(Path(found).absolute()), *words[1:]))
        wanted = f"CC names {named[0]!r}, which is not there" if named else f"none of {', '.join(COMPILERS)} is there"
        raise HostError(f"no C compiler is installed: {wanted}; apt-get install gcc brings one")

    def version(self) -> str:
        """The first line that it prints of itself; HostError where it prints none, as one that lacks its parts."""
        done = self._run(["--version"], None)
        lines = done.stdout.strip().splitlines()
        if done.returncode or not lines:
            raise HostError(f"{self.words[0]} does not say its version: {_reason(done)}")
        return lines[0].strip()

    def compile(self, words: Sequence[str], what: str, folder: Path | None = None) -> None:
        """Run it with ``words`` in ``folder``; HostError with its first error where it cannot compile ``what``."""
        done = self._run(words, folder)
        if done.returncode:
            raise HostError(f"{self.words[0]} cannot compile {what}: {_reason(done)}")

    def _run(self, words: Sequence[str], folder: Path | None) -> subprocess.CompletedProcess[str]:
        command = [*self.words, *words]
        try:
            return subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
        except OSError as error:
            raise HostError(f"{self.words[0]} cannot be run: {error.strerror or error}") from error


def _reason(done: subprocess.CompletedProcess[str]) -> str:
    lines = [line for line in done.stderr.splitlines() if line.strip()] or [f"status {done.returncode}"]
    return next((line for line in lines if "error" in line), lines[0]).strip()
