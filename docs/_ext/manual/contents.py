"""The parts of the manual that come from the code: a name for each text that ``{generated}`` can ask for."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from loopwright.pipeline.cases import CASES, beside
from loopwright.pipeline.config.exports import ExportParams
from loopwright.pipeline.config.params import CaseParams, ControllerParams, ModelParams, RecordParams
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.evaluation.metric import METRICS
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.excitation import EXCITATIONS
from loopwright.pipeline.models import MODELS
from loopwright.pipeline.models.training.fit import TRAINERS
from loopwright.serving.manifest import Manifest
from loopwright.serving.station.settings import Settings
from manual.commands import commands
from manual.errors import errors
from manual.floors import contracts, floors
from manual.laws import choice, facts, info_names, results
from manual.markdown import code, prose, table
from manual.modes import modes
from manual.parameters import parameters, whole
from manual.thresholds import thresholds

SECTIONS = {
    "cases": CaseParams,
    "records": RecordParams,
    "models": ModelParams,
    "controllers": ControllerParams,
    "plants": PlantParams,
    "exports": ExportParams,
}
"""Section of params.yaml -> what an entry of it is read as."""


def _file(cls: type) -> str:
    """A file's keys; a heading comes first, because Sphinx puts text before it behind all sections."""
    return f"## The whole file\n\n{whole(cls, depth=2)}"


def _params() -> str:
    return "\n\n".join(f"## `{name}`\n\n{whole(cls)}" for name, cls in SECTIONS.items())


OF_CASES: dict[str, dict[str, type]] = {
    what: {kind: cls for case in CASES.values() for kind, cls in beside(case, what, what.upper(), {}).items()}
    for what in ("models", "excitations")
}
"""Kinds that a single case has."""


def _kinds(members: Mapping[str, type], of_cases: Mapping[str, type]) -> str:
    own = [f"### `{kind}`\n\n{parameters(cls)}" for kind, cls in of_cases.items()]
    return "\n\n".join(
        [
            *(f"## `{kind}`\n\n{parameters(cls)}" for kind, cls in members.items()),
            "## Kinds of single cases",
            "Only records and model sets of their own case take these.",
            *own,
        ]
    )


def _models() -> str:
    trainers = [f"### `{kind}`\n\n{parameters(cls)}" for kind, cls in TRAINERS.items()]
    kinds = _kinds(MODELS, OF_CASES["models"])
    return "\n\n".join([kinds, "## Trainers", "The `trainer` of a network is one of these.", *trainers])


def _metrics() -> str:
    rows = [
        (code(m.name), m.long or m.short, m.unit_of("CV"), m.together, prose(m.floor.text) if m.floor else "")
        for m in METRICS.values()
    ]
    head = ["metric", "meaning", "unit (CV: the controlled variable's)", "of several loops", "noise floor"]
    own = [
        (code(name), code(m.name), m.long or m.short, m.unit, m.together)
        for name, case in CASES.items()
        for m in case.own_metrics
    ]
    return "\n\n".join(
        [
            table(head, rows),
            "## Of single cases",
            table(["case", "metric", "meaning", "unit", "of several loops"], own),
        ]
    )


GENERATED: dict[str, Callable[..., str]] = {
    "commands": commands,
    "contracts": contracts,
    "errors": errors,
    "excitations": lambda: _kinds(EXCITATIONS, OF_CASES["excitations"]),
    "floors": floors,
    "info": info_names,
    "law": facts,
    "laws": choice,
    "loop.toml": lambda: _file(Settings),
    "manifest": lambda: _file(Manifest),
    "metrics": _metrics,
    "models": _models,
    "modes": modes,
    "params": _params,
    "results": results,
    "thresholds": thresholds,
    "validation": lambda: _file(Validation),
}
"""Name -> function that gives Markdown; ``law`` and ``results`` take the law's name."""
