"""Foresight of the law in charge: what it predicts and plans, why it moves, and what it would do after a change.

The explain graph beside the controller's file is stepped here, in the page's process, on the inputs of the loop's last
step. The loop never steps it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import ContractError, LoopError
from loopwright.serving.fields import is_number
from loopwright.serving.preview.course import Courses
from loopwright.serving.preview.course_file import AskedCourse, asked_course

if TYPE_CHECKING:
    from loopwright.serving.explain import Explainer

Array: TypeAlias = NDArray[np.float64]
View = dict[str, Any]


class LawForesight:
    """Computes explanations of the law in charge; from any thread, one at a time.

    Parameters
    ----------
    ask
        Asks the loop for the inputs of its last step (the request ``inputs``), and for the courses too (``future``).

    Every answer raises LoopError where the loop gives none, or where no explain graph lies beside the controller's
    file, and ArtifactError where the graph belongs to another controller.
    """

    def __init__(self, ask: Callable[[View], View]) -> None:
        self._ask = ask
        self._lock = threading.Lock()
        self._explainer: Explainer | None = None
        self._of = ""  # digest of the controller that it explains
        self._last: View = {}

    def explained(self) -> View:
        """Courses and the parts of the next moves (``Explanation.row``), and the ``time`` of the step."""
        asked = self._asked("inputs")
        with self._lock:
            explainer = self._explainer_of(asked)
            if (self._last.get("time"), self._last.get("sha256")) != (asked["time"], asked["sha256"]):
                found = explainer.explain(**_given(asked, explainer)).row()
                self._last = {"time": asked["time"], "sha256": asked["sha256"], **found}
            return self._last

    def what_if(self, changes: Mapping[str, Any], course: Any = None, speed: float = 1.0) -> View:
        """Courses after ``changes`` of set points and entries by name, beside those without (``WhatIf.row``).

        ``time`` is that of the step that they begin with, ``course_s`` [s] the last point of the ``course`` from there.
        ``course`` gives or ends courses, as the request ``course`` of a loop does that runs ``speed`` times as fast as
        the clock. Those that stand go on in both.

        ContractError for a value that is no number, or that is not allowed, and LoopError for a course that the loop
        would refuse; its ``entry`` names which.
        """
        for name, value in changes.items():
            if not is_number(value):
                error = ContractError(f"{name} is {value!r}; it needs a number")
                error.entry = str(name)
                raise error
        given = AskedCourse({}) if course is None else asked_course(course, time.time(), speed)
        asked = self._asked("future")
        with self._lock:
            explainer = self._explainer_of(asked)
            inputs = _given(asked, explainer)
            if "operate" in inputs:  # as operators have it: the step may have pinned an MV that is out of use
                inputs["operate"] = asked["operate"]
            inputs["ahead"] = _standing(asked, explainer, inputs)
            inputs |= {"course": given.points, "straight": given.straight, "ended": given.ended}
            try:
                found = explainer.what_if(changes, **inputs)
            except LoopError as error:
                error.entry = "csv" if given.filed else error.entry
                raise
            last = max((float(t) for points in given.points.values() for t, _ in points), default=0.0)
            return {"time": asked["time"], "course_s": last, **found.row()}

    def _asked(self, what: str) -> View:
        answer = self._ask({"do": what})
        if "error" in answer:
            raise LoopError(str(answer["error"]))
        return answer

    def _explainer_of(self, asked: View) -> Explainer:
        if self._explainer is None or self._of != asked["sha256"]:
            from loopwright.serving.explain import Explainer  # here: it brings onnxruntime
            from loopwright.serving.explain.explain_file import explain_path

            path = explain_path(Path(asked["file"]))
            if not path.is_file():
                raise LoopError(
                    f"{path.name} does not lie beside the controller's file; designing the controller writes it"
                )
            self._explainer, self._of = Explainer(path, asked["sha256"]), asked["sha256"]
        return self._explainer


def _given(asked: View, explainer: Explainer) -> dict[str, Any]:
    """The inputs of a step for a law that may read fewer signals than the loop."""
    inputs = dict(asked["inputs"])
    for name, group in (("pv", "pv"), ("fresh", "pv"), ("dv", "dv")):
        if name in inputs:
            known = asked["signals"][group]
            inputs[name] = [inputs[name][known.index(s.name)] for s in explainer.manifest.signals(group)]
    if "ahead" in inputs:  # of the loop's set points and measured disturbances, sample by sample
        n_sp, known = len(explainer.manifest.sp), asked["signals"]["dv"]
        own = [*range(n_sp), *(n_sp + known.index(s.name) for s in explainer.manifest.dv)]
        width = n_sp + len(known)
        inputs["ahead"] = [inputs["ahead"][k + i] for k in range(0, len(inputs["ahead"]), width) for i in own]
    return inputs


def _standing(asked: View, explainer: Explainer, inputs: View) -> Array | None:
    """``ahead`` (K n,) of the courses that stand, for as long as a what-if may go on; None without one."""
    from loopwright.serving.explain.explainer import MOST_SAMPLES  # here: it brings onnxruntime

    m = explainer.manifest
    read = {s.name for s in (*m.sp, *m.dv)}
    stand = [of for of in asked["courses"] if of["signal"] in read]
    if m.ahead is None or not stand:
        return None
    courses = Courses(m)
    courses.give({of["signal"]: of["points"] for of in stand}, [of["signal"] for of in stand if of["straight"]])
    return courses.ahead(m, np.array(inputs["sp"]), inputs.get("dv"), MOST_SAMPLES + m.ahead.horizon)
