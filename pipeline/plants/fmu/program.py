"""An FMU as the program of a plant: the table's variables, one communication step a period."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import final

import numpy as np

from loopwright.pipeline.errors import PlantError, nearest
from loopwright.pipeline.plants.fmu.description import Description, FmuTable, FmuVariable, described, fmpy
from loopwright.pipeline.plants.fmu.instance import Instance, memory_of
from loopwright.pipeline.plants.program import Interface
from loopwright.pipeline.plants.simulator import Array

try:
    import fcntl
except ImportError:  # Windows: what a killed process leaves stays there
    fcntl = None  # type: ignore[assignment]

PREFIX, LOCK = "loopwright-fmu-", "in-use.lock"


@final
class UnpackedFmu:
    """An FMU unpacked: its libraries for this machine and its resources.

    An FMU without resources needs its folder no more once it is loaded (``loaded``). Else the folder goes with this
    object. A worker process may be ended without a word, so a lock, which ends with its process and the forks of it,
    marks each folder that is in use; the next one to unpack an FMU removes those that nobody holds.
    """

    def __init__(self, of: Description) -> None:
        _sweep()
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
        self._finalizer = weakref.finalize(self, _remove, self.path, _locked(self.path), os.getpid())
        platforms = {fmpy().platform, fmpy().platform_tuple}

        def needed(name: str) -> bool:
            parts = name.split("/")
            return parts[0] not in {"documentation", "sources"} and (
                parts[0] != "binaries" or len(parts) < 2 or parts[1] in platforms
            )

        try:
            fmpy().extract(str(of.path), str(self.path), needed)
        except Exception as error:
            self._finalizer()
            raise PlantError(f"{of.path} cannot be unpacked: {' '.join(str(error).split())}") from None

    def loaded(self) -> None:
        """Remove the folder, if the FMU has no files to read later."""
        resources = self.path / "resources"
        if not (resources.is_dir() and any(resources.iterdir())):
            self._finalizer()


def _remove(path: Path, lock: int | None, owner: int) -> None:
    if os.getpid() == owner:  # and not a fork of it
        shutil.rmtree(path, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _locked(folder: Path) -> int | None:
    """A file of the folder, locked until this process and its forks have ended; None where there are no such locks."""
    if fcntl is None:
        return None
    draft = folder / f"{LOCK}.new"
    file = os.open(draft, os.O_CREAT | os.O_RDWR, 0o600)
    fcntl.flock(file, fcntl.LOCK_EX)
    draft.rename(folder / LOCK)  # locked from the moment that it has this name
    return file


def _sweep() -> None:
    """Remove the folders whose process has ended."""
    if fcntl is None:
        return
    for lock in Path(tempfile.gettempdir()).glob(f"{PREFIX}*/{LOCK}"):
        with _free(lock) as free:
            if free:
                shutil.rmtree(lock.parent, ignore_errors=True)


@contextlib.contextmanager
def _free(lock: Path) -> Iterator[bool]:
    try:
        file = os.open(lock, os.O_RDWR)
    except OSError:
        yield False  # another one was faster, or it is another person's
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield True
    except OSError:
        yield False
    finally:
        os.close(file)


# --------------------------------------------------------------------------------------------------------- the program
PERIODS = 1  # numbers of a state between the PVs and the FMU's own: the periods since the start


@final
class FmuFile:
    """An FMU with the table of its signals.

    A state is (PVs (n_pv,), periods since the start, the FMU's own state as ``memory`` writes it). MVs and
    measured disturbances begin with the start values of the inputs.

    Raises PlantError for what ``described`` refuses, a variable that the FMU does not have or that cannot take its
    role, and every call that fails.
    """

    def __init__(self, path: Path, table: FmuTable) -> None:
        self.path = path
        self._of = described(path)
        pv, mv, dv = ([variable_of(self._of, r.variable, role) for r in table.of(role)]
                                  for role in ("pv", "mv", "dv"))  # fmt: skip
        self._outputs = [v.reference for v in pv]
        self._inputs = [v.reference for v in (*mv, *dv)]
        self._n_mv, self._rest = len(mv), table.rest_periods
        groups = {role: tuple(r.signal for r in table.of(role)) for role in ("pv", "mv", "dv")}
        self.interface = Interface(table.step_s, groups["pv"], groups["mv"], groups["dv"], strides=self._of.any_step)
        self._folder = UnpackedFmu(self._of)
        play = partial(_play, self._inputs, table.step_s)  # not a method: the FMU ends with the last reference to it
        self._memory = memory_of(self._of, self._folder.path, play)
        self._folder.loaded()

    def start(self) -> tuple[Array, Array, Array]:
        """The FMU after its initialization, and ``rest_periods`` more, and its inputs there."""
        instance, state = self._memory.start()
        mv, dv = np.split(instance.get(self._inputs), [self._n_mv])
        x = self._state(instance, 0.0, state)
        return self.step(x, mv, dv, self._rest) if self._rest else x, mv, dv

    def step(self, x: Array, mv: Array, dv: Array, periods: int) -> Array:
        """One communication step of all the periods, where the FMU takes steps of any length; else one a period."""
        n = len(self._outputs)
        done = float(x[n])
        steps = 1 if self._of.any_step else periods
        move = np.concatenate([mv, dv, [done, periods / steps, steps]]).astype(np.float64)
        instance, state = self._memory.step(x[n + PERIODS :], move.tobytes())
        return self._state(instance, done + periods, state)

    def measure(self, x: Array) -> Array:
        """The variables of the PVs, as they were when the state was reached."""
        return x[: len(self._outputs)].copy()

    def compared(self, x: Array) -> Array:
        """The PVs: an FMU's own state may hold addresses, which are not the same twice."""
        return x[: len(self._outputs)]

    def wrong(self, words: str) -> PlantError:
        """The words after the FMU's name, and where its signals are named."""
        return PlantError(
            f"{self.path}: {words}; name variables and ranges by --mv, --pv, --dv or in the table of --tags"
        )

    def _state(self, instance: Instance, periods: float, state: Array) -> Array:
        return np.concatenate([instance.get(self._outputs), [periods], state])


def variable_of(of: Description, name: str, role: str) -> FmuVariable:
    """The variable of a role; PlantError where there is none of that name, or it cannot take the role."""
    if name not in of.variables:
        if name in of.others:
            raise PlantError(f"{of.path}: {name!r} is of type {of.others[name]}; a scalar real variable is wanted")
        known = [v.name for v in of.variables.values() if v.causality in {"input", "output"}]
        raise PlantError(f"{of.path}: it has no variable {name!r}{nearest(name, known)}")
    found = of.variables[name]
    if role != "pv" and found.causality != "input":
        inputs = ", ".join(v.name for v in of.variables.values() if v.causality == "input") or "none"
        raise PlantError(
            f"{of.path}: {name!r} is no input but {found.causality}, so it cannot be of role {role}; its inputs are "
            f"{inputs}"
        )
    return found


def _play(references: list[int], step_s: float, instance: Instance, move: bytes) -> None:
    *_, done, length, steps = numbers = np.frombuffer(move)
    for k in range(int(steps)):
        instance.step(references, numbers[:-3], (done + k * length) * step_s, length * step_s)
