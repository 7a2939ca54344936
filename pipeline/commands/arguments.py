"""Numbers of a command line, as argparse wants them: what is not allowed ends the command in one line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.cases.own_model import to_train
from loopwright.pipeline.config.params import PARAMS_FILE, sections
from loopwright.pipeline.engine.run_mark import runs_here
from loopwright.pipeline.errors import ParamsError, nearest
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.stages.paths import ARTIFACTS
from loopwright.serving.manifest import Manifest


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """Reads a whole number from ``low`` to ``high``, both included."""
    words = f"a whole number of at least {low}" if high is None else f"a whole number from {low} to {high}"

    def read(text: str) -> int:
        if not text.isdecimal() or int(text) < low or (high is not None and int(text) > high):
            raise argparse.ArgumentTypeError(f"{text!r} is not allowed; give {words}")
        return int(text)

    return read


def real(words: str, allowed: Callable[[float], bool] = lambda _: True) -> Callable[[str], float]:
    """Reads a finite number that is ``allowed``; ``words`` say what that is, with its unit."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or not allowed(value):
            raise argparse.ArgumentTypeError(f"{text!r} is not allowed; give {words}")
        return value

    return read


def positive(unit: str = "") -> Callable[[str], float]:
    """Reads a number above 0."""
    return real("a number above 0" + (f" [{unit}]" if unit else ""), lambda value: value > 0)


def require_made_for(manifest: Manifest, plant: Simulator) -> None:
    """Raise ParamsError where a controller's signals, their units or its period are not the plant's."""
    for name in ("sp", "pv", "dv", "mv"):
        ours = [(s.name, s.unit) for s in getattr(plant, f"{name}_signals")]
        theirs = [(s.name, s.unit) for s in manifest.signals(name)]
        if ours != theirs:
            raise ParamsError(f"the controller's {name} are {theirs}, but plant {plant.name!r} has {ours}")
    if manifest.period_s != plant.period_s:
        raise ParamsError(
            f"the controller's period is {manifest.period_s} s, but plant {plant.name!r} has {plant.period_s}"
        )


def case_of(manifest: Manifest) -> Case:
    """The case that a controller was made for; ParamsError where there is none, or its plant has other signals."""
    cases = all_cases()
    if manifest.case not in cases:
        raise ParamsError(
            f"the controller is for {manifest.case!r}, which is no case here{nearest(manifest.case, cases)}"
        )
    case = cases[manifest.case]
    if not case.ready:
        raise ParamsError(f"{case.name} has no models yet; {to_train(case.name)}")
    require_made_for(manifest, case.plant)
    return case


def require_shipped(file: Path) -> None:
    """Raise ParamsError where a case is named in a controller's place, or its controller is not there.

    It says whether a run has to be begun, or to end.
    """
    case = file.parent.name if file.parent.parent == ARTIFACTS else str(file)
    if file.exists() or not Path(PARAMS_FILE).is_file() or case not in sections("cases"):
        return
    law = file.stem if file.parent.name == case else "LAW"
    when = (
        f"a run is under way in this folder, and its stage `validate {case}-{law}` makes it"
        if runs_here()
        else f"`loopwright run {case}` makes it"
    )
    if law == "LAW":
        raise ParamsError(
            f"{case} is no controller's file; give {ARTIFACTS / case}/LAW.onnx; where there is none, {when}"
        )
    raise ParamsError(f"{file} is not there yet; {when}, unless the law is not shipped")
