"""Foresight of the law in charge: what it predicts and plans, why it moves, and what it would do after a change.

The explain graph beside the controller's file is stepped here, in the page's process, on the inputs of the loop's last
step. The loop never steps it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopwright.serving.errors import ContractError, LoopError
from loopwright.serving.fields import is_number

if TYPE_CHECKING:
    from loopwright.serving.explain import Explainer

View = dict[str, Any]


class LawForesight:
    """Computes explanations of the law in charge; from any thread, one at a time.

    Parameters
    ----------
    inputs
        Asks the loop for the inputs of its last step (the request ``inputs``).

    Every answer raises LoopError where the loop gives none, or where no explain graph lies beside the controller's
    file, and ArtifactError where the graph belongs to another controller.
    """

    def __init__(self, inputs: Callable[[], View]) -> None:
        self._inputs = inputs
        self._lock = threading.Lock()
        self._explainer: Explainer | None = None
        self._of = ""  # digest of the controller that it explains
        self._last: View = {}

    def explained(self) -> View:
        """Courses and the parts of the next moves (``Explanation.row``), and the ``time`` of the step."""
        asked = self._asked()
        with self._lock:
            explainer = self._explainer_of(asked)
            if (self._last.get("time"), self._last.get("sha256")) != (asked["time"], asked["sha256"]):
                found = explainer.explain(**_given(asked, explainer)).row()
                self._last = {"time": asked["time"], "sha256": asked["sha256"], **found}
            return self._last

    def what_if(self, changes: Mapping[str, Any]) -> View:
        """Courses after ``changes`` of set points and entries by name, beside those without (``WhatIf.row``).

        ContractError for a value that is no number, or that is not allowed; its ``entry`` names which.
        """
        for name, value in changes.items():
            if not is_number(value):
                error = ContractError(f"{name} is {value!r}; it needs a number")
                error.entry = str(name)
                raise error
        asked = self._asked()
        with self._lock:
            explainer = self._explainer_of(asked)
            given = _given(asked, explainer)
            if "operate" in given:  # as operators have it: the step may have pinned an MV that is out of use
                given["operate"] = asked["operate"]
            return {"time": asked["time"], **explainer.what_if(changes, **given).row()}

    def _asked(self) -> View:
        answer = self._inputs()
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
