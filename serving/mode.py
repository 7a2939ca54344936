"""The modes of a loop, and how a fault changes them."""

from __future__ import annotations

from enum import StrEnum

from loopwright.serving.errors import LoopError
from loopwright.serving.fallback import Fallback


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

    Somebody sets the mode, or a scan in AUTO without an MV of the law is a fault: HOLD. So many good samples change it
    back. A fault that lasts is for the fallback.
    """

    def __init__(self, mode: Mode) -> None:
        self.set(mode)

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

    def recovers(self, after: int | None) -> bool:
        """A good sample during a fault: whether it is the last of the ``after`` that lead back to AUTO; None: none."""
        self._good += 1
        return after is not None and self._good >= after

    def hold(self) -> None:
        """Count a scan of a fault."""
        self._held += bool(self.fault)

    def overdue(self, fallback: Fallback | None, period_s: float) -> bool:
        """Whether a fault has lasted so long that ``fallback`` is due."""
        if not self.fault or fallback is None:
            return False
        return (self._held - 1) * period_s >= fallback.after_s

    def handing_back(self, fallback: Fallback | None, period_s: float) -> bool:
        """Whether the plant is to be given to its own controller."""
        return fallback is not None and fallback.hand_back and self.overdue(fallback, period_s)
