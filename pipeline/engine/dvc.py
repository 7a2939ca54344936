"""DVC as this program starts it: with this Python, deaf to a Ctrl-C that is for the program, and ended with it."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from configparser import ConfigParser
from pathlib import Path

from loopwright.pipeline.errors import PipelineError

PYTHON = (sys.executable, "-P")  # no package comes from the folder in which somebody stands: a numpy.py there would run
COMMAND = (*PYTHON, "-m", "dvc")
DEPENDENCY = re.compile(r'"([^"]+)" -> "([^"]+)";')  # of a line of `dvc dag --dot`
MARK = "\x1e"  # the ASCII record separator
# One command of DVC after another, a mark after each: loading DVC takes longer than most of them. What it loads stays:
# no garbage is looked for.
IN_TURN = """
import gc, json, sys
gc.disable()
from dvc.cli import main
for command in json.loads(sys.argv[1]):
    if code := main(command):
        sys.exit(code)
    print(sys.argv[2], end="", flush=True)
"""
OF_DVC = ("ERROR:", "WARNING:", "Stage '", "Running stage '", "> ")  # beginnings of its own lines


def suit_history(root: Path = Path()) -> None:
    """Let DVC keep its results without git in a copy of the repository that has no history, as a source archive.

    It says so in ``.dvc/config.local``, which git ignores, and takes it back once there is a history.
    """
    folder = root / ".dvc"
    if not folder.is_dir():
        return
    file, config = folder / "config.local", ConfigParser()
    bare = not any((above / ".git").exists() for above in (root.resolve(), *root.resolve().parents))
    config.read(file)
    if bare != config.getboolean("core", "no_scm", fallback=False):
        if not config.has_section("core"):
            config.add_section("core")
        config.set("core", "no_scm", str(bare).lower())
        with file.open("w") as lines:
            config.write(lines)


def environment() -> dict[str, str]:
    """The environment of this process, in which ``python`` is this Python.

    The commands of dvc.yaml begin with ``python``: without an activated environment that is another one, which has
    none of our packages. The folder stays as it is named: behind the link lies the Python without the packages.
    """
    own, path = str(Path(sys.executable).parent), os.environ.get("PATH")
    return {**os.environ, "PATH": own if not path else f"{own}{os.pathsep}{path}"}


def ask(*arguments: str, finish: bool = False) -> str:
    """The output of ``dvc ARGUMENT...``; PipelineError with the line that says why it failed.

    A Ctrl-C ends DVC at once; with ``finish`` DVC ends its work first, because it writes dvc.lock.
    """
    code, out, err = _done([*COMMAND, *arguments], finish)
    if code:
        raise PipelineError(f"dvc {arguments[0]} failed: {_reason(err or out)}")
    return out


def ask_in_turn(*commands: Sequence[str]) -> list[str]:
    """The output of ``dvc ARGUMENT...`` for each of some commands, as ``ask`` of each; DVC is loaded once."""
    code, out, err = _done([*PYTHON, "-c", IN_TURN, json.dumps(commands), MARK])
    *found, rest = out.split(MARK)
    if code:
        raise PipelineError(f"dvc {commands[min(len(found), len(commands) - 1)][0]} failed: {_reason(err or rest)}")
    return found


def _done(command: Sequence[str], finish: bool = False) -> tuple[int, str, str]:
    """(exit status, standard output, standard error) of a command."""
    suit_history()
    own, pipe = os.getpid(), subprocess.PIPE

    def begin() -> None:
        end_with_parent(own)
        hear_no_interrupt()

    with subprocess.Popen(command, env=environment(), stdout=pipe, stderr=pipe, text=True, preexec_fn=begin) as process:
        try:
            out, err = process.communicate()
        except KeyboardInterrupt:
            if finish:
                process.communicate()
            else:
                process.kill()
            raise
    return process.returncode, out, err


def affected(graph: str, changed: Iterable[str], targets: Iterable[str] = ()) -> list[str]:
    """The stages ``changed`` and all that depend on them, of those that ``targets`` (none: everything) need.

    ``graph`` is what ``dvc dag --dot`` prints.
    """
    edges = DEPENDENCY.findall(graph)
    after, before = dict[str, list[str]](), dict[str, list[str]]()
    for earlier, later in edges:
        after.setdefault(earlier, []).append(later)
        before.setdefault(later, []).append(earlier)
    touched, asked = _reached(changed, after), list(targets)
    needed = _reached(asked, before) if asked else set(touched)
    return sorted(touched & needed)


def _reached(start: Iterable[str], edges: Mapping[str, list[str]]) -> set[str]:
    found, left = set[str](), list(start)
    while left:
        stage = left.pop()
        if stage not in found:
            found.add(stage)
            left += edges.get(stage, [])
    return found


def _reason(text: str) -> str:
    """Why DVC failed: what the stage said last, if one ran, or DVC's own last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    own = [line for line in lines if not line.startswith(OF_DVC)]
    return (own or lines or ["no output"])[-1]


# -------------------------------------------------------------- processes that do not outlive the one that started them
_SET_PARENT_DEATH_SIGNAL = 1  # prctl's PR_SET_PDEATHSIG


def end_with_parent(parent: int | None = None) -> None:
    """Have the system end this process (SIGTERM) when its parent ends; does nothing outside Linux.

    ``parent`` is the parent's process id where the caller knows it: a parent that has ended already
    sends no signal any more.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):  # a C library without prctl
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
    if parent is not None and os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGTERM)


def hear_no_interrupt() -> None:
    """Ignore Ctrl-C in this process and in whatever it starts: the one that started it ends them all, in order."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
