"""One instance of an FMU: FMI 2.0 and 3.0 under the same few calls, and every failure in one line."""

from __future__ import annotations

import contextlib
import os
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.fmu.description import Description, fmpy
from loopwright.pipeline.plants.simulator import Array

# What fmpy calls the same thing in FMI 2.0 and 3.0.
NAMES: dict[int, dict[str, str]] = {
    2: {
        "get": "getReal", "set": "setReal", "save": "getFMUstate", "restore": "setFMUstate", "free": "freeFMUstate",
        "write": "serializeFMUstate", "read": "deSerializeFMUstate",
    },
    3: {
        "get": "getFloat64", "set": "setFloat64", "save": "getFMUState", "restore": "setFMUState",
        "free": "freeFMUState", "write": "serializeFMUState", "read": "deserializeFMUState",
    },
}  # fmt: skip
WARNING = 1  # status of a message: those above it say why a call failed
BACK_LATER = False  # noSetFMUStatePriorToCurrentPoint: a test may go back to a state before this step
State = Any
"""A state inside the FMU's own memory."""


@final
class Instance:
    """An instance that is begun, stepped, and whose state can be saved where the FMU can do so.

    Raises PlantError for a library that cannot be loaded, and for every call that the FMU refuses, with what it said.
    """

    def __init__(self, of: Description, folder: Path) -> None:
        self._of, self._said = of, deque[str](maxlen=1)
        self._fresh = True
        self._fmu = self._try("it cannot be loaded", self._made, folder)
        self._end = weakref.finalize(self, _freed, self._fmu, os.getpid())

    def begin(self) -> None:
        """Go to the start, from wherever it is."""
        of, fmu = self._of, self._fmu
        if not self._fresh:
            self._try("reset", fmu.reset)
        self._fresh = False
        if of.version == 2:
            self._try("setupExperiment", fmu.setupExperiment, None, of.begins_s)
            self._try("enterInitializationMode", fmu.enterInitializationMode)
        else:
            self._try("enterInitializationMode", fmu.enterInitializationMode, None, of.begins_s)
        self._try("exitInitializationMode", fmu.exitInitializationMode)

    def get(self, references: Sequence[int]) -> Array:
        """The values of real variables, shape (n,)."""
        return np.array(self._call("get", list(references)), dtype=np.float64) if references else np.zeros(0)

    def step(self, references: Sequence[int], values: Array, after_s: float, length_s: float) -> None:
        """Set inputs (n,) and step on by ``length_s``, from ``after_s`` seconds after the start."""
        if references:
            self._call("set", list(references), values.tolist())
        now = self._of.begins_s + after_s
        what = f"doStep from {now:g} s on for {length_s:g} s"
        ended = self._try(what, self._fmu.doStep, now, length_s, BACK_LATER)
        if ended is not None and (ended[1] or ended[2]):
            raise PlantError(f"{self._of.path}: {what}: it {'ends the simulation' if ended[1] else 'returns early'}")

    # ------------------------------------------------------------------ states
    def save(self) -> State:
        """The state, which ``free`` gives back."""
        return self._call("save")

    def restore(self, state: State) -> None:
        """Go to a saved state."""
        self._call("restore", state)

    def free(self, state: State) -> None:
        """Give a saved state back."""
        self._call("free", state)

    def written(self) -> bytes:
        """The state as bytes, which any instance of the same FMU can read."""
        state = self.save()
        try:
            return bytes(self._call("write", state))
        finally:
            self.free(state)

    def read(self, content: bytes) -> None:
        """Go to a state that was written."""
        state = self._call("read", content)
        try:
            self.restore(state)
        finally:
            self.free(state)

    # ------------------------------------------------------------------ calls
    def _made(self, folder: Path) -> Any:
        said = self._said  # not self, which would then never be given up

        def hear(*message: Any) -> None:
            status, text = message[-3], message[-1]  # FMI 2.0 puts the instance's name before them
            if status > WARNING and text:
                said.append(" ".join(text.decode("utf-8", "replace").split()))

        # fmpy goes to the library's folder to load it, and stays there where that fails.
        with contextlib.chdir(Path.cwd()):
            return fmpy().instantiate_fmu(str(folder), self._of.model, "CoSimulation", logger=hear)

    def _call(self, name: str, *arguments: Any) -> Any:
        called = NAMES[self._of.version][name]
        return self._try(called, getattr(self._fmu, called), *arguments)

    def _try(self, what: str, call: Callable[..., Any], *arguments: Any) -> Any:
        self._said.clear()
        try:
            return call(*arguments)
        except Exception as error:
            says = f"; it says: {self._said[-1]}" if self._said else ""
            words = " ".join(str(error).split()) or type(error).__name__
            raise PlantError(f"{self._of.path}: {what}: {words}{says}") from None


def _freed(fmu: Any, owner: int) -> None:
    if os.getpid() == owner:  # a fork's copy goes with the fork
        fmu.freeInstance()
