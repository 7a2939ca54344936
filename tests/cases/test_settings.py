"""Every form of a law that a case asks for, by its settings, is one that params.yaml has."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.config.params import ControllerParams, sections
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.law_evidence import BASE, Form, LawEvidence, LawMetrics


def asked(value: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Every (law, setting) in a value."""
    if getattr(value, "law", None) and getattr(value, "setting", None):
        yield value.law, value.setting
    inner: Any = ()
    if isinstance(value, Mapping):
        inner = value.values()
    elif isinstance(value, (tuple, list)):
        inner = value
    elif is_dataclass(value) and not isinstance(value, (type, Case)):
        inner = (getattr(value, f.name) for f in fields(value))
    for one in inner:
        yield from asked(one)


def modules(case: Case) -> list[ModuleType]:
    """The module of the case and those beside it that claim or draw."""
    folder, _, own = type(case).__module__.rpartition(".")
    names = [own, *(own.replace("case", beside) for beside in ("paper", "pictures"))]
    return [importlib.import_module(f"{folder}.{n}") for n in names if find_spec(f"{folder}.{n}")]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_every_form_that_a_case_asks_for_is_run(case: Case) -> None:
    laws = {}
    for name in sections("controllers"):
        params = ControllerParams.read(name)
        if params.case == case.name:
            forms = {form: Form(own, (), {}) for form, own in {BASE: params.settings, **params.variants}.items()}
            laws[params.name] = LawEvidence(LawMetrics(params.name, "", case.metric, (0,), 0, forms), Path())
    places = [vars(module) for module in modules(case)]
    wanted = [row for place in (*places, case.requirements, case.tables, case.figures) for row in asked(place)]
    lacking = [(law, setting) for law, setting in wanted if law in laws and laws[law].form_of(setting) is None]
    assert lacking == []
