"""Bugs put into the loop on purpose: a walk must find each."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock

import numpy as np

from loopwright.serving import ControlLoop, Mode
from loopwright.serving.modes import LoopMode
from loopwright.serving.mv_readback import AppliedMV, ShownMV, StandingMv
from loopwright.serving.mvs.commanded import CommandedMV
from loopwright.serving.mvs.in_hand import ByHand

Planted = Callable[[], AbstractContextManager[object]]


def put_in(of: Any, name: str, new: Any) -> Planted:
    """A bug: ``new`` in the place of a part of a class."""
    return lambda: mock.patch.object(of, name, new)


def _begun(self: CommandedMV, mode: Mode, before: Mode, in_hand: Any) -> None:
    self.out.begun(mode, in_hand)
    self._hand = False


def _lose(self: LoopMode, reason: str) -> None:
    if self.now is Mode.AUTO or self.fault:
        self.now, self.fault = Mode.HOLD, reason


def _lose_unseen(self: LoopMode, reason: str) -> None:
    self._good = 0


def _recovers_late(self: LoopMode) -> bool:
    self._good += 1
    return self._recover_after is not None and self._good > self._recover_after


def _fall_back(self: CommandedMV, mode: LoopMode, signals: Any, *, moves: bool = True) -> None:
    mode.hold()
    if mode.fault:
        self.now = self.now + 0.5


def _unread(self: AppliedMV, sample: Any = None) -> ShownMV:
    return ShownMV(bad=getattr(sample, "mv_applied", None) is not None)


def _seen(self: StandingMv, applied: Any) -> None:
    self.lost = False


def _sent_at_once(self: ByHand, mv: Any, wanted: Any, *_: Any, **__: Any) -> Any:
    self.wanted = None
    return np.array(wanted)


def _set_mode_of_any_shadow(self: ControlLoop, mode: Mode) -> None:
    if mode is not self.mode:
        self._mv.begun(mode, self.mode, self._active.in_hand)
    self._mode.set(mode)


PLANTED: dict[str, Planted] = {
    "a shadow that ends begins where the MV was before it": put_in(CommandedMV, "begun", _begun),
    "good samples before a refused one count towards the end of a fault": put_in(LoopMode, "lose", _lose),
    "a refused sample in AUTO is no fault": put_in(LoopMode, "lose", _lose_unseen),
    "a fault ends one good sample late": put_in(LoopMode, "recovers", _recovers_late),
    "HOLD by a fault creeps": put_in(CommandedMV, "fall_back", _fall_back),
    "a lost write is forgotten without a read-back": put_in(AppliedMV, "unread", _unread),
    "a read-back after a lost write is not looked at": put_in(StandingMv, "seen", _seen),
    "an MV by hand goes at once": put_in(ByHand, "sent", _sent_at_once),
    "a lost write is not noted": put_in(AppliedMV, "lose", lambda self: None),
    "a shadow without a good sample may begin to write": put_in(ControlLoop, "set_mode", _set_mode_of_any_shadow),
}
