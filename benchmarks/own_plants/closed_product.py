"""The product's way from the file of a historian to a controller: all of it, as a user goes, or the fit alone."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from _project import new_and_run
from closed_plant import ClosedPlant
from closed_record import roles
from loops import Steps
from plant import OwnPlant
from torch import Tensor

from loopwright.pipeline.workbench import PlantData, design, identify, screen
from loopwright.serving.controller import Controller
from loopwright.serving.errors import OutputError


class Paced:
    """A law whose period is longer than the plant's sampling: between two of its steps the MV stays."""

    def __init__(self, law: Steps, periods: float) -> None:
        self.law, self.periods, self.n_state = law, periods, law.n_state + 1

    def __call__(self, sp: Tensor, pv: Tensor, dv: Tensor, mv: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One sample; shapes as of any law."""
        k = float(state[..., 0].max())
        count = state[..., :1] + 1
        if k and int(k / self.periods + 1e-9) == int((k - 1) / self.periods + 1e-9):
            return mv, torch.cat([count, state[..., 1:]], dim=-1), pv[..., :0]
        moved, after, _ = self.law(sp, pv, dv, mv, state[..., 1:])
        return moved, torch.cat([count, after], dim=-1), pv[..., :0]


class Shipped:
    """A shipped file, stepped by the runtime as on a plant; where it refuses a step the MV stays, which is counted."""

    def __init__(self, file: Path) -> None:
        self.controller = Controller(file)
        self.n_state, self.refused = self.controller.manifest.n_state, 0

    def __call__(self, sp: Tensor, pv: Tensor, dv: Tensor, mv: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step of each test (tests, ...), one after the other."""
        moved, after = mv.clone(), state.clone()
        for i in range(len(mv)):
            given = {"sp": sp[i], "pv": pv[i], "dv": dv[i], "mv_applied": mv[i], "state": state[i]}
            try:
                step = self.controller.step(**{name: value.numpy() for name, value in given.items()})
            except OutputError:
                self.refused += 1
                continue
            moved[i], after[i] = torch.from_numpy(step.mv), torch.from_numpy(step.state)
        return moved, after, pv[..., :0]


@dataclass(frozen=True, slots=True)
class Delivered:
    """What came of a file: controllers by name, what was said, and the processor time [s]."""

    laws: dict[str, Steps]
    said: list[str]
    seconds: float
    files: dict[str, Path] = field(default_factory=dict)


def paced(plant: OwnPlant, law: Steps, period_s: float) -> Steps:
    """The law at its own period on the plant."""
    periods = period_s / plant.period_s
    return law if abs(periods - 1) < 1e-6 else Paced(law, periods)


def read(file: Path, options: Sequence[str]) -> PlantData:
    """``file`` as `loopwright new NAME FILE` with these options; RecordError where there is no record at all."""
    given: dict[str, list[str]] = {}
    for option, words in zip(options[::2], options[1::2], strict=True):
        given.setdefault(option.removeprefix("--"), []).append(words)
    return screen(file, **given)


def verdict(found: PlantData) -> str:
    """Whether the readings can carry a model."""
    assert found.screened is not None
    return found.screened.report.verdict.carries


def by_fit(plant: ClosedPlant, file: Path) -> Delivered:
    """The predictive law on a model of the record: no tests, no gates; what they would have said is told."""
    began = time.process_time()
    found = read(file, roles(plant))
    said = [f"new: {verdict(found)}{f', refused: {found.refused}' if found.refused else ''}"]
    fit = identify(found)
    said += [f"proof: {fit.doubts or 'holds'}"]
    law = paced(plant, design("predictive", fit), found.signals.period_s)
    return Delivered({"predictive": law}, said, time.process_time() - began)


@dataclass(frozen=True, slots=True)
class Columns:
    """The options of `loopwright new` that say what a file's columns are, and their names in the plant's order."""

    options: Sequence[str]
    pv: Sequence[str]
    mv: Sequence[str]


def columns_of(plant: ClosedPlant) -> Columns:
    """Of the file of a historian, as the plant's people would name them."""
    return Columns(roles(plant), [f"{o.tag}.PV" for o in plant.loops], [f"{o.tag}.OP" for o in plant.loops])


def by_run(plant: OwnPlant, file: Path, project: Path, columns: Columns) -> Delivered:
    """`loopwright new` and `loopwright run` in a fresh project, and the files that are shipped there."""
    done = new_and_run(project, plant.name, [file], columns.options)
    laws = {name: shipped(plant, path, columns) for name, path in done.files.items()}
    return Delivered(laws, done.said, done.seconds, done.files)


def shipped(plant: OwnPlant, file: Path, columns: Columns) -> Steps:
    """A shipped file as a law for the plant; its signals must come in the plant's order."""
    law = Shipped(file)
    manifest = law.controller.manifest
    for role, names in (("pv", columns.pv), ("mv", columns.mv)):
        found = [s.name for s in manifest.signals(role)]
        assert found == list(names), f"{file}: {role} is {found}, not {names}"
    return paced(plant, law, manifest.period_s)
