"""The locks of the MVs while a loop runs: had while it writes, with an alarm where another loop has one."""

from __future__ import annotations

import threading
from contextlib import suppress

from loopwright.serving.errors import LoopError
from loopwright.serving.loop import ControlLoop, Mode
from loopwright.serving.opcua.nameplates import Identity
from loopwright.serving.station.lease import Lease
from loopwright.serving.station.recorder import Recorder

ALARM = "lease"


class Locks:
    """Claims the nodes for the loop that writes, and owns the alarm that another loop has one.

    A shadow leaves them to the loop that writes: once the server has started anew, all must lock its nodes anew.
    """

    def __init__(self, lease: Lease, recorder: Recorder) -> None:
        self._lease, self._recorder = lease, recorder
        self._found: Identity | None = None  # the server of the last connection
        self._claimed: Identity | None = None  # as whose the nodes are claimed now; None: they are not
        self._untended = ""  # what keeps the files from being looked after, other than another loop
        self._told, self._telling = "", threading.Lock()  # the alarm as it stands in the journal

    def identified(self, found: Identity, *, writes: bool) -> None:
        """The server is known: a loop that ``writes`` claims its nodes before anything can be written there."""
        self._found = found
        if writes:
            self._claim(found)

    def keep(self, loop: ControlLoop) -> None:
        """Have the nodes while the loop writes. It goes to SHADOW while another loop has one, whoever asks for what."""
        if loop.mode is Mode.SHADOW:
            self._claimed = None
            self._lease.disclaim()
            return
        if self._claimed is not self._found and self._found is not None:
            self._claim(self._found)
        if self._lease.lost:
            with suppress(LoopError, OSError):
                self._lease.tend()  # the other loop may have ended since, or only have looked whether it is free
        self._tell()
        if self._lease.lost:
            words = f"mode {loop.mode} -> {Mode.SHADOW}"
            self._recorder.note("change", "loop", words, self._lease.lost, mode=Mode.SHADOW)
            loop.set_mode(Mode.SHADOW)

    def tend(self) -> None:
        """Keep the files; OSError where they cannot be kept."""
        try:
            with suppress(LoopError):  # ``lost`` says so
                self._lease.tend()
        finally:
            self._tell()

    def untended(self, trouble: str) -> None:
        """The obstacle to looking after the loop's files; empty without one."""
        self._untended = trouble
        self._tell()

    def _claim(self, found: Identity) -> None:
        self._claimed = found
        self._lease.claim(found.writes, found.nodes)

    def _tell(self) -> None:
        """Begin or end the alarm, whoever has found out: it tells what holds now, and nothing twice."""
        with self._telling:
            trouble = self._lease.lost or self._untended
            if trouble != self._told:
                self._told = trouble
                what = trouble or "over: the locks of this loop are kept again"
                self._recorder.note("fault", "loop", what, alarm=ALARM, raised=bool(trouble))
