"""A controller that is tried beside the one in charge, and takes over from it."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.controller import Controller, Step
from serving.errors import LoopError
from serving.guard import Sample
from serving.manifest import Manifest, Signal
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
        for s, value in zip(self.controller.manifest.sp, sp.tolist(), strict=True):
            if not s.low <= value <= s.high:
                self.miss(f"the set point {s.name} = {value:g} is outside its range [{s.low:g}, {s.high:g}] {s.unit}")
                return
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


def require_same_signals(a: Manifest, b: Manifest) -> None:
    """LoopError where a controller of ``b`` cannot take over from one of ``a``: another period, or other signals.

    Names, units and order must be the same, and of the MVs also range and values: they belong to the actuator. The
    ranges of set points and PVs say where a controller was proven, and may be others.
    """
    if a.period_s != b.period_s:
        raise LoopError(f"the new controller has a period of {b.period_s:g} s; the loop runs at {a.period_s:g} s")
    if "dv" in b.inputs and "dv" not in a.inputs:
        raise LoopError(
            "the new controller uses measured disturbances, which this loop does not judge; restart with it"
        )
    for name, words in (("sp", "set points"), ("pv", "PVs"), ("dv", "measured disturbances"), ("mv", "MVs")):
        now, then, ranged = a.signals(name), b.signals(name), name == "mv"
        if [_what(s, ranged) for s in now] != [_what(s, ranged) for s in then]:
            same = "name, unit, range and order" if ranged else "name, unit and order"
            raise LoopError(
                f"the new controller's {words} are {_shown(then)}; the loop's are {_shown(now)}, and both must be the "
                f"same in {same}"
            )


def _what(s: Signal, ranged: bool) -> tuple[object, ...]:
    return (s.name, s.unit, s.low, s.high, s.values) if ranged else (s.name, s.unit)


def _shown(signals: tuple[Signal, ...]) -> str:
    return ", ".join(f"{s.name} [{s.unit}] {s.low:g}..{s.high:g}" for s in signals) or "none"
