"""The explain graph of a controller, computed for one sample: courses, the next moves, and their parts."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from math import ceil
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.controller import Controller, session_of
from loopwright.serving.controller_file import read_controller
from loopwright.serving.errors import ArtifactError, ContractError, LoopError, OutputError
from loopwright.serving.explain.explain_file import controller_path, explain_manifest
from loopwright.serving.explain.explanation import (
    Cause,
    ExplainedMove,
    Explanation,
    MovePart,
    SignalCourse,
    WhatIf,
    sentence_of,
)
from loopwright.serving.fields import nearest, shown
from loopwright.serving.graph.audit import audit
from loopwright.serving.operating import Operate
from loopwright.serving.preview.course import Courses, Points
from loopwright.serving.ranges import numbers, within

Array: TypeAlias = NDArray[np.float64]
NO_PART = 1e-13  # of an MV's range: a smaller part is none
HELD_WITHIN = 1e-6  # of an MV's range: nearer to a limit is at it
# Share of an MV's range by which both graphs may differ and be one law. They round apart, and where the plan hardly
# bends rounding grows: on a served tank with three valves for two variables by more than 1e-9.
SAME_MV = 1e-6
MOST_SAMPLES = 500  # of a what-if: each takes 1 ms or so, with the change and without it


class Explainer:
    """Says why a predictive law moves, and what it would do.

    Parameters
    ----------
    path
        The .explain.onnx file that the pipeline wrote beside the controller's.
    sha256
        The SHA-256 of the controller's file that runs, if the host wants an explanation of this very file.

    Raises
    ------
    ArtifactError
        The file is damaged or foreign, belongs to another controller than the file beside it, or that one is not there.

    Notes
    -----
    It has a controller of its own, and shares no buffer with a loop. No loop steps it.
    """

    def __init__(self, path: str | PathLike[str], sha256: str | None = None) -> None:
        self.path = Path(path)
        try:
            data = read_controller(self.path, None)
            self.summary = audit(data)
            self.explains = explain_manifest(self.summary.metadata)
            beside = controller_path(self.path)
            self.controller = Controller(beside, sha256=sha256)
            if self.controller.sha256 != self.explains.controller:
                raise ArtifactError(
                    f"it belongs to the controller with the SHA-256 {self.explains.controller}, and {beside.name} has "
                    f"{self.controller.sha256}; design the controller again, or fetch both files from one place"
                )
            self.manifest = self.controller.manifest
            self._session = session_of(data)
            self._inputs, self._outputs = self.explains.sizes(self.manifest)
            _agree(self._session, self._inputs, {name: n for name, n in self._outputs.items() if n})
        except ArtifactError as error:
            raise ArtifactError(f"{self.path}: {error}") from error.__cause__

    def explain(
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
    ) -> Explanation:
        """The explanation of the step that the controller makes of these inputs, which are those of its ``step``.

        The courses of CVs have all samples of the horizon, those of MVs the moves of the plan. Raises as ``step`` does.
        """
        given = _Given(sp, pv, mv_applied, state, dv, operate, fresh, ahead)
        return self._explanation(self._looked(given), given)

    def what_if(
        self,
        changes: Mapping[str, float],
        *,
        sp: ArrayLike,
        pv: ArrayLike,
        mv_applied: ArrayLike,
        state: ArrayLike,
        dv: ArrayLike | None = None,
        operate: ArrayLike | None = None,
        fresh: ArrayLike | None = None,
        ahead: ArrayLike | None = None,
        course: Mapping[str, Points] | None = None,
        straight: Collection[str] = (),
        ended: Collection[str] = (),
    ) -> WhatIf:
        """The courses that the law would make after ``changes``, beside what it does without them; nothing is set.

        ``changes`` name set points by their signals, and entries of ``operate`` as these are named. ``course`` and
        ``straight`` are as of ``ControlLoop.set_course``: points (time [s] from this step, value) of set points and
        measured disturbances, by name, in place of what ``ahead`` has of them. Nothing is to come of those in
        ``ended``. ``ahead`` (K n,) may know more than the N samples of the law's horizon: the law then reads them as
        they come near; the last ones stay.

        The courses are those of the closed loop over the law's own model: the law plans anew at every sample, and
        disturbances do what is forecast, else they stay. They have N samples; with a ``course`` N more than until its
        last point, ``MOST_SAMPLES`` at most.

        ContractError for an unknown name, LoopError for a set point and ContractError for another value that is not
        allowed, LoopError as ``set_course`` for a course; else as ``step``.
        """
        given = self._known(_Given(sp, pv, mv_applied, state, dv, operate, fresh, ahead))
        changed, samples = self._changed(given, changes), self.explains.horizon
        if course or straight or ended:
            self._looked(self._later(given, 0))  # wrong inputs are refused before a course is made of them
            changed, samples = self._with_courses(changed, course or {}, straight, ended)
        return WhatIf(dict(changes), self._run(given, samples), self._run(changed, samples))

    def changed_inputs(
        self, changes: Mapping[str, float], sp: ArrayLike, operate: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """``sp`` (n_sp,) and ``operate`` (n_operate,) with ``changes`` by name, checked as ``what_if`` does."""
        entries = Operate(self.manifest.operate)
        places = {s.name: i for i, s in enumerate(self.manifest.sp) if s.name not in entries.places}
        for name in changes:
            if name not in places and name not in entries.places:
                known = (*places, *entries.places)
                raise ContractError(f"what-if: there is no set point or entry {shown(name)}{nearest(name, known)}")
        found = np.array(sp, dtype=np.float64, ndmin=1)
        for name, value in changes.items():
            if name in places:
                i = places[name]
                try:
                    single = numbers(value).ndim == 0
                except TypeError as error:
                    raise ContractError(f"what-if: {name} {error}; it needs a number") from error
                if not single:
                    raise ContractError(f"what-if: {name} is {shown(value)}; it needs one number")
                found[i] = within(value, self.manifest.sp[i : i + 1], "what-if's set point")[0]
        others = {name: value for name, value in changes.items() if name not in places}
        return found, entries.with_values(others, operate)

    def _changed(self, given: _Given, changes: Mapping[str, float]) -> _Given:
        sp, operate = self.changed_inputs(changes, given.sp, given.operate)
        return self._ended(given._replace(sp=sp, operate=operate), changes)  # a set point ends its course

    def _ended(self, given: _Given, names: Collection[str]) -> _Given:
        """``given`` without what is to come of some signals."""
        if given.ahead is None or self.manifest.ahead is None:
            return given
        later = np.array(given.ahead)
        later[:, [i for i, s in enumerate(self.manifest.ahead.signals) if s.signal in names]] = 0.0
        return given._replace(ahead=later)

    def _known(self, given: _Given) -> _Given:
        """``given`` with what is known ahead as an array (K, n); ContractError where that is not of whole samples."""
        known = self.manifest.ahead
        if given.ahead is None or known is None:
            return given
        n = len(known.signals)
        try:
            rows = np.array(numbers(given.ahead), dtype=np.float64)
        except TypeError as error:
            raise ContractError(f"ahead {error}; it needs {n} numbers a sample") from error
        if rows.ndim != 1 or rows.size % n or rows.size < known.size:
            raise ContractError(
                f"ahead has the shape {rows.shape}; what-if needs {n} numbers a sample, and {known.horizon} samples or "
                "more"
            )
        return given._replace(ahead=rows.reshape(-1, n))

    def _with_courses(
        self, given: _Given, points: Mapping[str, Points], straight: Collection[str], ended: Collection[str]
    ) -> tuple[_Given, int]:
        """``given`` with some courses to come and without those ``ended``; and how many samples there are to see."""
        m, known, horizon = self.manifest, self.manifest.ahead, self.explains.horizon
        if known is None:
            raise LoopError(f"{m.law} has no ahead: it cannot be given a course; design it with `preview: course`")
        given = self._ended(given, ended)
        if not points and not straight:
            return given, horizon
        courses = Courses(m)
        courses.give(points, straight)
        last = max(of.times_s[-1] for of in courses.standing.values())
        samples = min(max(horizon, ceil(last / m.period_s) + horizon), max(horizon, MOST_SAMPLES))
        sp = courses.followed(np.array(given.sp, dtype=np.float64, ndmin=1), m.sp)
        rows = courses.ahead(m, sp, given.dv, samples + known.horizon)
        later = np.zeros((samples + known.horizon, len(known.signals)))
        if given.ahead is not None:
            stands = np.asarray(given.ahead)[: len(later)]
            later[:] = np.vstack([stands, np.repeat(stands[-1:], len(later) - len(stands), axis=0)])
        if rows is not None:
            of = [i for i, s in enumerate(known.signals) if s.signal in points]
            later[:, of] = rows.reshape(later.shape)[:, of]
        return given._replace(sp=sp, ahead=later), samples

    # ------------------------------------------------------------------ the graph
    def _looked(self, given: _Given) -> dict[str, Array]:
        """The graph's outputs by name. The controller's own step checks the inputs and must give the same MVs."""
        named = given._asdict()
        step = self.controller.step(**named)
        usual = {name: self.manifest.usual(name) for name in self._inputs}
        vectors = {
            name: np.array(usual[name] if named[name] is None else named[name], dtype=np.float64, ndmin=1)
            for name in self._inputs
        }
        names = [name for name, n in self._outputs.items() if n]
        found = {name: np.zeros(0) for name in self._outputs}
        found |= dict(zip(names, self._session.run(names, vectors), strict=True))
        spans = np.array([s.high - s.low for s in self.manifest.mv])
        apart = np.abs(found["mv"] - step.mv) / spans
        if not all(np.isfinite(values).all() for values in found.values()) or (apart > SAME_MV).any():
            raise OutputError("the explain graph does not give what the controller does; design the controller again")
        return found

    def _explanation(self, found: Mapping[str, Array], given: _Given) -> Explanation:
        period_s, explains = self.manifest.period_s, self.explains
        ahead = tuple(period_s * k for k in range(1, explains.horizon + 1))
        starts = tuple(period_s * k for k in explains.starts)
        y = found["y"].reshape(explains.horizon, explains.outputs)
        z = found["z"].reshape(len(explains.starts), len(self.manifest.mv))
        return Explanation(period_s, self._courses(ahead, y, starts, z), self._moves(found, given))

    def _courses(
        self, ahead: tuple[float, ...], y: Array, starts: tuple[float, ...], z: Array
    ) -> tuple[SignalCourse, ...]:
        pvs = self.manifest.pv[: self.explains.outputs]
        cvs = [SignalCourse(s.name, "cv", s.unit, ahead, tuple(v.tolist())) for s, v in zip(pvs, y.T, strict=True)]
        mvs = [
            SignalCourse(s.name, "mv", s.unit, starts, tuple(v.tolist()))
            for s, v in zip(self.manifest.mv, z.T, strict=True)
        ]
        return (*cvs, *mvs)

    def _moves(self, found: Mapping[str, Array], given: _Given) -> tuple[ExplainedMove, ...]:
        causes, m = self.explains.parts, self.manifest
        names = [s.name for s in (*m.dv, *m.pv[: self.explains.outputs])]
        news = dict(zip(names, found["news"].tolist(), strict=True))
        entries = Operate(m.operate)
        operate = entries.default if given.operate is None else np.asarray(given.operate)
        idle = {e.signal for e, v in zip(m.operate, operate, strict=True) if (e.group, e.what, v) == ("mv", "use", 0)}
        rests = {e.signal: v for e, v in zip(m.operate, operate, strict=True) if (e.group, e.what) == ("mv", "rest")}
        applied = np.array(given.mv_applied, dtype=np.float64, ndmin=1).tolist()
        to_rest = {s.name: rests[s.name] - at for s, at in zip(m.mv, applied, strict=True) if s.name in rests}
        rows, later = found["parts"].reshape(len(m.mv), len(causes)), self._limits_reached(found, operate, applied)
        moves = []
        for s, move, row in zip(m.mv, found["move"].tolist(), rows.tolist(), strict=True):
            span = s.high - s.low
            parts = [
                MovePart(cast("Cause", c), n, v, later.get((c, n), 0.0)) for (c, n), v in zip(causes, row, strict=True)
            ]
            parts = sorted((p for p in parts if abs(p.value) > NO_PART * span), key=lambda p: -abs(p.value))
            parts = parts or [MovePart("not_in_use", s.name, move) if s.name in idle else MovePart("plan", "", move)]
            words = sentence_of(move, span, parts, news, {s.name: to_rest.get(s.name, 0.0)})
            moves.append(ExplainedMove(s.name, s.unit, move, tuple(parts), words))
        return tuple(moves)

    def _limits_reached(
        self, found: Mapping[str, Array], operate: Array, applied: list[float]
    ) -> dict[tuple[str, str], float]:
        """Time [s] until each MV is at a limit by its plan, by cause and signal; 0 where it is now, or next."""
        m, reached = self.manifest, dict[tuple[str, str], float]()
        z = found["z"].reshape(len(self.explains.starts), len(m.mv)).copy()
        z[0] = found["mv"]  # within the limits, where the plan is so up to rounding
        set_ends: dict[tuple[str, str], float] = {
            (e.signal, e.what): v for e, v in zip(m.operate, operate.tolist(), strict=True) if e.group == "mv"
        }
        for i, s in enumerate(m.mv):
            course, slack = np.array([applied[i], *z[:, i]]), HELD_WITHIN * (s.high - s.low)
            high, low = (set_ends.get((s.name, end), own) for end, own in (("high", s.high), ("low", s.low)))
            for cause, room in (("mv_high", min(high, s.high) - course), ("mv_low", course - max(low, s.low))):
                place = int(np.argmin(np.maximum(room, slack)))  # the first one at the limit, else the nearest
                reached[cause, s.name] = m.period_s * self.explains.starts[max(0, place - 1)]
        return reached

    def _run(self, given: _Given, samples: int) -> Explanation:
        """The closed loop over the law's model from here: moves of the first step, courses of so many samples."""
        outputs, period_s = self.explains.outputs, self.manifest.period_s
        at_first = self._later(given, 0)
        first = found = self._looked(at_first)
        ys, mvs = [found["y"][:outputs]], [found["mv"]]
        pv = np.array(given.pv, dtype=np.float64, ndmin=1)
        for k in range(1, samples):
            pv[:outputs] = ys[-1]
            then = self._later(given, k)
            found = self._looked(then._replace(pv=pv, mv_applied=mvs[-1], state=found["state_next"], fresh=None))
            ys.append(found["y"][:outputs])
            mvs.append(found["mv"])
        ahead, starts = (tuple(period_s * (k + i) for k in range(samples)) for i in (1, 0))
        courses = self._courses(ahead, np.array(ys), starts, np.array(mvs))
        return Explanation(period_s, courses, self._moves(first, at_first))

    def _later(self, given: _Given, k: int) -> _Given:
        """The inputs k samples on, of what is known to come (K, n): the last known values stay."""
        known = self.manifest.ahead
        if given.ahead is None or known is None:
            return given
        n_sp, rows = len(self.manifest.sp), np.asarray(given.ahead)
        now = rows[min(k, len(rows)) - 1] if k else np.zeros(rows.shape[1])
        sp = np.array(given.sp, dtype=np.float64, ndmin=1) + now[:n_sp]
        dv = None if given.dv is None else np.array(given.dv, dtype=np.float64, ndmin=1) + now[n_sp:]
        at = np.minimum(k + np.arange(known.horizon), len(rows) - 1)
        return given._replace(sp=sp, dv=dv, ahead=(rows[at] - now).ravel())


class _Given(NamedTuple):
    """Inputs of a step, as a host gives them; of a what-if ``ahead`` is an array (K, n)."""

    sp: ArrayLike
    pv: ArrayLike
    mv_applied: ArrayLike
    state: ArrayLike
    dv: ArrayLike | None
    operate: ArrayLike | None
    fresh: ArrayLike | None
    ahead: ArrayLike | None


def _agree(session: Any, inputs: Mapping[str, int], outputs: Mapping[str, int]) -> None:
    """ArtifactError unless the graph has exactly these inputs and outputs, float64 of rank 1."""
    for kind, wanted, nodes in (("inputs", inputs, session.get_inputs()), ("outputs", outputs, session.get_outputs())):
        found = {node.name: f"{node.type}{node.shape}" for node in nodes}
        expected = {name: f"tensor(double){[n]}" for name, n in wanted.items()}
        if found != expected:
            raise ArtifactError(f"the graph's {kind} are {found}, but its manifest says {expected}")
