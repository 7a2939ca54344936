"""A controller that is tried beside the one in charge, and takes over from it."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.controller import Controller, Step
from serving.errors import LoopError
from serving.guard import Sample
from serving.manifest import Signal
from serving.words import named

Array: TypeAlias = NDArray[np.float64]


class Successor:
    """Steps a new controller on the samples of the one in charge; its MV is shown and not written.

    It is ready after ``trial`` good scans in a row: a scan without a sample, or one that it cannot compute, starts the
    count and its law anew.
    """

    def __init__(self, controller: Controller, trial: int) -> None:
        self.controller, self.trial = controller, trial
        self.state = controller.cold_state()
        self.good = 0
        self.mv: Array | None = None  # shape: (n_mv,), of the last scan; None where there is none
        self.reason = ""  # why the last scan gave no MV

    def step(self, sample: Sample, sp: Array, applied: Array) -> None:
        """One scan."""
        try:
            step: Step = self.controller.step(sp=sp, pv=sample.pv, dv=sample.dv, mv_applied=applied, state=self.state)
        except Exception as error:  # the controller in charge goes on, whatever this one does
            self.miss(named(error))
            return
        self.mv, self.state, self.reason = step.mv, step.state, ""
        self.good += 1

    def miss(self, reason: str) -> None:
        """A scan without a sample: no past any more."""
        self.mv, self.state, self.good, self.reason = None, self.controller.cold_state(), 0, reason

    @property
    def ready(self) -> bool:
        """Whether it may take over."""
        return self.good >= self.trial


def require_same_signals(old: Controller, new: Controller) -> None:
    """LoopError where ``new`` cannot take over from ``old``: another period, or other signals."""
    a, b = old.manifest, new.manifest
    if a.period_s != b.period_s:
        raise LoopError(f"the new controller has a period of {b.period_s:g} s; the loop runs at {a.period_s:g} s")
    for name, words in (("sp", "set points"), ("pv", "PVs"), ("dv", "measured disturbances"), ("mv", "MVs")):
        now, then = a.signals(name), b.signals(name)
        if list(map(_what, now)) != list(map(_what, then)):
            raise LoopError(
                f"the new controller's {words} are {_shown(then)}; the loop's are {_shown(now)}, and both must be the "
                "same in name, unit, range and order"
            )


def _what(s: Signal) -> tuple[object, ...]:
    return s.name, s.unit, s.low, s.high, s.values


def _shown(signals: tuple[Signal, ...]) -> str:
    return ", ".join(f"{s.name} [{s.unit}] {s.low:g}..{s.high:g}" for s in signals) or "none"
