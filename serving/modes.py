"""The modes of a loop, how a fault changes them, the result of a scan, and the way of an MV to a law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf, isfinite, isnan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.endpoint import Endpoint, HandsBack
from loopwright.serving.errors import LoopError
from loopwright.serving.manifest import Signal
from loopwright.serving.ranges import within

# ------------------------------------------------------------------------------------------------- where a fault lasts
Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Fallback:
    """HOLD keeps the last MV; after ``after_s`` [s] of a fault in a row the loop does more than that.

    With ``mv`` (n_mv,) each MV moves there, by at most ``rate`` (n_mv,) [mv units/s] and its ``max_move``. With
    ``hand_back`` the command asks to hand the plant to its own controller; once that is done the loop writes no more
    (SHADOW).

    Raises LoopError for times or rates that are not above zero, and where both ways or none is asked for.
    """

    after_s: float
    mv: tuple[float, ...] | None = None
    rate: tuple[float, ...] | None = None
    hand_back: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.after_s < inf:
            raise LoopError(f"after_s is {self.after_s}; it must be a finite number of seconds, 0 or more")
        if self.hand_back == (self.mv is not None):
            raise LoopError("a fallback either goes to a safe MV or hands back")
        if (self.mv is None) != (self.rate is None):
            raise LoopError("a safe MV needs the rate at which the loop goes there, one a manipulated variable")
        for name, values in (("mv", self.mv), ("rate", self.rate)):
            if values is not None and not all(map(isfinite, values)):
                raise LoopError(f"{name} is {values}; it needs finite numbers")
        if self.rate is not None and not all(r > 0 for r in self.rate):
            raise LoopError(f"rate is {self.rate}; each must be above zero")

    def check(self, signals: Sequence[Signal], endpoint: Endpoint | None = None) -> None:
        """LoopError where the safe MV is none of these MVs, the rates are too few, or ``endpoint`` cannot hand back."""
        if self.hand_back and not isinstance(endpoint, HandsBack | None):
            raise LoopError(f"{type(endpoint).__name__} cannot hand the plant back: it has no method hand_back")
        if self.mv is None or self.rate is None:
            return
        within(self.mv, signals, "safe MV")
        if len(self.rate) != len(signals):
            raise LoopError(f"the fallback has {len(self.rate)} rates; it needs {len(signals)}, one an MV")

    def toward(self, mv: Array, signals: Sequence[Signal], period_s: float) -> Array:
        """The MV (n_mv,) one period nearer to the safe one; a discrete MV goes there at once."""
        if self.mv is None or self.rate is None:
            return mv
        most = np.array(
            [
                inf if s.values is not None else min(r * period_s, s.max_move or inf)
                for s, r in zip(signals, self.rate, strict=True)
            ]
        )
        move = np.array(self.mv) - mv
        near = np.abs(move) <= most
        return np.where(near, self.mv, np.clip(mv + np.clip(move, -most, most), *_ends(signals)))


def _ends(signals: Sequence[Signal]) -> tuple[Array, Array]:
    return np.array([s.low for s in signals]), np.array([s.high for s in signals])


# --------------------------------------------------------------------------------------------------------------- modes
class Mode(StrEnum):
    """The source of the MV: MANUAL the operator, AUTO the law, HOLD the last applied MV, SHADOW the plant's own side.

    In SHADOW nothing is written.
    """

    MANUAL = "MANUAL"
    AUTO = "AUTO"
    HOLD = "HOLD"
    SHADOW = "SHADOW"


def mode_of(mode: Mode | str) -> Mode:
    """``mode``, also given as its name; LoopError for anything else, as a loop in no mode would write the old MV."""
    try:
        return Mode(mode)
    except ValueError:
        raise LoopError(f"the mode is {mode!r}; it must be one of {', '.join(Mode)}") from None


class LoopMode:
    """The mode of a loop now, and the fault that changed it to HOLD.

    Somebody sets the mode, or a scan in AUTO without an MV of the law is a fault: HOLD. ``recover_after`` good samples
    change it back; None: only an operator does. A fault that lasts is for the ``fallback``. ``period_s`` [s] is the
    loop's. LoopError for a mode that is none, and for ``recover_after`` below 1.
    """

    def __init__(
        self, mode: Mode, period_s: float, recover_after: int | None = None, fallback: Fallback | None = None
    ) -> None:
        self.set(mode_of(mode))
        if recover_after is not None and recover_after < 1:
            raise LoopError(f"recover_after is {recover_after}; it must be at least 1, or None")
        self._period_s, self._recover_after, self._fallback = period_s, recover_after, fallback

    def set(self, mode: Mode) -> None:
        """Somebody sets the mode: a fault is over."""
        self.now, self.fault = mode, ""  # empty without a fault
        self._good = 0  # good samples in a row since it began
        self._held = 0  # scans since it began

    def lose(self, reason: str) -> None:
        """A scan gave no MV of the law: in AUTO a fault."""
        self._good = 0
        if self.now is Mode.AUTO or self.fault:
            self.now, self.fault = Mode.HOLD, reason

    def recovers(self) -> bool:
        """A good sample during a fault: whether it is the last of those that lead back to AUTO."""
        self._good += 1
        return self._recover_after is not None and self._good >= self._recover_after

    def hold(self) -> None:
        """Count a scan of a fault."""
        self._held += bool(self.fault)

    @property
    def overdue(self) -> bool:
        """Whether a fault has lasted so long that the fallback is due."""
        if not self.fault or self._fallback is None:
            return False
        return (self._held - 1) * self._period_s >= self._fallback.after_s

    @property
    def handing_back(self) -> bool:
        """Whether the plant is to be given to its own controller."""
        return self._fallback is not None and self._fallback.hand_back and self.overdue

    def safe(self, mv: Array, signals: Sequence[Signal]) -> Array:
        """The MV (n_mv,) one period nearer to where the fallback goes; as it is without one."""
        return mv if self._fallback is None else self._fallback.toward(mv, signals, self._period_s)


# ------------------------------------------------------------------------------------------------ the result of a scan


@dataclass(frozen=True, slots=True)
class Command:
    """The result of one scan. ``fault`` says why no MV of the law was used or written; it is empty without one.

    A host that runs the loop itself writes ``mv`` where ``writes`` is true: not in SHADOW, and not while ``mv`` is NaN
    because no sample has told yet where the MV stands. Where ``hand_back`` is true, it gives the plant back to the
    plant's own controller, and then sets the mode to SHADOW.

    ``bridged`` and ``shed`` have the PVs whose readings were bad while the law went on, each with the reason: the law
    predicts the first, and leaves the second alone (``loopwright.serving.bridging``). ``local`` has the MVs that the
    plant has itself, each with the reason: their ``mv`` follows where they stand (``loopwright.serving.mvs``).
    """

    scan: int
    mode: Mode
    sp: Array  # shape: (n_sp,)
    mv: Array  # shape: (n_mv,), to be written; NaN while it is not known where the MV stands
    law_mv: Array | None  # the law's MV, also in MANUAL; None if the law was not stepped or its step failed
    info: Array | None  # shape: (n_info,)
    fault: str = ""
    successor_mv: Array | None = None  # shape: (n_mv,), of a controller that is tried beside the law; else None
    hand_back: bool = False
    bridged: Mapping[str, str] = field(default_factory=dict)
    shed: Mapping[str, str] = field(default_factory=dict)
    local: Mapping[str, str] = field(default_factory=dict)

    @property
    def writes(self) -> bool:
        """Whether ``mv`` is to be written."""
        return self.mode is not Mode.SHADOW and not isnan(self.mv[0])  # all of it is known, or none


class Transfer:
    """Limits the first moves of a law that takes over: over ``transfer_s`` [s] an MV crosses its range at most once.

        mv(k) = mv_applied(k) + clip(law(k) - mv_applied(k), -d, d),    d = (high - low) period_s / transfer_s

    It ends once each MV is where the law wants it, at the latest after ``transfer_s``. A discrete MV has no way
    between its values and is not limited. A law that adds to the applied MV needs none of this; one that computes its
    MV afresh would bump the plant by whatever its model is wrong. LoopError for a time that cannot be.
    """

    def __init__(self, mv: Sequence[Signal], period_s: float, transfer_s: float) -> None:
        if not 0 <= transfer_s < inf:
            raise LoopError(f"transfer_s is {transfer_s}; it must be a finite number of seconds, 0 or more")
        self._scans = int(np.ceil(transfer_s / period_s))
        share = 1.0 if self._scans == 0 else period_s / transfer_s
        self._most = np.array([np.inf if s.values is not None else share * (s.high - s.low) for s in mv])
        self._left = 0

    def begin(self) -> None:
        """Limit from the next MV on."""
        self._left = self._scans

    def limited(self, law: Array, applied: Array) -> Array:
        """The MV to command, (n_mv,): between ``applied`` and ``law``, so it lies in the range as both do."""
        if not self._left:
            return law
        move = law - applied
        near = np.abs(move) <= self._most
        self._left = 0 if near.all() else self._left - 1
        ahead = applied + np.clip(move, -self._most, self._most)
        # A sum is rounded, and may leave the range by its last digit.
        return np.where(near, law, np.clip(ahead, np.minimum(law, applied), np.maximum(law, applied)))
