"""What the report says of hybrid fuzzy models: checks that can fail, and pictures that draw what is there."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.jacketed_batch_reactor.excitations import JacketPulses
from loopwright.pipeline.cases.jacketed_batch_reactor.fuzzy_models import (
    SET,
    coefficients_picture,
    drift_when_shut,
    gaps,
    one_step_errors,
    reach_picture,
    weak_cold_valve,
)
from loopwright.pipeline.cases.jacketed_batch_reactor.models import PrintedFuzzyPart, printed_model
from loopwright.pipeline.cases.jacketed_batch_reactor.plant import JacketedBatchReactor
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.models.hybrid_fuzzy_part import HybridFuzzyPart
from loopwright.pipeline.models.part import Part, Source

CHECKS = (one_step_errors, gaps, weak_cold_valve)


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
            name: {"median": part.learn(Source(record, plant.signals, plant=plant)).metrics}
            for name, part in parts.items()
        }
    }


def told(models: dict[str, Any]) -> Evidence:
    return Evidence(CASES["jacketed_batch_reactor"], {}, {}, models)


def test_what_was_measured_holds(measured: dict[str, Any]) -> None:
    outcomes = [check(told({SET: measured})) for check in CHECKS]
    assert [found.holds for found in outcomes] == [True] * 3
    assert "tied 0.00" in outcomes[1].measured
    assert outcomes[2].measured.startswith("-0.70 printed, -2.68")


def test_other_figures_do_not_hold(measured: dict[str, Any]) -> None:
    other = copy.deepcopy(measured)
    other["parts"]["tied"]["median"]["rmse"] *= 1.5
    other["parts"]["tied"]["median"]["gap"] = 0.1
    other["parts"]["printed"]["median"]["parameters"]["b_cold_20"] = -2.6
    assert [check(told({SET: other})).holds for check in CHECKS] == [False] * 3


def test_a_shut_throttle_drifts_by_what_the_coefficients_say(measured: dict[str, Any]) -> None:
    """Between two centres, in both modes; tied modes drift alike."""
    evidence, part = told({SET: measured}), printed_model()
    now = torch.tensor([[26.0]], dtype=torch.float64)
    expected = part.jacket(now, now).base[0] - 26.0
    assert drift_when_shut(evidence, "printed", 26.0) == pytest.approx(tuple(expected.tolist()))
    hot, cold = drift_when_shut(evidence, "tied", 26.0)
    assert hot == pytest.approx(cold)
    with pytest.raises(NotMeasuredError):
        drift_when_shut(told({}), "tied", 26.0)


def test_nothing_measured_is_no_verdict(measured: dict[str, Any]) -> None:
    for models in ({}, {SET: {"parts": {"tied": measured["parts"]["tied"]}}}):
        for check in CHECKS:
            with pytest.raises(NotMeasuredError):
                check(told(models))
    for draw in (reach_picture, coefficients_picture):
        with pytest.raises(NotMeasuredError):
            draw(told({}))


def test_the_pictures_show_every_identification(measured: dict[str, Any]) -> None:
    evidence = told({SET: measured})
    reach = reach_picture(evidence)
    titles = [axes.get_title(loc) for axes in reach.axes for loc in ("left", "center")]
    assert [t.split(":")[0] for t in titles if t] == ["printed", "local", "global", "tied"]
    assert "tied: nothing out of reach" in titles
    coefficients = coefficients_picture(evidence)
    assert [len(axes.lines) >= 10 for axes in coefficients.axes] == [True] * 4
