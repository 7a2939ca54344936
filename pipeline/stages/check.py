"""Every section of params.yaml read before hours of work depend on it.

A typo in a controller's section would otherwise show only when its own stage runs, after the fits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pipeline.cases import CASES
from pipeline.config.params import (
    CaseParams,
    ControllerParams,
    ModelParams,
    RecordParams,
    choose,
    parse,
    read_section,
    sections,
)
from pipeline.errors import ParamsError, PipelineError
from pipeline.evaluation.case import Case
from pipeline.laws import LAWS
from pipeline.models.local.linearized import LinearizedPart
from pipeline.models.part import Part
from pipeline.models.training.network_parts import trainer_of
from pipeline.optimal.bounds import bounds_path, stored_bounds
from pipeline.stages.excite import excitations
from pipeline.stages.fit import part_of
from pipeline.stages.paths import WORK, record_folder
from serving.errors import LoopwrightError


def mistakes() -> list[str]:
    """One line for every section that its stage would refuse, in the order of the stages."""
    found = []
    for kind, check in CHECKS.items():
        for name in sections(kind):
            try:
                check(name)
            except (PipelineError, OSError, np.linalg.LinAlgError) as error:
                found.append(" ".join(str(error).split()))
    return list(dict.fromkeys(found))  # a record that cannot be read is met by every model set


def notes() -> list[str]:
    """One line for each bound that a report will lack: no mistake, as the report says so and comes without."""
    found = []
    for name in sections("cases"):
        try:
            case = _case_of(name)
            if bounds_path(case).exists():
                found += stored_bounds(case)[1]
            else:
                found.append(f"case {name!r} has no bounds; run `loopwright bounds {name}`")
        except LoopwrightError as error:
            found.append(" ".join(str(error).split()))
    return found


def _case_of(name: str) -> Case:
    params = parse(CaseParams, read_section("cases", name), f"cases.{name}")
    return choose(CASES, name, "case", "cases").with_held_out(params.held_out_seeds)


def _case(name: str) -> None:
    case = _case_of(name)
    _ = case.plant  # raises where its class is abstract
    case.tests()


def _record(name: str) -> None:
    params, where = RecordParams.read(name), f"records.{name}"
    _known_case(params.case, where)
    parse(choose(excitations(CASES[params.case]), params.kind, "excitation", where), params.excitation, where)


def _model(name: str) -> None:
    params, where = ModelParams.read(name), f"models.{name}"
    _known_case(params.case, where)
    for part, values in params.parts.items():
        found = part_of(CASES[params.case], values, f"{where}.parts.{part}")
        trainer = getattr(found, "trainer", None)
        if isinstance(trainer, Mapping):
            try:
                trainer_of(trainer)
            except ParamsError as error:
                raise ParamsError(f"{where}.parts.{part}: {error}") from None
    records = {record_folder(r.case, r.record) for r in map(RecordParams.read, sections("records"))}
    if params.data.is_relative_to(WORK) and params.data not in records:
        raise ParamsError(f"{where}.data is {params.data}, which no record makes; records are {_listed(records)}")
    if not params.data.is_relative_to(WORK) and not params.data.exists():
        raise ParamsError(f"{where}.data is {params.data}, which is not there; give a record's folder or a file")


def _controller(name: str) -> None:
    params, where = ControllerParams.read(name), f"controllers.{name}"
    _known_case(params.case, where)
    law = choose(LAWS, params.law, "law", where)
    forms = {
        where + (f".variants.{form}" if form else ""): {**params.settings, **settings}
        for form, settings in {"": {}, **params.variants}.items()
    }
    read = {place: parse(law.Params, settings, place) for place, settings in forms.items()}
    models = {m.model for m in map(ModelParams.read, sections("models")) if m.case == params.case}
    if params.model not in models:
        raise ParamsError(f"{where}.model is {params.model!r}; {params.case} has the model sets {_listed(models)}")
    plant = CASES[params.case].plant
    parts = {
        k: p.learn(None, plant.signals, {}, 0, plant).model
        for k, p in _parts(params).items()
        if isinstance(p, LinearizedPart)
    }
    for place, settings in read.items():
        try:
            law.check(settings, parts, plant)
        except PipelineError as error:
            raise ParamsError(f"{place}: {error}") from None


def _parts(params: ControllerParams) -> dict[str, Part]:
    """The parts of a controller's model set, as params.yaml describes them; none of one that cannot be read."""
    for name in sections("models"):
        of = ModelParams.read(name)
        if (of.case, of.model) == (params.case, params.model):
            try:
                return {
                    k: part_of(CASES[of.case], values, f"models.{name}.parts.{k}") for k, values in of.parts.items()
                }
            except ParamsError:  # the check of that model set tells it
                return {}
    return {}


def _known_case(case: str, where: str) -> None:
    choose(CASES, case, "case", where)
    if case not in sections("cases"):
        raise ParamsError(f"{where}.case is {case!r}, which has no section under `cases:` of params.yaml; add one")


def _listed(names: Any) -> str:
    return ", ".join(sorted(map(str, names))) or "none"


CHECKS: dict[str, Callable[[str], None]] = {
    "cases": _case,
    "records": _record,
    "models": _model,
    "controllers": _controller,
}
