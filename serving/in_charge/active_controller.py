"""The controller in charge of a plant: its law's state, its guards, what operators set, and its successor."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.bridging import Bridging, Readings
from loopwright.serving.controller import Controller, Step
from loopwright.serving.errors import ContractError, LoopError
from loopwright.serving.fields import shown
from loopwright.serving.guard import Guard, Sample
from loopwright.serving.in_charge.adapted import adapted
from loopwright.serving.in_charge.successor import Successor, law_ahead, law_readings, learnt_step
from loopwright.serving.manifest import Manifest
from loopwright.serving.mvs.in_hand import MvEntries, Those
from loopwright.serving.mvs.local_mvs import none_left
from loopwright.serving.operating import Operate
from loopwright.serving.preview.course import Courses
from loopwright.serving.words import first_line

Array: TypeAlias = NDArray[np.float64]
Guards: TypeAlias = Sequence[Guard] | Callable[[Manifest], Sequence[Guard]]


@dataclass(frozen=True, slots=True, eq=False)
class LawInputs:
    """Inputs that a law was last stepped with: the same step can be computed again from them, and looked into.

    ``values`` are by the inputs' names, of the loop's signals; ``unread_s`` (n_pv,) is the time since each PV was read
    well, 0 where it was for this step. ``operate`` is as operators and the plant have it; the step itself may pin an MV
    that is out of use to what is commanded of it. ``course_s`` [s] is when it was, as the courses count the time.
    """

    values: Mapping[str, Array]
    unread_s: Array
    operate: Array
    course_s: float


class ActiveController:
    """The controller in charge with the state of its law, its guards and the samples that they look back to.

    ``guards`` are a host's own, or what makes them for a controller's manifest: they are then made anew for each
    controller that takes over. ``bridge_s`` and ``critical`` are of ``Bridging``. ``wishes`` are the values of
    ``operate`` that somebody has set since the loop began, by name: they outlast a law that lacks them. ``operate``
    (n_operate,) is those that the law in charge has, and its own defaults for the rest. ``stepped`` has the inputs of
    its last step.
    """

    def __init__(
        self, controller: Controller, guards: Guards, *, bridge_s: float | None = None, critical: Sequence[str] = ()
    ) -> None:
        self.controller = controller
        self.replaced: Controller | None = None  # the one that was in charge before the present one
        self.successor: Successor | None = None  # tried beside the controller
        self.operating = Operate(controller.manifest.operate)
        self.operate = self.operating.default
        self.wishes: dict[str, float] = {}
        self.courses = Courses(controller.manifest)  # of set points and measured disturbances, whoever is in charge
        self._made = guards if callable(guards) else None
        self.guards: tuple[Guard, ...] = tuple(guards(controller.manifest) if callable(guards) else guards)
        self._bridging = Bridging(controller.manifest, bridge_s, critical)
        self.mv_entries = MvEntries(controller.manifest)
        self._state = controller.cold_state()
        self.stepped: LawInputs | None = None
        self._given: Array | None = None  # shape: (n_mv,), what the law goes on from; None without a past
        self._inputs: tuple[Mapping[str, Any], Those] | None = None  # of the last step, and the MVs out of use at it
        self._past = deque[Sample](maxlen=_longest(self.guards))
        self._before: tuple[Sample, ...] = ()  # the past of the present sample, for the successor

    @property
    def in_hand(self) -> Those:
        """The MVs (n_mv,) that operators have taken out."""
        return ~self.mv_entries.used(self.operate)

    def look(self, sample: Sample, local: Mapping[str, str]) -> Readings:
        """The readings of a sample that the law may act on, or why it may not; the plant has the MVs ``local``."""
        readings = self._bridging.look(sample, self.guards, self._past, self.operate)
        if not readings.reason and local:
            why = none_left(self.controller.manifest.mv, local, self.mv_entries.used(self.operate))
            readings = replace(readings, reason=why)
        if readings.reason and self.successor is not None:
            self.successor.bridging.missed()
        return readings

    def operate_with(self, values: Mapping[str, float]) -> Array:
        """``operate`` (n_operate,) with some values by name; LoopError for a wrong name or value, or a law without."""
        m = self.controller.manifest
        if "operate" not in m.inputs:
            raise LoopError(f"{m.law} has no operate: nothing of it can be changed while it runs but its set points")
        if not isinstance(values, Mapping):
            raise LoopError(f"operate is {shown(values)}; it needs numbers by name: {', '.join(self.operating.places)}")
        try:
            return self.operating.with_values(values, self.operate)
        except ContractError as error:
            refused = LoopError(first_line(error))
            refused.entry = error.entry
            raise refused from error

    def set_operate(self, values: Mapping[str, float]) -> None:
        """Change some of ``operate``; LoopError as ``operate_with``, and nothing is changed then."""
        self.operate = self.operate_with(values)
        self.wishes |= {name: float(self.operate[self.operating.places[name]]) for name in values}

    def require_ahead(self) -> None:
        """LoopError for a law that does not read what is to come."""
        m = self.controller.manifest
        if "ahead" not in m.inputs:
            raise LoopError(f"{m.law} has no ahead: it cannot be given a course; design it with `preview: course`")

    def step(self, readings: Readings, sp: Array, applied: Array, out: Those, held: Array | None) -> Step:
        """One step of the law. It raises what the law raises; ``forget`` then, as the state is of no use any more.

        ``out`` (n_mv,) are the MVs out of use, by operators' word or the plant's, ``held`` (n_mv,) what is commanded
        of these now; None: nothing is.
        """
        sample = readings.sample
        self._before = tuple(self._past) if self.successor is not None else ()
        wanted = self._bridging.used(self.operate, readings)
        more = law_readings(self.controller, readings, self.mv_entries.told(wanted, out, held, self._given))
        more |= law_ahead(self.controller, self.courses, sp, sample)
        given = {"sp": sp, "dv": sample.dv, "mv_applied": applied, "state": self._state, **more}
        step = self.controller.step(**given)
        read = self.controller.manifest.inputs  # another one may hold anything
        values = {n: np.array(given[n], dtype=np.float64) for n in read if n in given}  # hosts reuse their arrays
        steered = np.array(self.mv_entries.told(wanted, out, None, None))
        self.stepped = LawInputs(values, self._bridging.unread_s, steered, self.courses.now_s)
        if self._past.maxlen:
            self._past.append(replace(sample, pv=np.array(sample.pv)))  # the host may reuse its array
        self._state, self._given = step.state, np.array(step.mv)  # the host gets step.mv, may write into it
        self._inputs = given, out
        return step

    def learn(self, commanded: Array) -> None:
        """Let the law go on from what is ``commanded`` (n_mv,) after its last step, where that is not what it gave.

        The MV of this scan is known already: where the law raises, the next one begins without a past.
        """
        if self._inputs is None or self._given is None:
            return
        given, out = self._inputs
        try:
            learnt = learnt_step(self.controller, self.mv_entries, given, self._given, commanded, out)
        except Exception as error:
            self.begin_cold(first_line(error))
            return
        if learnt is not None:
            self._state, self._given = learnt.state, np.array(learnt.mv)

    def beside(
        self,
        sample: Sample,
        sp: Array,
        applied: Array,
        away: Those | None = None,
        held: Array | None = None,
        those: Those | None = None,
    ) -> Array | None:
        """The successor's MV (n_mv,); once it is ready, it has the plant from the next scan on."""
        new = self.successor
        if new is None:
            return None
        new.step(sample, sp, applied, self._before, self.wishes, self.courses, away, held, those)
        if new.ready:
            self.replaced, self.successor = self.controller, None
            self.controller, self._state, self.stepped = new.controller, new.state, None
            self._given, self._inputs = new.given, None
            self.operating, self.operate, self._bridging = new.operating, new.operate, new.bridging
            self.mv_entries = new.mv_entries
            if self._made is not None:
                self.guards = tuple(new.guards)
                self._past = deque(self._past, maxlen=_longest(self.guards))
        return new.mv

    def swap(self, controller: Controller, trial: int, loop: Manifest) -> None:
        """Try ``controller``, in a loop that reads the signals of ``loop``; see ``ControlLoop.swap``."""
        if trial < 1:
            raise LoopError(f"trial is {trial}; a controller is tried for at least one scan")
        new = adapted(controller, loop)
        guards = () if self._made is None else tuple(self._made(new.manifest))
        self.successor = Successor(new, trial, guards, self._bridging.beside(new.manifest))

    def missed(self, periods: int) -> None:
        """So many periods passed without a sample."""
        self._bridging.missed(periods)
        if self.successor is not None:
            self.successor.bridging.missed(periods)

    def forget(self, reason: str) -> None:
        """No past any more."""
        self._past.clear()
        self.begin_cold(reason)

    def begin_cold(self, reason: str) -> None:
        """The laws know nothing of what was."""
        self._state, self._given, self._inputs = self.controller.cold_state(), None, None
        if self.successor is not None:
            self.successor.miss(reason)


def _longest(guards: Sequence[Guard]) -> int:
    """How many past samples the guards need."""
    return max((g.memory for g in guards), default=0)
