"""What the manual takes from the code: a name for each text that ``{generated}`` can ask for."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from manual.commands import commands
from manual.errors import errors
from manual.floors import contracts, floors
from manual.laws import choice, facts, info_names, results
from manual.markdown import code, prose, table
from manual.parameters import parameters, whole
from pipeline.commands.parameters import first_sentence
from pipeline.config.exports import ExportParams
from pipeline.config.params import CaseParams, ControllerParams, ModelParams, RecordParams
from pipeline.config.plants import PlantParams
from pipeline.evaluation.metric import METRICS
from pipeline.evaluation.validation import Validation
from pipeline.excitation import EXCITATIONS
from pipeline.models import MODELS
from pipeline.models.training.fit import TRAINERS
from serving.manifest import Manifest
from serving.station.settings import Settings

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


def _kinds(members: Mapping[str, type]) -> str:
    return "\n\n".join(f"## `{kind}`\n\n{parameters(cls)}" for kind, cls in members.items())


def _models() -> str:
    trainers = "\n\n".join(f"### `{kind}`\n\n{parameters(cls)}" for kind, cls in TRAINERS.items())
    return f"{_kinds(MODELS)}\n\n## Trainers\n\nThe `trainer` of a network is one of these.\n\n{trainers}"


def _metrics() -> str:
    rows = [
        (code(m.name), m.long or m.short, m.unit_of("CV"), m.together, prose(m.floor.text) if m.floor else "")
        for m in METRICS.values()
    ]
    return table(["metric", "meaning", "unit (CV: the controlled variable's)", "of several loops", "noise floor"], rows)


def _list(members: Mapping[str, type]) -> str:
    return table(["name", "what it is"], [(code(name), prose(first_sentence(cls))) for name, cls in members.items()])


GENERATED: dict[str, Callable[..., str]] = {
    "commands": commands,
    "contracts": contracts,
    "errors": errors,
    "excitations": lambda: _kinds(EXCITATIONS),
    "floors": floors,
    "info": info_names,
    "law": facts,
    "laws": choice,
    "loop.toml": lambda: _file(Settings),
    "manifest": lambda: _file(Manifest),
    "metrics": _metrics,
    "models": _models,
    "params": _params,
    "results": results,
    "validation": lambda: _file(Validation),
}
"""Name -> function that gives Markdown; ``law`` and ``results`` take the law's name."""
