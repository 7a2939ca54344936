"""DVC as this program starts it: with this Python, and deaf to a Ctrl-C that is for the program itself."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from pipeline.engine.lifeline import end_with_parent, hear_no_interrupt
from pipeline.errors import PipelineError

COMMAND = (sys.executable, "-m", "dvc")
DEPENDENCY = re.compile(r'"([^"]+)" -> "([^"]+)";')  # of a line of `dvc dag --dot`
OF_DVC = ("ERROR:", "WARNING:", "Stage '", "Running stage '", "> ")  # beginnings of its own lines


def environment() -> dict[str, str]:
    """The environment of this process, in which ``python`` is this Python.

    The commands of dvc.yaml begin with ``python``: without an activated environment that is another one, which has
    none of our packages. The folder stays as it is named: behind the link lies the Python without the packages.
    """
    own, path = str(Path(sys.executable).parent), os.environ.get("PATH")
    return {**os.environ, "PATH": own if not path else f"{own}{os.pathsep}{path}"}


def ask(*arguments: str, finish: bool = False) -> str:
    """What ``dvc ARGUMENT...`` prints; PipelineError with the line that says why it failed.

    A Ctrl-C ends DVC at once; with ``finish`` DVC ends its work first, because it writes dvc.lock.
    """
    own, pipe = os.getpid(), subprocess.PIPE

    def begin() -> None:
        end_with_parent(own)
        hear_no_interrupt()

    with subprocess.Popen(
        [*COMMAND, *arguments], env=environment(), stdout=pipe, stderr=pipe, text=True, preexec_fn=begin
    ) as process:
        try:
            out, err = process.communicate()
        except KeyboardInterrupt:
            if finish:
                process.communicate()
            else:
                process.kill()
            raise
    if process.returncode:
        raise PipelineError(f"dvc {arguments[0]} failed: {_reason(err or out)}")
    return out


def affected(changed: Iterable[str], targets: Iterable[str] = ()) -> list[str]:
    """The stages ``changed`` and all that depend on them, of those that ``targets`` (none: everything) need."""
    edges = DEPENDENCY.findall(ask("dag", "--dot"))
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
