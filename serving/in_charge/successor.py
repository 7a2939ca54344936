"""A controller that is tried beside the one in charge, until it takes over; and what both laws are given."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.bridging import Bridging, Readings
from loopwright.serving.controller import Controller, Step
from loopwright.serving.errors import ContractError
from loopwright.serving.guard import Guard, Sample
from loopwright.serving.mvs.in_hand import MvEntries, Those
from loopwright.serving.operating import Operate
from loopwright.serving.preview.course import Courses
from loopwright.serving.words import first_line, named

Array: TypeAlias = NDArray[np.float64]


def law_readings(controller: Controller, readings: Readings, operate: Array) -> dict[str, ArrayLike]:
    """The numbers of PVs, and what else a law of today reads of them and of its operators."""
    m, found = controller.manifest, dict[str, ArrayLike]()
    assert readings.pv is not None
    found["pv"] = readings.pv
    if "operate" in m.inputs:
        found["operate"] = operate
    if "fresh" in m.inputs and readings.fresh is not None:
        found["fresh"] = readings.fresh
    return found


def law_ahead(controller: Controller, courses: Courses | None, sp: Array, sample: Sample) -> dict[str, ArrayLike]:
    """``ahead`` where a course says something to a law that reads it."""
    found = None if courses is None else courses.ahead(controller.manifest, sp, sample.dv)
    return {} if found is None else {"ahead": found}


def learnt_step(
    controller: Controller, entries: MvEntries, given: Mapping[str, Any], gave: Array, commanded: Array, out: Those
) -> Step | None:
    """The step from the inputs ``given`` after which the law goes on from what is ``commanded`` (n_mv,).

    A law takes what it ``gave`` (n_mv,) for the command, and a read-back beside it up to ``READ_BACK_MARGIN`` for an
    actuator's offset. While somebody else commands the MVs, it would walk away from them by so much, and a change to
    AUTO would jump there. None where it has nothing to learn. MVs ``out`` (n_mv,) of use have their own way.
    """
    other = (gave != commanded) & entries.able & ~out
    if not other.any() or np.isnan(commanded).any():  # a law without `operate` can do without none
        return None
    told = entries.told(np.array(given["operate"], dtype=np.float64), other, commanded, gave)
    return controller.step(**{**given, "operate": told})


class Successor:
    """Steps a new controller on the samples of the one in charge; its MV is shown and not written.

    It is ready after ``trial`` good scans in a row: a scan without a sample, one that its own ``guards`` refuse, or one
    that it cannot compute, starts the count and its law anew. It takes by name the values that somebody has set.
    """

    def __init__(
        self, controller: Controller, trial: int, guards: Sequence[Guard] = (), bridging: Bridging | None = None
    ) -> None:
        self.controller, self.trial, self.guards = controller, trial, guards
        self.bridging = bridging or Bridging(controller.manifest)
        self.operating = Operate(controller.manifest.operate)
        self.operate = self.operating.default  # shape: (n_operate,)
        self.mv_entries = MvEntries(controller.manifest)
        self.state = controller.cold_state()
        self.good = 0
        self.mv: Array | None = None  # shape: (n_mv,), of the last scan; None where there is none
        self._given: Array | None = None  # shape: (n_mv,), what the law goes on from
        self.reason = ""  # why the last scan gave no MV

    def step(
        self,
        sample: Sample,
        sp: Array,
        applied: Array,
        past: Collection[Sample] = (),
        wishes: Mapping[str, float] | None = None,
        courses: Courses | None = None,
        away: Those | None = None,
        held: Array | None = None,
        those: Those | None = None,
    ) -> None:
        """One scan; ``past`` ends with the sample before it, ``wishes`` are values of ``operate`` that somebody set.

        ``courses`` are those of the loop, ``away`` (n_mv,) MVs that the plant has, ``held`` (n_mv,) what is commanded
        of ``those`` (n_mv,) that are out of use in the loop.
        """
        stuck = np.zeros(len(self.mv_entries.able), dtype=bool) if those is None else those & ~self.mv_entries.able
        if stuck.any():
            names = ", ".join(s.name for s, of in zip(self.controller.manifest.mv, stuck.tolist(), strict=True) if of)
            self.miss(f"{names} is out of use or the plant's, and this law cannot do without; take it in use first")
            return
        try:
            self.operate = self.operating.taken_over(wishes or {})
        except ContractError as error:
            self.miss(first_line(error))
            return
        readings = self.bridging.look(sample, self.guards, past, self.operate)
        if readings.reason:
            self.miss(readings.reason)
            return
        for s, value in zip(self.controller.manifest.sp, sp.tolist(), strict=True):
            if not s.low <= value <= s.high:
                self.miss(f"the set point {s.name} = {value:g} is outside its range [{s.low:g}, {s.high:g}] {s.unit}")
                return
        try:
            used, entries = self.bridging.used(self.operate, readings), self.mv_entries
            out = ~entries.used(self.operate) | (entries.able & (False if away is None else away))
            more = law_readings(self.controller, readings, entries.told(used, out, held, self._given))
            more |= law_ahead(self.controller, courses, sp, sample)
            inputs = {"sp": sp, "dv": sample.dv, "mv_applied": applied, "state": self.state, **more}
            step: Step = self.controller.step(**inputs)
            commanded = applied if held is None else held
            learnt = learnt_step(self.controller, entries, inputs, step.mv, commanded, out) or step
        except Exception as error:  # the controller in charge goes on, whatever this one does
            self.miss(named(error))
            return
        # It is shown as the law gives it; the law goes on from what is commanded.
        self.mv, self.state, self.reason = np.array(step.mv), learnt.state, ""
        self._given = np.array(learnt.mv)
        self.good += 1

    def miss(self, reason: str) -> None:
        """A scan without a sample: no past any more."""
        self.mv, self.state, self.good, self.reason = None, self.controller.cold_state(), 0, reason
        self._given = None

    @property
    def given(self) -> Array | None:
        """The MV (n_mv,) that its law goes on from; None without a past."""
        return self._given

    @property
    def ready(self) -> bool:
        """Whether it may take over."""
        return self.good >= self.trial
