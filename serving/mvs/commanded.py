"""The MV that a loop commands: where it stands by the plant, and where an operator sends it."""

from __future__ import annotations

from math import isnan, nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.guard import Sample, reworded
from loopwright.serving.manifest import Signal
from loopwright.serving.modes import LoopMode, Mode
from loopwright.serving.mv_readback import AppliedMV, ShownMV
from loopwright.serving.mvs.in_hand import Those
from loopwright.serving.mvs.out_of_use import OutOfUse

Array: TypeAlias = NDArray[np.float64]


class CommandedMV:
    """The last command of all MVs, which follows the plant where others have moved them.

    Every written MV lies in its range, in every mode and with any guards; a discrete MV has one of its values. An MV
    moves by at most its ``max_move`` a period: a law that gives more has a fault, the fallback and an operator's MV
    (``send``) go on scan by scan. A read-back may exceed the range by ``guard.READ_BACK_MARGIN`` times the range: it
    is clipped to the range, for the law and for HOLD. A larger excess is a fault. After a command that did not reach
    the plant (``unwritten``), and after others had the MV in a shadow, HOLD, MANUAL and the fallback go on from where
    it stands, see ``loopwright.serving.mv_readback.AppliedMV``.

    Parameters
    ----------
    signals
        The MVs of the loop.
    mv
        Where they stand at the beginning (n_mv,), NaN where that is not known.
    out
        Those that the law does not have.

    Notes
    -----
    ``now`` (n_mv,) is the last command, NaN while it is not known where the MVs stand. ``found`` (n_mv,) is where they
    stand, at the scan that learns it after a command that did not arrive.
    """

    def __init__(self, signals: tuple[Signal, ...], mv: Array, out: OutOfUse) -> None:
        self.now, self.out = mv, out
        self.found: Array | None = None
        self._stood: Array | None = None  # shape: (n_mv,), the same, and where others had moved it until now
        self._hand = False  # the last command is an operator's, in MANUAL then and ever since
        self._plant = AppliedMV(signals, mv)

    @property
    def known(self) -> bool:
        """Whether it is known where the MVs stand."""
        return not isnan(self.now[0])

    @property
    def goal(self) -> Array:
        """Where they go by hand (n_mv,); the last command where they are there."""
        return self.out.hand.goal(self.now)

    @property
    def lost(self) -> bool:
        """Whether the last command did not arrive, and no read-back has come since."""
        return self._plant.lost

    @property
    def untold(self) -> bool:
        """Whether no read-back has told where they stand since a command was lost, or since others had them."""
        return self._plant.lost or self._plant.taken

    # ------------------------------------------------------------------ operators
    def begun(self, mode: Mode, before: Mode, in_hand: Those) -> None:
        """Somebody changes the mode ``before``; MVs ``in_hand`` (n_mv,) stay so."""
        self.out.begun(mode, in_hand)
        self._hand = False
        self._plant.take(mode is not Mode.SHADOW and (self._plant.taken or before is Mode.SHADOW))

    def send(self, wanted: Array, signals: tuple[Signal, ...], taken: Those, mode: Mode) -> None:
        """Begin the way to ``wanted`` (n_mv,), of those ``taken`` (n_mv,) out of use with it from the next scan on."""
        self._hand = self._hand or mode is Mode.MANUAL
        self.now = self.out.hand.sent(self.now, wanted, signals, taken, untold=self._plant.taken)

    def require_arrived(self) -> None:
        """LoopError while the last command is lost."""
        if self.lost:
            raise LoopError("the last MV did not reach the plant, so where the MV stands is not known; wait")

    def move_by_hand(self, signals: tuple[Signal, ...]) -> None:
        """One period nearer to where an operator sent them; they wait for where they stand if a sample may tell it."""
        if self.known or not self._plant.is_read:
            self.now = self.out.hand.toward(self.now, signals)

    # ------------------------------------------------------------------ the plant
    def look(self, sample: Sample, reason: str, mode: Mode, in_hand: Those) -> ShownMV:
        """The MVs by a sample that is refused for the ``reason``, if any; the command follows what they show."""
        self._plant.arrived()
        taken = self._plant.taken
        shown = self._plant.look(sample, self.now, refused=bool(reason), theirs=self.out.local.away)
        self.found = self._stood = shown.found
        blind = self.out.hand.wanted is not None and not self.known  # on a way by hand from nobody knows where
        if shown.applied is not None and (taken or blind):
            self.now = self._stood = shown.applied.copy()
        if shown.bad and (shown.silent or blind):
            self.out.hand.wanted = None  # the way by hand would begin nobody knows where
        if shown.outside or shown.forgotten:
            self.now = self._stood = np.full(len(self.now), nan)
        if shown.silent:
            doubled = not reason or shown.silent.startswith(reason)
            return shown if doubled else shown._replace(silent=reworded(reason, f"{reason}; {shown.silent}"))
        if self.found is not None:
            self.now, self.out.hand.wanted = self.found.copy(), None
        self._follow(shown.applied, mode, in_hand)
        return shown

    def unread(self, mode: Mode, in_hand: Those) -> str:
        """A scan without a sample: why nothing may be written; empty: it may."""
        self._plant.arrived()
        self.found = self._stood = None
        silent = self._plant.unread().silent
        if not silent:
            self._follow(None, mode, in_hand)
        return silent

    def _follow(self, applied: Array | None, mode: Mode, in_hand: Those) -> None:
        self.now = self.out.follow(self.now, applied, self._plant, mode, in_hand)

    def begins(self, applied: Array | None) -> Array:
        """Where the MVs stand (n_mv,) at a scan: ``applied``, as read back, else the command or where they go."""
        if applied is None and not self.known:
            self.now = self.goal  # nobody but the operator says where it stands
        return self.now if applied is None else applied

    def read_back(self, sample: Sample, applied: Array | None) -> Array:
        """The same as the law gets it; SampleError where nothing tells where the MVs stand."""
        stands = self._plant.read_back(sample, self.now) if applied is None else applied
        if not self.known:
            self.now = stands.copy()
        return stands

    # ------------------------------------------------------------------ the command
    def fall_back(self, mode: LoopMode, signals: tuple[Signal, ...], *, moves: bool = True) -> None:
        """Count a scan of a fault, and go where the fallback says once it has lasted."""
        mode.hold()
        if moves and mode.overdue:
            self.now = self.out.without(self.now, mode.safe(self.now, signals))

    def given(self, mode: Mode, *, written: bool) -> None:
        """A scan ends with the command of ``now``, ``written`` to the plant or not."""
        self._hand = mode is Mode.MANUAL
        self._plant.command(self.now, written=written)
        self.out.local.commanded(self.now, written=written)

    def unwritten(self, before: Array, signals: tuple[Signal, ...]) -> None:
        """The last command did not reach the plant: the MVs stay where they were ``before`` it, or were found.

        Those that an operator sent somewhere go there from where they stand.
        """
        stands = np.array(before if self._stood is None else self._stood, dtype=np.float64)
        self.now = self.out.hand.sent(stands, self.goal, signals) if self._hand else stands
        self._plant.lose()
