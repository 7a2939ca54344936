"""The explain graph of a controller, computed for one sample: courses, the next moves, and their parts."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.controller import Controller, session_of
from loopwright.serving.controller_file import read_controller
from loopwright.serving.errors import ArtifactError, ContractError, OutputError
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
from loopwright.serving.ranges import numbers, within

Array: TypeAlias = NDArray[np.float64]
NO_PART = 1e-13  # of an MV's range: a smaller part is none
# Share of an MV's range by which both graphs may differ and be one law. They round apart, and where the plan hardly
# bends rounding grows: on a served tank with three valves for two variables by more than 1e-9.
SAME_MV = 1e-6


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
    ) -> WhatIf:
        """The courses that the law would make after ``changes``, beside what it does without them; nothing is set.

        ``changes`` name set points by their signals, and entries of ``operate`` as these are named. The courses are
        those of the closed loop over the law's own model: the law plans anew at every sample, disturbances stay.
        ContractError for an unknown name, LoopError for a set point and ContractError for another value that is not
        allowed; else as ``step``.
        """
        given = _Given(sp, pv, mv_applied, state, dv, operate, fresh, ahead)
        return WhatIf(dict(changes), self._run(given), self._run(self._changed(given, changes)))

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
        if given.ahead is None or self.manifest.ahead is None:
            return given._replace(sp=sp, operate=operate)
        later = np.array(given.ahead, dtype=np.float64).reshape(self.manifest.ahead.horizon, -1)
        later[:, [i for i, s in enumerate(self.manifest.sp) if s.name in changes]] = 0.0  # it ends their courses
        return given._replace(sp=sp, operate=operate, ahead=later.ravel())

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
        rows = found["parts"].reshape(len(m.mv), len(causes))
        moves = []
        for s, move, row in zip(m.mv, found["move"].tolist(), rows.tolist(), strict=True):
            span = s.high - s.low
            parts = [MovePart(cast("Cause", c), n, v) for (c, n), v in zip(causes, row, strict=True)]
            parts = sorted((p for p in parts if abs(p.value) > NO_PART * span), key=lambda p: -abs(p.value))
            parts = parts or [MovePart("not_in_use", s.name, move) if s.name in idle else MovePart("plan", "", move)]
            words = sentence_of(move, span, parts, news, {s.name: to_rest.get(s.name, 0.0)})
            moves.append(ExplainedMove(s.name, s.unit, move, tuple(parts), words))
        return tuple(moves)

    def _run(self, given: _Given) -> Explanation:
        """The closed loop over the law's model from here: moves of the first step, courses of all."""
        n, outputs, period_s = self.explains.horizon, self.explains.outputs, self.manifest.period_s
        at_first, first = given, self._looked(given)
        found = first
        ys, mvs = [found["y"][:outputs]], [found["mv"]]
        pv = np.array(given.pv, dtype=np.float64, ndmin=1)
        for _ in range(n - 1):
            pv[:outputs] = ys[-1]
            given = self._later(given)
            found = self._looked(given._replace(pv=pv, mv_applied=mvs[-1], state=found["state_next"], fresh=None))
            ys.append(found["y"][:outputs])
            mvs.append(found["mv"])
        ahead, starts = (tuple(period_s * (k + i) for k in range(n)) for i in (1, 0))
        courses = self._courses(ahead, np.array(ys), starts, np.array(mvs))
        return Explanation(period_s, courses, self._moves(first, at_first))

    def _later(self, given: _Given) -> _Given:
        """The inputs a sample on, of what is known to come: the last known values stay."""
        known = self.manifest.ahead
        if given.ahead is None or known is None:
            return given
        n_sp, rows = len(self.manifest.sp), np.asarray(given.ahead, dtype=np.float64).reshape(known.horizon, -1)
        sp = np.array(given.sp, dtype=np.float64, ndmin=1) + rows[0, :n_sp]
        dv = None if given.dv is None else np.array(given.dv, dtype=np.float64, ndmin=1) + rows[0, n_sp:]
        return given._replace(sp=sp, dv=dv, ahead=(np.vstack([rows[1:], rows[-1:]]) - rows[0]).ravel())


class _Given(NamedTuple):
    """Inputs of a step, as a host gives them."""

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
