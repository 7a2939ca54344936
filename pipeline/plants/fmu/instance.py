"""An FMU: its instances, set, stepped and read, and their states as vectors, so that a test can go on from any."""

from __future__ import annotations

import contextlib
import hashlib
import os
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, final

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

    def begin(self, true: Sequence[int] = ()) -> None:
        """Go to the start, from wherever it is, with these Boolean parameters true."""
        of, fmu = self._of, self._fmu
        if not self._fresh:
            self._try("reset", fmu.reset)
        self._fresh = False
        if true:
            self._try("setBoolean", fmu.setBoolean, list(true), [True] * len(true))
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


LARGEST_FMU_STATE = 1 << 16  # bytes of a state that every row of a simulation holds a copy of
SPARE = 16  # words, and an eighth of the state: some states grow with what they remember
INSTANCES = 4  # of an FMU whose states are reached by replaying: so many branches are near at hand
KEPT_STATES = 16  # states inside the FMU's memory
DIGEST = 12  # bytes of a digest of the past: two numbers of 48 bits, which a float64 holds exactly
ROOT = bytes(DIGEST)

Play = Callable[[Instance, bytes], None]
"""Does a move on an instance: sets its inputs and steps it on, as the move's bytes say."""


class FmuMemory(Protocol):
    """Instances of an FMU, and how a vector (n,) of finite numbers names a state of theirs."""

    def start(self) -> tuple[Instance, Array]:
        """An instance at the start, and that state."""

    def step(self, state: Array, move: bytes) -> tuple[Instance, Array]:
        """An instance after a move from a state, and its state."""


def memory_of(of: Description, folder: Path, play: Play) -> FmuMemory:
    """States as bytes where the FMU writes them and they are not too large; else by replaying what led to them."""
    first = Instance(of, folder)
    first.begin()
    if of.writes_states and len(first.written()) <= LARGEST_FMU_STATE:
        return Written(of, first, play)
    more = [] if of.single or of.keeps_states else [Instance(of, folder) for _ in range(INSTANCES - 1)]
    return Replayed(of, [first, *more], play)


@final
class Written:
    """The state's own bytes as words of 32 bits, after their number; one instance goes from state to state."""

    def __init__(self, of: Description, instance: Instance, play: Play) -> None:
        self._path, self._instance, self._play = of.path, instance, play
        n = len(instance.written())
        self._words = -(-(n + n // 8) // 4) + SPARE
        self._at = np.zeros(0)

    def start(self) -> tuple[Instance, Array]:
        """Begun anew."""
        self._instance.begin()
        return self._instance, self._state()

    def step(self, state: Array, move: bytes) -> tuple[Instance, Array]:
        """PlantError where the state has grown beyond its vector."""
        if not np.array_equal(state, self._at):
            if not self._at.size:  # after a failure
                self._instance.begin()
            self._instance.read(state[1:].astype("<u4").tobytes()[: int(state[0])])
        self._at = np.zeros(0)
        self._play(self._instance, move)
        return self._instance, self._state()

    def _state(self) -> Array:
        content = self._instance.written()
        if len(content) > 4 * self._words:
            raise PlantError(
                f"{self._path}: its state has grown to {len(content)} bytes, beyond the {4 * self._words} that were "
                "made ready at the start; export the FMU without saved states, and they are replayed"
            )
        words = np.frombuffer(content.ljust(4 * self._words, b"\0"), dtype="<u4")
        self._at = np.concatenate([[len(content)], words.astype(np.float64)])
        return self._at.copy()


@final
class Replayed:
    """A digest of all moves since the start; the FMU goes there from the nearest state before that is at hand.

    At hand are the start, the state that each instance is in, and, where the FMU keeps states in its own memory, the
    last KEPT_STATES that were replayed: a state that tests went on from twice is one that more will go on from. A state
    is known in the process that made it, and the start in every one.
    """

    def __init__(self, of: Description, instances: Sequence[Instance], play: Play) -> None:
        self._path, self._keeps, self._play = of.path, of.keeps_states, play
        self._past: dict[bytes, bytes] = {}  # a state -> the one before, and the move from there
        self._unused = list(instances)
        self._places: OrderedDict[bytes, Instance] = OrderedDict()  # the least recently used first
        self._kept: OrderedDict[bytes, State] = OrderedDict()

    def start(self) -> tuple[Instance, Array]:
        """Begun anew."""
        instance = self._begun()
        self._places[ROOT] = instance
        return instance, _numbers(ROOT)

    def step(self, state: Array, move: bytes) -> tuple[Instance, Array]:
        """PlantError for a state that another process made."""
        here = state.astype("<u8").view(np.uint8).reshape(2, 8)[:, :6].tobytes()
        instance = self._brought(here)
        self._moved(instance, move)
        after = hashlib.blake2b(here + move, digest_size=DIGEST).digest()
        self._past[after] = here + move
        if after in self._places:
            self._unused.append(self._places.pop(after))
        self._places[after] = instance
        return instance, _numbers(after)

    def _brought(self, to: bytes) -> Instance:
        """An instance in a state; it leaves its place."""
        moves, at = [], to
        while at != ROOT and at not in self._places and at not in self._kept:
            if at not in self._past:
                raise PlantError(f"{self._path} cannot save its states, so a test can go on only where it began")
            before = self._past[at]
            at = before[:DIGEST]
            moves.append(before[DIGEST:])
        if at in self._places:
            instance = self._places.pop(at)
        elif at in self._kept:
            instance = self._free()
            instance.restore(self._kept[at])
            self._kept.move_to_end(at)
        else:
            instance = self._begun()
        for move in reversed(moves):
            self._moved(instance, move)
        if self._keeps and moves:
            self._kept[to] = instance.save()
            if len(self._kept) > KEPT_STATES:
                instance.free(self._kept.popitem(last=False)[1])
        return instance

    def _moved(self, instance: Instance, move: bytes) -> None:
        try:
            self._play(instance, move)
        except PlantError:
            self._unused.append(instance)  # in no known state
            raise

    def _begun(self) -> Instance:
        instance = self._free()
        instance.begin()
        return instance

    def _free(self) -> Instance:
        """An instance that nobody needs where it is: it may be in any state, but in none that failed."""
        if not self._unused:
            return self._places.popitem(last=False)[1]
        instance = self._unused.pop()
        instance.begin()
        return instance


def _numbers(digest: bytes) -> Array:
    """The digest as two numbers of 48 bits, shape (2,)."""
    return np.array([int.from_bytes(digest[k : k + 6], "little") for k in (0, 6)], dtype=np.float64)
