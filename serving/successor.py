"""A controller that is tried beside the one in charge, and takes over from it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Controller, Step
from loopwright.serving.guard import Guard, Sample, refused
from loopwright.serving.words import named

Array: TypeAlias = NDArray[np.float64]


class Successor:
    """Steps a new controller on the samples of the one in charge; its MV is shown and not written.

    It is ready after ``trial`` good scans in a row: a scan without a sample, one that its own ``guards`` refuse, or one
    that it cannot compute, starts the count and its law anew.
    """

    def __init__(self, controller: Controller, trial: int, guards: Sequence[Guard] = ()) -> None:
        self.controller, self.trial, self.guards = controller, trial, guards
        self.state = controller.cold_state()
        self.good = 0
        self.mv: Array | None = None  # shape: (n_mv,), of the last scan; None where there is none
        self.reason = ""  # why the last scan gave no MV

    def step(self, sample: Sample, sp: Array, applied: Array, past: Collection[Sample] = ()) -> None:
        """One scan; ``past`` ends with the sample before it."""
        if reason := refused(self.guards, sample, past):
            self.miss(reason)
            return
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
