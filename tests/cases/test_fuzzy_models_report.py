"""What the report says of hybrid fuzzy models: checks that can fail, and pictures that draw what is there."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from pipeline.cases.jacketed_batch_reactor.fuzzy_models import (
    coefficients_picture,
    cold_authority,
    drift_when_shut,
    one_step_errors_as,
    printed_gap,
    reach_picture,
    ties_close_the_gap,
)
from pipeline.cases.jacketed_batch_reactor.jacket_pulses import JacketPulses
from pipeline.cases.jacketed_batch_reactor.models import PrintedFuzzyPart, printed_model
from pipeline.cases.jacketed_batch_reactor.plant import JacketedBatchReactor
from pipeline.models.fuzzy.hybrid_fuzzy_part import HybridFuzzyPart
from pipeline.models.part import Part

INDEPENDENT = {"local": 0.18, "global": 0.070, "tied": 0.076}
CHECKS = (
    one_step_errors_as("fuzzy", INDEPENDENT),
    ties_close_the_gap("fuzzy"),
    printed_gap("fuzzy", 1.4),
    cold_authority("fuzzy", 20, 3.6),
)


@pytest.fixture(scope="module")
def measured() -> dict[str, Any]:
    """metrics.json of a set, as the fit stage writes it."""
    plant = JacketedBatchReactor()
    record = JacketPulses(samples=12_000).run(plant, 0)
    ways: Any = ("tied", "global", "local")
    parts: dict[str, Part] = {w: HybridFuzzyPart(identification=w, centres=(12, 20, 40, 60, 70)) for w in ways}
    parts["printed"] = PrintedFuzzyPart()
    return {
        "parts": {
            name: {"median": part.learn(record, plant.signals, {}, 0, plant).metrics} for name, part in parts.items()
        }
    }


def told(models: dict[str, Any]) -> Any:
    return SimpleNamespace(models=models)


def test_what_was_measured_holds(measured: dict[str, Any]) -> None:
    verdicts = [check(told({"fuzzy": measured})) for check in CHECKS]
    assert [v.holds for v in verdicts] == [True] * 4
    assert "tied 0.00" in verdicts[1].measured
    assert verdicts[3].measured.startswith("-0.70 printed, -2.68")


def test_other_figures_do_not_hold(measured: dict[str, Any]) -> None:
    other = copy.deepcopy(measured)
    other["parts"]["tied"]["median"]["rmse"] *= 1.5
    other["parts"]["tied"]["median"]["gap"] = 0.1
    other["parts"]["printed"]["median"]["gap"] = 0.5
    other["parts"]["printed"]["median"]["parameters"]["b_cold_20"] = -2.6
    assert [check(told({"fuzzy": other})).holds for check in CHECKS] == [False] * 4


def test_a_shut_throttle_drifts_by_what_the_coefficients_say(measured: dict[str, Any]) -> None:
    """Between two centres, in both modes; tied modes drift alike."""
    evidence, part = told({"fuzzy": measured}), printed_model()
    now = torch.tensor([[26.0]], dtype=torch.float64)
    expected = part.jacket(now, now).base[0] - 26.0
    assert drift_when_shut(evidence, "fuzzy", "printed", 26.0) == pytest.approx(tuple(expected.tolist()))
    hot, cold = drift_when_shut(evidence, "fuzzy", "tied", 26.0) or (0.0, 1.0)
    assert hot == pytest.approx(cold)
    assert drift_when_shut(told({}), "fuzzy", "tied", 26.0) is None


def test_nothing_measured_is_no_verdict(measured: dict[str, Any]) -> None:
    for models in ({}, {"fuzzy": {"parts": {"tied": measured["parts"]["tied"]}}}):
        assert [check(told(models)).holds for check in CHECKS] == [None] * 4
    assert reach_picture("fuzzy")(told({})) is None
    assert coefficients_picture("fuzzy")(told({})) is None


def test_the_pictures_show_every_identification(measured: dict[str, Any]) -> None:
    evidence = told({"fuzzy": measured})
    reach = reach_picture("fuzzy")(evidence)
    assert reach is not None
    titles = [axes.get_title(loc) for axes in reach.axes for loc in ("left", "center")]
    assert [t.split(":")[0] for t in titles if t] == ["printed", "local", "global", "tied"]
    assert "tied: nothing out of reach" in titles
    coefficients = coefficients_picture("fuzzy")(evidence)
    assert coefficients is not None
    assert [len(axes.lines) >= 10 for axes in coefficients.axes] == [True] * 4
