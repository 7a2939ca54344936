"""The page's knowledge of a case: signals, parameters, where it starts, its tests and its controllers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.pictures.words import law_name
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving.controller import Controller
from loopwright.serving.manifest import Signal

SLIDER_SHARE = 0.2  # a slider goes so far to both sides of a parameter's value
MIDDLE_SPAN = 1.0  # of a slider whose parameter is 0


def about(case: Case, controllers: Sequence[Controller], validation: Validation | None) -> dict[str, Any]:
    """JSON-ready; the page's script says what it does with each entry."""
    plant = case.equations
    tests = {name: found[0] for name, found in case.tests().items() if found[0].plant is None}
    return {
        "case": case.name,
        "title": case.title,
        "period_s": plant.period_s,
        **{name: _signals(getattr(plant, f"{name}_signals")) for name in ("sp", "pv", "dv", "mv")},
        "dv_nominal": plant.dv_nominal.tolist(),
        "noise_std": case.noise_std.tolist(),
        "noise_colour": plant.noise_colour.tolist(),
        "parameters": _parameters(case, plant, tests),
        "tests": [_by_hand(plant, tests), *(_test(plant, test) for test in tests.values())],
        "controllers": [_controller(controller, validation) for controller in controllers],
        "beside": _first_two(case, controllers, validation),
    }


def _signals(signals: Sequence[Signal]) -> list[dict[str, Any]]:
    return [s.to_dict() for s in signals]


def _parameters(case: Case, plant: EquationPlant, tests: Mapping[str, Scenario]) -> list[dict[str, Any]]:
    """Each parameter with its slider's ends: those of the case, or so far that its tests' values are within."""
    rows = []
    stated, units = case.ranges_of(plant), plant.parameter_units()
    for name, value in zip(plant.parameter_names(), plant.parameters().tolist(), strict=True):
        moved = [v for test in tests.values() if name in test.changes for v in test.changes[name].tolist()]
        low, high = stated.get(name) or _around(value, moved)
        row = {"name": name, "unit": units[name], "value": value, "low": low, "high": high, "tested": bool(moved)}
        rows.append(row)
    return rows


def _around(value: float, moved: Sequence[float]) -> tuple[float, float]:
    span = SLIDER_SHARE * abs(value) or MIDDLE_SPAN
    return min(value - span, *moved, value), max(value + span, *moved, value)


def _test(plant: EquationPlant, test: Scenario) -> dict[str, Any]:
    """A test's start, and its course: (sample, what, which, value) wherever something moves."""
    places = {name: i for i, name in enumerate(plant.parameter_names())}
    course = [
        *_moves("sp", test.sp.T),
        *(("p", places[name], k, v) for name, values in test.changes.items() for _, _, k, v in _moves("p", [values])),
        *_moves("dv", [] if test.dv is None else test.dv.T),
    ]
    return {
        "name": test.name,
        "title": test.title,
        "samples": test.samples,
        "x0": test.x0.tolist(),
        "mv0": test.mv0.tolist(),
        "course": [[k, what, i, value] for what, i, k, value in sorted(course, key=lambda row: row[2])],
    }


def _by_hand(plant: EquationPlant, tests: Mapping[str, Scenario]) -> dict[str, Any]:
    """The start of the first test, after which nothing moves by itself; without tests, that of the plant."""
    if tests:
        start = _test(plant, next(iter(tests.values())))
    else:
        x, mv = plant.start
        start = _test(plant, Scenario("start", "", plant.measure(x)[None, : len(plant.sp_signals)], x, mv))
    course = [row for row in start["course"] if row[0] == 0]
    return {**start, "name": "by hand", "title": "By hand: nothing moves by itself", "course": course}


def _moves(what: str, columns: Sequence[Array] | Array) -> list[tuple[str, int, int, float]]:
    rows = []
    for i, values in enumerate(columns):
        moved = np.flatnonzero(np.diff(values, prepend=np.nan))  # the first sample is one: NaN equals nothing
        rows += [(what, i, int(k), float(values[k])) for k in moved]
    return rows


def _controller(controller: Controller, validation: Validation | None) -> dict[str, Any]:
    name = controller.path.stem
    short, title = law_name(name), "" if validation is None else validation.titles.laws.get(name, "")
    manifest = json.loads(controller.manifest.to_json())
    return {
        "name": name,
        "short": short,
        "title": title if title.casefold() != short.casefold() else "",
        "file": controller.path.name,
        "sha256": controller.sha256,
        **{key: manifest[key] for key in ("schema", "law", "period_s", "n_state", "info", "inputs")},
        **{key: manifest[key] for key in ("sp", "pv", "dv", "mv", "operate", "ahead") if key in manifest},
    }


def _first_two(case: Case, controllers: Sequence[Controller], validation: Validation | None) -> list[str]:
    """The controllers that stand side by side at first: the best, and the case's baseline."""
    names = [controller.path.stem for controller in controllers]
    wanted = [None if validation is None else validation.best, case.baseline, *names]
    ranked = list(dict.fromkeys(name for name in wanted if name in names))
    return (ranked * 2)[:2]


def validation_of(folder: Path) -> Validation | None:
    """The case's figures beside its controllers; None where it has none yet."""
    path = folder / "validation.json"
    return Validation.read(path) if path.is_file() else None
