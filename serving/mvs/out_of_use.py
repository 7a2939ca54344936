"""The MVs that a law does not have: an operator moves them by hand, or the plant has them itself."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from math import isnan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.guard import Sample
from loopwright.serving.manifest import Signal
from loopwright.serving.modes import Mode
from loopwright.serving.mv_readback import AppliedMV
from loopwright.serving.mvs.in_hand import ByHand, MvEntries, Those
from loopwright.serving.mvs.local_mvs import LocalMvs

Array: TypeAlias = NDArray[np.float64]


class OutOfUse:
    """Commands the MVs that the law in charge does not have.

    One in hand (its ``use`` is 0) stays where it is until its operator moves it. One that the plant has follows its
    read-back, so that nothing moves when the plant gives it back; without a sound read-back it keeps its command.

    Parameters
    ----------
    signals, period_s, local_s
        See ``LocalMvs``.
    """

    def __init__(self, signals: Sequence[Signal], period_s: float, local_s: float | None) -> None:
        self._signals = tuple(signals)
        self.hand = ByHand()
        self.local = LocalMvs(signals, period_s, local_s)
        self.those: Those = np.zeros(len(signals), dtype=bool)  # shape: (n_mv,), at the last sample

    def look(self, sample: Sample, entries: MvEntries, *, lost: bool) -> Sample:
        """The sample as a law with these ``entries`` may have it; see ``LocalMvs.look``."""
        return self.local.look(sample, entries.able, lost=lost)

    def begun(self, mode: Mode, in_hand: Those) -> None:
        """Somebody changes the mode: the way of an MV by hand goes on where it stays in hand (n_mv,)."""
        self.hand.keep(in_hand & (mode is not Mode.SHADOW))
        self.local.trust()

    def operated(self, values: Mapping[str, float]) -> None:
        """Somebody sets values of ``operate``: an MV that is taken in use is believed to follow its commands again."""
        self.local.trust(
            [name.removesuffix(".use") for name, value in values.items() if value and name.endswith(".use")]
        )

    def require(
        self, names: Collection[str], mode: Mode, entries: MvEntries, operate: Array, take: Collection[str] = ()
    ) -> None:
        """LoopError where an operator cannot move one of these MVs now, see ``ControlLoop.require_in_hand``."""
        free = mode in {Mode.AUTO, Mode.HOLD} and bool(entries.able.any())
        if not free and mode is not Mode.MANUAL:
            raise LoopError(f"the MV is set by hand in MANUAL only; the loop is in {mode}")
        for s, used, able in zip(self._signals, entries.used(operate).tolist(), entries.able.tolist(), strict=True):
            if s.name in names and s.name in self.local.why:
                raise LoopError(f"the plant has the MV {s.name} itself: {self.local.why[s.name]}")
            if s.name in take and not able:
                raise LoopError(f"the law cannot do without the MV {s.name}; set it by hand in MANUAL")
            if s.name in names and s.name not in take and free and used:
                raise LoopError(f"the law has the MV {s.name}; take it in hand first: operate {s.name}.use=0")

    def follow(self, mv: Array, applied: Array | None, standing: AppliedMV, mode: Mode, in_hand: Those) -> Array:
        """The MV (n_mv,) at a sample, ``applied`` (n_mv,) as it is read back, ``in_hand`` (n_mv,) by its operators.

        An MV that is far off its command when it is taken in hand stays where it is read back: it is on its way.
        """
        away = self.local.away
        out = in_hand | away
        if out.any() and applied is not None and not isnan(mv[0]):
            begins = out & ~self.those & (mode is Mode.AUTO) & (np.abs(applied - mv) > self.local.near)
            read = ~self.local.blind
            mv = np.where(away & read, standing.at(applied), np.where(begins & read, applied, mv))
        self.hand.keep((in_hand | (mode is Mode.MANUAL)) & ~away)
        self.those = out
        return mv

    def without(self, mv: Array, others: Array) -> Array:
        """A copy of ``others`` (n_mv,) but for the MVs that are out of use, which keep ``mv`` (n_mv,)."""
        return np.where(self.those, mv, others) if self.those.any() else others.copy()

    def others(self, mv: Array, wanted: Array) -> list[str]:
        """The MVs that go elsewhere to ``wanted`` (n_mv,) than they go, or stand, at ``mv`` (n_mv,)."""
        goal = self.hand.goal(mv)
        return [s.name for s, new, old in zip(self._signals, wanted, goal, strict=True) if new != old]
