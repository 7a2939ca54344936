"""Every section of params.yaml read before hours of work depend on it.

A typo in a controller's section would otherwise show only when its own stage runs, after the fits.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from fnmatch import fnmatch
from typing import Any

import numpy as np

from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.cases.operated_tests import check_operated
from loopwright.pipeline.cases.own_ensemble import MEMBERS, OwnEnsemble
from loopwright.pipeline.cases.own_model import LAW_PART, MODEL_SET
from loopwright.pipeline.config.exports import ExportParams, is_exported, screened_record
from loopwright.pipeline.config.params import (
    CaseParams,
    ControllerParams,
    ModelParams,
    RecordParams,
    choose,
    parse,
    read_section,
    sections,
)
from loopwright.pipeline.config.plants import PlantParams, own_plants
from loopwright.pipeline.errors import ParamsError, PipelineError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.historian.cleaning.tags import check_tags
from loopwright.pipeline.historian.export_params import check_agreement, check_period, signal_tags
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.laws.suitability import require_fit
from loopwright.pipeline.models.local_models import LinearizedPart
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.models.training.network_parts import trainer_of
from loopwright.pipeline.optimal.bounds import bounds_path, stored_bounds
from loopwright.pipeline.stages.excite import excitations
from loopwright.pipeline.stages.fit import parts_of
from loopwright.pipeline.stages.paths import DATA, WORK, record_folder
from loopwright.serving.errors import LoopwrightError

REPORT = "screening.json"
FROM_A_WHEEL = (
    "loopwright is installed from a wheel, which holds no bounds of cases; "
    "`pip install -e '.[pipeline]'` in this clone brings them"
)


def mistakes() -> list[str]:
    """One line for every section that its stage would refuse, in the order of the stages."""
    lines = []
    for kind, check in CHECKS.items():
        for name in sections(kind):
            try:
                check(name)
            except (PipelineError, OSError, np.linalg.LinAlgError) as error:
                lines.append(" ".join(str(error).split()))
    for name in own_plants():
        try:
            _plant(name)
        except (PipelineError, OSError) as error:
            lines.append(" ".join(str(error).split()))
    return list(dict.fromkeys(lines))  # a record that cannot be read is met by every model set


def notes() -> list[str]:
    """One line for what may be missing on purpose: cases without a section, bounds that a report will lack."""
    unused = [name for name in all_cases() if name not in sections("cases")]
    lines = [f"params.yaml has no section for {_listed(unused)}: the case takes no part"] if unused else []
    for name in sections("cases"):
        try:
            case = _case_of(name)
            if bounds_path(case).exists():
                lines += stored_bounds(case)[1]
            elif "site-packages" in bounds_path(case).parts:
                lines.append(FROM_A_WHEEL)
            elif not case.on_models:
                lines.append(f"case {name!r} has no bounds; run `loopwright bounds {name}`")
        except LoopwrightError as error:
            lines.append(" ".join(str(error).split()))
    lines += [line for name in sections("controllers") if (line := _withheld(name))]
    return list(dict.fromkeys(lines))


def _withheld(controller: str) -> str:
    """Why a controller of a plant without equations will not be designed; empty where it will be."""
    params = ControllerParams.read(controller)
    case = all_cases()[params.case]
    law, where = LAWS[params.law], f"controllers.{controller}"
    try:
        if case.ready:
            require_fit(law, case.plant)
            if case.on_models:
                law.check(parse(law.Params, params.settings, where), {}, case.plant)
    except (PipelineError, np.linalg.LinAlgError) as error:
        why = " ".join(str(error).split())
        return f"{where}: {why if 'is withheld: ' in why else f'law {params.law!r} is withheld: {why}'}"
    return ""


def _case_of(name: str) -> Case:
    params = parse(CaseParams, read_section("cases", name), f"cases.{name}")
    case = choose(all_cases(), name, "case", "cases")
    check_operated(case, params.operated)
    return case.with_held_out(params.held_out_seeds)


def _case(name: str) -> None:
    case = _case_of(name)
    _ = case.plant  # raises where its class is abstract
    if not case.ready:
        return
    case.tests()
    if not case.development():
        raise ParamsError(f"case {name!r} has no development sequences; without them no controller can be chosen")


def _export(name: str) -> None:
    params = ExportParams.read(name)
    if name not in sections("plants"):
        raise ParamsError(
            f"exports.{name} has no section plants.{name}; `loopwright new {name} ...` writes both, or remove it"
        )
    plant = PlantParams.read(name)
    tags = signal_tags(params.tags)
    check_tags(tags, f"exports.{name}.tags")
    check_agreement(params, plant, tags)
    period_s = params.period_s or _screened_period(name)
    if period_s is not None:
        check_period(params, plant, period_s)


def _screened_period(name: str) -> float | None:
    """The sampling period [s] of a plant's record, as the last screening made it; None where there was none."""
    for report in (screened_record(name).with_name(REPORT), DATA / name / REPORT):
        if report.is_file():
            return float(json.loads(report.read_text(encoding="utf-8"))["period_s"])
    return None


def _record(name: str) -> None:
    params, where = RecordParams.read(name), f"records.{name}"
    _known_case(params.case, where)
    parse(choose(excitations(all_cases()[params.case]), params.kind, "excitation", where), params.excitation, where)


def _model(name: str) -> None:
    params, where = ModelParams.read(name), f"models.{name}"
    _known_case(params.case, where)
    for name, part in parts_of(params, where).items():
        trainer = getattr(part, "trainer", None)
        if isinstance(trainer, Mapping):
            try:
                trainer_of(trainer)
            except ParamsError as error:
                raise ParamsError(f"{where}.parts.{name}: {error}") from None
    if params.case in own_plants() and params.model == MODEL_SET:
        lacking = [] if LAW_PART in params.parts else [f"{LAW_PART}, the model that laws are designed on"]
        if not any(fnmatch(f"{part}.npz", MEMBERS) for part in params.parts):
            lacking.append("plant1, plant2, ..., the models that controllers are tested on")
        if lacking:
            raise ParamsError(f"{where}.parts lacks {' and '.join(lacking)}; add it, of kind {LAW_PART}")
    records = {record_folder(r.case, r.record) for r in map(RecordParams.read, sections("records"))}
    records |= {screened_record(plant) for plant in sections("exports")}
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
    sets = {name: ModelParams.read(name) for name in sections("models")}
    models = {m.model: (name, m) for name, m in sets.items() if m.case == params.case}
    if params.model not in models:
        raise ParamsError(f"{where}.model is {params.model!r}; {params.case} has the model sets {_listed(models)}")
    name, model_set = models[params.model]
    try:
        described = parts_of(model_set, f"models.{name}")
    except ParamsError:  # the check of that model set says so
        described = {}
    case = all_cases()[params.case]
    plant = case.plant
    parts = {
        k: p.learn(Source(None, plant.signals, plant=plant)).model
        for k, p in described.items()
        if isinstance(p, LinearizedPart)
    }
    for place, settings in read.items():
        lacking = [part for part in law.needs(settings, described) if described and part not in described]
        if lacking:
            raise ParamsError(
                f"{place}: law {params.law!r} needs a part {lacking[0]!r}; model set {params.model!r} has "
                f"{_listed(described)}: add it to `models.{name}.parts`, or name another set"
            )
        try:
            law.check_settings(settings, plant.signals)
            # What the models of an own plant do not allow withholds the law, and is no mistake: see `notes`.
            if case.ready and not case.on_models:
                law.check(settings, parts, plant)
        except PipelineError as error:
            raise ParamsError(f"{place}: {error}") from None


def _plant(name: str) -> None:
    params = PlantParams.read(name)
    if not is_exported(name) and not params.data.is_file():
        raise ParamsError(f"plants.{name}.data is {params.data}, which is not there; `loopwright new` writes it")
    case = all_cases().get(name)
    if not is_exported(name) and isinstance(case, OwnEnsemble):
        _ = case.record  # RecordError where it is not that of the plant, its signals and its period


def _known_case(case: str, where: str) -> None:
    choose(all_cases(), case, "case", where)
    if case not in sections("cases"):
        raise ParamsError(f"{where}.case is {case!r}, which has no section under `cases:` of params.yaml; add one")


def _listed(names: Any) -> str:
    return ", ".join(sorted(map(str, names))) or "none"


CHECKS: dict[str, Callable[[str], None]] = {
    "cases": _case,
    "exports": _export,
    "records": _record,
    "models": _model,
    "controllers": _controller,
}
