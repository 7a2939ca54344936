"""The controller that has the plant, and the one on trial beside it; a loop may read more signals than either does."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.bridging import Bridging, Readings
from loopwright.serving.controller import Controller, Step
from loopwright.serving.errors import ContractError, LoopError
from loopwright.serving.fields import shown
from loopwright.serving.guard import Guard, Sample
from loopwright.serving.manifest import INPUTS, Manifest, Signal
from loopwright.serving.mvs.in_hand import MvEntries, Those
from loopwright.serving.mvs.local_mvs import none_left
from loopwright.serving.operating import Operate
from loopwright.serving.preview.course import Courses
from loopwright.serving.words import first_line, named

# ---------------------------------------------------------------------- a controller in a loop that reads more signals
Array: TypeAlias = NDArray[np.float64]


class AdaptedController(Controller):
    """A controller that gets its own PVs and measured disturbances out of a loop's, by name.

    Its ``manifest`` has all signals of the loop, so that whoever reads, judges, shows or writes down a scan does so as
    before; those that the controller reads have the ranges for which it was proven, and the MVs those of the actuator.
    ``inner`` is the controller itself, whose MVs may have narrower ones: from where an MV stands outside of them it
    goes there by its largest move a period.
    """

    def __init__(self, inner: Controller, loop: Manifest) -> None:
        own = inner.manifest
        self.inner, self.manifest = inner, _seen_as(own, loop)
        self.path, self.sha256 = inner.path, inner.sha256
        self.size_bytes, self.summary = inner.size_bytes, inner.summary
        self._pv, self._dv = _places(own.pv, loop.pv), _places(own.dv, loop.dv)

    def step(
        self,
        *,
        sp: ArrayLike,
        pv: ArrayLike,
        mv_applied: ArrayLike,
        state: ArrayLike,
        dv: ArrayLike | None = None,
        operate: ArrayLike | None = None,
        fresh: ArrayLike | None = None,
        ahead: ArrayLike | None = None,
    ) -> Step:
        """One step, on all PVs and measured disturbances of the loop."""
        step = self.inner.step(
            sp=sp,
            pv=_picked(pv, self._pv, self.manifest.pv, "pv"),
            mv_applied=mv_applied,
            state=state,
            dv=_picked(dv, self._dv, self.manifest.dv, "dv") if "dv" in self.inner.manifest.inputs else None,
            operate=operate,
            fresh=None if fresh is None else _picked(fresh, self._pv, self.manifest.pv, "fresh"),
            ahead=None if ahead is None or self.manifest.ahead is None else self._known_ahead(ahead),
        )
        applied = np.asarray(mv_applied, dtype=np.float64).reshape(step.mv.shape)
        mv = [
            s.toward(min(max(float(at), s.low), s.high), float(wanted))
            for s, at, wanted in zip(self.manifest.mv, applied, step.mv, strict=True)
        ]
        return step._replace(mv=np.array(mv))

    def _known_ahead(self, ahead: ArrayLike) -> Array:
        """The numbers of ``ahead`` of the controller's own set points and measured disturbances."""
        n_sp, loops = len(self.manifest.sp), len(self.manifest.sp) + len(self.manifest.dv)
        own = [*range(n_sp), *(n_sp + place for place in self._dv)]
        return np.asarray(ahead, dtype=np.float64).reshape(-1, loops)[:, own].ravel()

    def warm(self) -> None:
        """Compute a first step, as ``Controller.warm`` does."""
        self.inner.warm()


def adapted(controller: Controller, loop: Manifest) -> Controller:
    """``controller`` for a loop that reads the signals of ``loop``: itself where it reads all of them.

    LoopError where it cannot take over there: another period, a signal that the loop does not read, another order of
    what it controls, other set points or MVs. The MVs' values must be the same, and their ranges within the loop's:
    these belong to the actuator. The ranges of set points and PVs say where a controller was proven, and may be others.
    """
    require_fits(controller.manifest, loop)
    return (
        controller
        if _seen_as(controller.manifest, loop) == controller.manifest
        else AdaptedController(controller, loop)
    )


def require_fits(own: Manifest, loop: Manifest) -> None:
    """LoopError where a controller of ``own`` cannot take over in a loop that reads ``loop``; see ``adapted``."""
    differ = [*_basics(own, loop), *_steered(own, loop), *_measured(own, loop)]
    if differ:
        plants = f"the new controller (made for {own.case}) does not fit this loop (made for {loop.case})"
        raise LoopError(f"{plants}: {'; '.join(differ)}")


def _basics(own: Manifest, loop: Manifest) -> Iterator[str]:
    if own.period_s != loop.period_s:
        yield f"its period is {own.period_s:g} s, the loop's is {loop.period_s:g} s"
    if "dv" in own.inputs and "dv" not in loop.inputs:
        yield "it uses measured disturbances, which this loop does not judge; restart with it"


def _steered(own: Manifest, loop: Manifest) -> Iterator[str]:
    """Set points and MVs, which must be the same; MVs may have a part of the loop's range."""
    if [_what(s) for s in own.sp] != [_what(s) for s in loop.sp]:
        its, ours = _shown(own.sp), _shown(loop.sp)
        yield f"its set points are {its}, the loop's are {ours}, and both must be the same in name, unit and order"
    same = [(*_what(s), s.values) for s in own.mv] == [(*_what(s), s.values) for s in loop.mv]
    if not (same and all(o.low <= s.low and s.high <= o.high for s, o in zip(own.mv, loop.mv, strict=True))):
        yield (
            f"its MVs are {_shown(own.mv)}, the loop's are {_shown(loop.mv)}, and both must be the same in name, unit, "
            "values and order, with ranges within the loop's"
        )


def _measured(own: Manifest, loop: Manifest) -> Iterator[str]:
    """PVs and measured disturbances, of which it may leave some out."""
    controlled = len(loop.sp)
    for name, words, first in (("pv", "PVs", controlled), ("dv", "measured disturbances", 0)):
        ours, its = loop.signals(name), own.signals(name)
        known = [_what(s) for s in ours]
        if [_what(s) for s in its[:first]] != known[:first] or not {_what(s) for s in its} <= set(known):
            order = ", and must begin with those that are controlled, in the same order" if first else ""
            may = f"it may leave some of them out, but have no others{order}"
            yield f"its {words} are {_shown(its)}, the loop's are {_shown(ours)}: {may}"


def _seen_as(own: Manifest, loop: Manifest) -> Manifest:
    """``own`` with all PVs and measured disturbances of the loop, which goes on judging them as it did."""
    inputs = tuple(n for n in INPUTS if n in own.inputs or (n == "dv" and n in loop.inputs))
    if set(inputs) == set(own.inputs):
        inputs = own.inputs
    mv = tuple(replace(s, low=o.low, high=o.high) for s, o in zip(own.mv, loop.mv, strict=True))
    dv = _ranged(loop.dv, own.dv)
    ahead = None if own.ahead is None else own.ahead.with_disturbances(dv)
    return replace(own, pv=_ranged(loop.pv, own.pv), mv=mv, dv=dv, inputs=inputs, ahead=ahead)


def _ranged(loop: Sequence[Signal], own: Sequence[Signal]) -> tuple[Signal, ...]:
    known = {s.name: s for s in own}
    return tuple(known.get(s.name, s) for s in loop)


def _places(own: Sequence[Signal], loop: Sequence[Signal]) -> list[int]:
    names = [s.name for s in loop]
    return [names.index(s.name) for s in own]


def _picked(values: ArrayLike | None, places: Sequence[int], loop: Sequence[Signal], name: str) -> Array:
    vector = np.asarray(values)
    if vector.shape != (len(loop),):
        raise ContractError(f"{name} has the shape {vector.shape}; the loop has ({len(loop)},)")
    return np.asarray(vector[places])


def _what(s: Signal) -> tuple[object, ...]:
    return s.name, s.unit


def _shown(signals: Sequence[Signal]) -> str:
    return ", ".join(f"{s.name} [{s.unit}] {s.low:g}..{s.high:g}" for s in signals) or "none"


# -------------------------------------------------------------------------- a controller that is tried, and takes over


def _inputs(controller: Controller, readings: Readings, operate: Array) -> dict[str, ArrayLike]:
    """The numbers of PVs, and what else a law of today reads of them and of its operators."""
    m, found = controller.manifest, dict[str, ArrayLike]()
    assert readings.pv is not None
    found["pv"] = readings.pv
    if "operate" in m.inputs:
        found["operate"] = operate
    if "fresh" in m.inputs and readings.fresh is not None:
        found["fresh"] = readings.fresh
    return found


def _known(controller: Controller, courses: Courses | None, sp: Array, sample: Sample) -> dict[str, ArrayLike]:
    """``ahead`` where a course says something to a law that reads it."""
    found = None if courses is None else courses.ahead(controller.manifest, sp, sample.dv)
    return {} if found is None else {"ahead": found}


def _learnt(
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
            more = _inputs(self.controller, readings, entries.told(used, out, held, self._given))
            more |= _known(self.controller, courses, sp, sample)
            inputs = {"sp": sp, "dv": sample.dv, "mv_applied": applied, "state": self.state, **more}
            step: Step = self.controller.step(**inputs)
            commanded = applied if held is None else held
            learnt = _learnt(self.controller, entries, inputs, step.mv, commanded, out) or step
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


# ----------------------------------------------------------------------------------- the controller that has the plant
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
        more = _inputs(self.controller, readings, self.mv_entries.told(wanted, out, held, self._given))
        more |= _known(self.controller, self.courses, sp, sample)
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
        """Let the law go on from what is ``commanded`` (n_mv,) after its last step, where that is not what it gave."""
        if self._inputs is None or self._given is None:
            return
        given, out = self._inputs
        learnt = _learnt(self.controller, self.mv_entries, given, self._given, commanded, out)
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
