"""The first steps of a controller's file in a process of their own, which may die.

A file can pass every check of its bytes and still end the process that computes it: a fault of onnxruntime, a library
that lacks an instruction of this processor. A process that writes to a plant loads a file only after another one has
taken its first steps with these very bytes.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from itertools import product
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from loopwright.serving import controller, trust
from loopwright.serving.errors import ArtifactError, LoopwrightError, OutputError
from loopwright.serving.manifest import Manifest
from loopwright.serving.words import first_line, plain

if TYPE_CHECKING:
    from loopwright.serving.signing.verify import Trusted

PARENTS = Path(__file__).absolute().parents
# The place of the folder loopwright, where one holds this package: beside a checkout of another name lies anything.
HOME = PARENTS[2] if PARENTS[1].name == "loopwright" else None


def module(name: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """The command that runs a module with arguments, and its environment: it finds what this process finds."""
    home = [] if HOME is None else [str(HOME)]
    places = dict.fromkeys([*filter(None, sys.path), *home])  # an empty one is the current folder
    command = [sys.executable, "-P", "-m", name, *arguments]
    return command, {**os.environ, "PYTHONPATH": os.pathsep.join(places)}


# --------------------------------------------------------------------------------------------------------- first steps
DEADLINE_S = 30.0  # of the whole process; it takes .3 s, and a step at most 2 s
CHAINED = 3  # steps from a state of zeros at each set of inputs
REFUSED = 2  # exit status of a process whose file is refused
NICENESS = 10  # the loop that runs beside it goes first


def tried(path: str | PathLike[str], sha256: str | None = None, trusted: Trusted | None = None) -> trust.Controller:
    """The controller in a file, once another process has taken its first steps.

    The arguments and errors are those of ``loopwright.serving.trust.Controller``. ArtifactError too where the file ends
    that process, does not let it end within 30 s, or onnxruntime cannot compute it. The bytes that were tried are those
    that are loaded: their digest is pinned.
    """
    if trusted is not None:  # nothing of a file that nobody signed is run
        from loopwright.serving.signing.verify import verified  # here: it needs the package cryptography

        signed = verified(path, trusted).sha256
        sha256 = signed if sha256 is None else sha256
    return trust.Controller(path, _digest_tried(path, sha256), trusted)


def _digest_tried(path: str | PathLike[str], sha256: str | None) -> str:
    """The SHA-256 of the bytes whose first steps another process has survived."""
    command, environment = module(
        "loopwright.serving.first_steps", os.fspath(path), *([] if sha256 is None else [sha256])
    )
    try:
        done = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=DEADLINE_S,
        )
    except subprocess.TimeoutExpired:
        raise ArtifactError(
            f"{path}: its first steps, tried in a process of their own, do not end within {DEADLINE_S:g} s"
        ) from None
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        raise ArtifactError(f"{path}: no process can be started that tries its first steps: {error}") from None
    last = _last_line(done.stderr)
    if done.returncode == REFUSED:
        raise ArtifactError(last)
    if done.returncode > 0:
        raise ArtifactError(
            f"{path}: the process that should try its first steps failed (status {done.returncode}: "
            f"{last or 'it said nothing'}); nobody has tried the file, so it is not loaded"
        )
    if done.returncode:
        raise ArtifactError(
            f"{path}: it ended the process that tried its first steps ({_ending(done.returncode)}); "
            "it would end the loop's too, so it is not loaded"
        )
    return _last_line(done.stdout)  # libraries may have said something before


def _last_line(said: str) -> str:
    return plain((said.strip().splitlines() or [""])[-1])


def _ending(status: int) -> str:
    with suppress(ValueError):
        return signal.Signals(-status).name
    return f"signal {-status}"


def take(loaded: controller.Controller) -> None:
    """The first steps: the middle of every range, then both ends of each kind of input, a few in a row from no past.

    A law that reads ``operate`` and ``fresh`` is also stepped with all its entries low, all high, and nothing fresh;
    one that reads ``ahead`` with all that is to come low, and high.

    Raises ArtifactError where onnxruntime cannot compute one, or where no step at all gives an MV. A law may refuse
    some of these inputs: in a loop that is a fault, which no process dies of.
    """
    given, refused = 0, ""
    for inputs in _inputs(loaded.manifest):
        state = loaded.cold_state()
        for _ in range(CHAINED):
            try:
                state = loaded.step(**inputs, state=state).state
                given += 1
            except OutputError as error:
                if error.__cause__ is not None:
                    raise ArtifactError(f"{loaded.path}: {first_line(error)}") from error
                refused = refused or first_line(error)
                break
    if not given:
        raise ArtifactError(f"{loaded.path}: none of its first steps gives an MV: {refused}")


def _inputs(m: Manifest) -> Iterator[dict[str, np.ndarray]]:
    names = ("sp", "pv", "dv", "mv_applied")
    yield {name: np.array([s.middle for s in m.signals(name)], dtype=np.float64) for name in names}
    for ends in product((False, True), repeat=len(names)):
        yield {
            name: np.array([s.high if end else s.low for s in m.signals(name)], dtype=np.float64)
            for name, end in zip(names, ends, strict=True)
        }
    middle = {name: np.array(m.usual(name)) for name in names}
    if "operate" in m.inputs:  # both ends of a range are then one value, which is allowed
        for end in ("low", "high"):
            yield middle | {"operate": np.array([getattr(entry, end) for entry in m.operate])}
    if "fresh" in m.inputs:
        yield middle | {"fresh": np.zeros(len(m.pv))}
    if "ahead" in m.inputs and m.ahead is not None:
        present = np.array([(s.low + s.high) / 2 for s in m.ahead.signals])
        for end in ("low", "high"):
            there = np.array([getattr(s, end) for s in m.ahead.signals])
            known = np.tile(there - present, m.ahead.horizon)
            yield middle | {"sp": present[: len(m.sp)], "dv": present[len(m.sp) :], "ahead": known}


def main(path: str, sha256: str | None = None) -> int:
    """Take the first steps of a file and say its SHA-256; the exit status."""
    with suppress(OSError):
        os.nice(NICENESS)
    try:
        loaded = controller.Controller(path, sha256)
        take(loaded)
    except LoopwrightError as error:
        print(first_line(error), file=sys.stderr)
        return REFUSED
    print(loaded.sha256)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
