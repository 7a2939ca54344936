"""The cases by name, and their plants: adding one is a folder here and a line below.

The figures and claims of a case are in its ``paper`` module, own kinds of model and excitations in
``models`` and ``excitations``; ``beside`` loads them, so that the list itself needs neither torch nor matplotlib.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from loopwright.pipeline.cases.batch_reactor.case import BatchReactorCase
from loopwright.pipeline.cases.henson_seborg_cstr.case import HensonSeborgCstrCase
from loopwright.pipeline.cases.jacketed_batch_reactor.case import JacketedBatchReactorCase
from loopwright.pipeline.cases.own_plant import own_case
from loopwright.pipeline.cases.own_simulator import simulated_case
from loopwright.pipeline.cases.ph_neutralization.case import PhNeutralizationCase
from loopwright.pipeline.cases.ph_neutralization.case_15s import PhNeutralization15sCase
from loopwright.pipeline.cases.reversible_cstr.case import ReversibleCstrCase
from loopwright.pipeline.cases.thiosulfate_cstr.case import ThiosulfateCstrCase
from loopwright.pipeline.config.params import PARAMS_FILE, sections
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.plants.simulator import Simulator

CASES: dict[str, Case] = {
    ThiosulfateCstrCase.name: ThiosulfateCstrCase(),
    PhNeutralizationCase.name: PhNeutralizationCase(),
    PhNeutralization15sCase.name: PhNeutralization15sCase(),
    BatchReactorCase.name: BatchReactorCase(),
    HensonSeborgCstrCase.name: HensonSeborgCstrCase(),
    JacketedBatchReactorCase.name: JacketedBatchReactorCase(),
    ReversibleCstrCase.name: ReversibleCstrCase(),
}

PLANTS: dict[str, type[Simulator]] = {
    plant.name: plant for case in CASES.values() for plant in (case.plant_class, *case.further_plants)
}


def all_cases() -> dict[str, Case]:
    """CASES, and after them the own plants of params.yaml, where there is one here."""
    own = sections("plants") if PARAMS_FILE.exists() else ()
    return {**CASES, **{name: _own(name) for name in own}}


def _own(name: str) -> Case:
    return simulated_case(name) if PlantParams.read(name).simulator else own_case(name)


def beside(case: Case, module: str, name: str, default: Any) -> Any:
    """``name`` in the module that stands beside the case: ``paper`` of case.py, ``paper_15s`` of case_15s.py.

    ``default`` where there is no such module.
    """
    package, _, own = type(case).__module__.rpartition(".")
    if "case" not in own:
        return default
    path = f"{package}.{own.replace('case', module, 1)}".lstrip(".")
    return default if importlib.util.find_spec(path) is None else getattr(importlib.import_module(path), name)


__all__ = ["CASES", "PLANTS", "all_cases", "beside"]
