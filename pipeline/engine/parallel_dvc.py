"""Chains of stages side by side: ``python -m loopwright.pipeline.engine.parallel_dvc [OPTIONS] CHAIN ...``.

The options are ``--of STAGE,...`` and ``--rest``. A chain is STAGE,STAGE,....

DVC runs one stage after another, and in each there is a while in which a core has nothing to do: imports, a single
data seed, DVC's own files. Chains that share no output fill it. Each lane takes the next chain and has a ``dvc repro``
of its own run its stages in their order, up to the first that fails; the stages that they depend on, outside the chain,
must be up to date. With ``--rest`` one more ``dvc repro`` then runs whatever is left. A chain that fails ends the run
once those beside it have ended. Results are those of one lane.

With ``repro ARGUMENT...`` in place of chains it is one ``dvc repro ARGUMENT...``.

The output of the lanes comes line by line, with each stage announced by its number among those ``of``
which the run may have to run. After SIGINT or SIGTERM no line comes any more, and no stage begins. DVC itself is not
interrupted while it may be writing down a finished stage: the run's door shuts, by which the stage that runs ends and
the next is refused, so that DVC ends by itself. The output of DVC before the signal says whether it had begun a stage.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from loopwright.pipeline.engine.dvc import COMMAND, end_with_parent, environment
from loopwright.pipeline.engine.output import BARS, MARK
from loopwright.pipeline.engine.start import DOOR

# --------------------------------------------------------------------------------------------------- stages that begin
RUNS = re.compile(r"Running stage '([^']+)':$")
CACHED = re.compile(r"Stage '([^']+)' is cached - skipping run")
SKIPPED = re.compile(r"Stage '([^']+)' didn't change, skipping$")
FAILED = re.compile(r"ERROR: failed to reproduce '([^']+)': failed to run: .*, exited with (\d+)$")
# What DVC says of its own files, and of git.
ASIDE = re.compile(
    r"(> python -m loopwright\.|(Generating|Updating) lock file|To track the changes with git|\tgit add |"
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


# ----------------------------------------------------------------------------------------------------------- the lanes
STAGE_LANES = 2  # more fill no core further: a stage's pieces already go to every worker
GRACE_S = 15.0  # in which DVC ends by itself


def main(argv: Sequence[str]) -> int:
    """Run the chains, then the rest if asked; the exit status of the first failure, or 0."""
    parser = argparse.ArgumentParser(prog="python -m loopwright.pipeline.engine.parallel_dvc")
    parser.add_argument("--of", metavar="STAGE,...", type=lambda names: names.split(","), default=[])
    parser.add_argument("--rest", action="store_true", help="run whatever is left after the chains")
    parser.add_argument("work", metavar="STAGE,...", nargs="+", help="chains, or repro and its arguments")
    asked, further = parser.parse_known_args(argv)
    lanes = _Lanes(Announcements(asked.of, words_of(Path("dvc.yaml"))))
    if asked.work[0] == "repro":
        return lanes.run([[*asked.work, *further]])
    if further or not all(asked.work):
        parser.error(f"{' '.join(further)}: give stages of dvc.yaml")
    # Single items: a look at a stage that they share would lock it for the others.
    repro = ["--wait-for-lock", "repro"]
    chains = [[*repro, "--single-item", *chain.split(",")] for chain in asked.work]
    return lanes.run(chains) or (lanes.run([repro]) if asked.rest else 0)


@dataclass
class _Lane:
    """The state of one DVC process."""

    line: bytearray = field(default_factory=bytearray)  # that it has begun to write
    ran: bool = False  # whether a stage ran, so that it may be writing dvc.lock


class _Lanes:
    """DVC with one list of arguments after another, a few at once."""

    def __init__(self, announcements: Announcements) -> None:
        self.announcements = announcements
        self.bars = Bars(Console())
        self.stopped, self.patience_ends = 0, float("inf")  # the signal that ended the run; when DVC is ended, too
        self.told = False  # whether those that run no stage were ended, once the run was to end
        self.running = dict[subprocess.Popen[bytes], _Lane]()
        for asked in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(asked) != signal.SIG_IGN:
                signal.signal(asked, lambda number, _: self._stop(number))

    def run(self, work: list[list[str]]) -> int:
        """Do all of ``work``; the exit status of the first failure, or 0."""
        left, first = list(work), 0
        with selectors.DefaultSelector() as waiting, self.bars:
            while self.running or (left and not self.stopped and not first):
                while left and len(self.running) < STAGE_LANES and not self.stopped and not first:
                    process = self._begun(left.pop(0))
                    waiting.register(process.stdout, selectors.EVENT_READ, process)  # type: ignore[arg-type]
                if self.stopped and time.monotonic() > self.patience_ends:
                    self._end(self.running)
                stopping = bool(self.stopped) and not self.told
                for key, _ in waiting.select(0 if stopping else 0.5):
                    if self._passed_on(key.data):
                        continue
                    waiting.unregister(key.fileobj)
                    code = self._ended(key.data)
                    first = first or code
                if stopping:  # a pipe holds no more than was just read of it
                    self._end_idle()
        return 128 + self.stopped if self.stopped else first

    def _begun(self, arguments: list[str]) -> subprocess.Popen[bytes]:
        own = os.getpid()
        process = subprocess.Popen(
            [*COMMAND, *arguments],
            env={**environment(), **({BARS: "1"} if self.bars.shown else {})},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            bufsize=0,
            preexec_fn=lambda: end_with_parent(own),
            start_new_session=True,  # so that its stages can be ended with it
        )
        self.running[process] = _Lane()
        return process

    def _passed_on(self, process: subprocess.Popen[bytes]) -> bool:
        """Write the lines that a process has completed; False at their end."""
        assert process.stdout is not None
        found = os.read(process.stdout.fileno(), 65_536)
        lane = self.running[process]
        lane.line += found
        *lines, rest = bytes(lane.line).split(b"\n") if found else [bytes(lane.line), b""]
        lane.line[:] = rest
        for line in lines:
            text, before = line.decode(errors="replace"), self.announcements.begun
            if not self.stopped and self.bars.takes(process.pid, text):
                continue
            words = self.announcements.of(text)
            if self.announcements.begun > before:
                lane.ran = True
                self.bars.ended(process.pid)
            if self.stopped:
                if b"failed to" in line:  # nothing more is written down: with --keep-going it would try the others
                    self._end([process])
            elif words is not None and self.bars.shown:
                self.bars.write(words)
            elif words is not None:
                os.write(1, words.encode() + b"\n")
        return bool(found)

    def _ended(self, process: subprocess.Popen[bytes]) -> int:
        del self.running[process]
        self.bars.ended(process.pid)
        assert process.stdout is not None
        process.stdout.close()
        code = process.wait()
        return 128 - code if code < 0 else code  # of a signal, as a shell counts

    def _stop(self, number: int) -> None:
        """Begin no further stage, and have those that run end."""
        if self.stopped:
            return
        self.bars = Bars(Console())
        self.stopped, self.patience_ends = number, time.monotonic() + GRACE_S

    def _end_idle(self) -> None:
        """End DVC where no stage ran that it may be writing down, or where nothing else ends its stage."""
        self.told = True
        served = DOOR in os.environ  # by a process that ends the stages
        self._end([process for process, lane in self.running.items() if not (served and lane.ran)])

    @staticmethod
    def _end(processes: Sequence[subprocess.Popen[bytes]] | dict[subprocess.Popen[bytes], _Lane]) -> None:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
