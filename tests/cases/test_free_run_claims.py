"""What a report says of free runs and of reference models follows what was measured."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.reversible_cstr.pictures import (
    beats_the_classic_tables,
    reference_models_picture,
)
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.pictures.model_pictures import free_run_fit_at_least, free_run_picture, one_step_says_little


def row(near: float, fit: float) -> dict[str, float]:
    return {"one_step_rmse": near, "free_run_rmse": 1e-3 * (100 - fit), "free_run_fit": fit}


def evidence(first: dict[str, float] | None, then: dict[str, float] | None) -> Evidence:
    stages = {"one_step_trained": {"C_B": first}, "free_run_trained": {"C_B": then}}
    seeds: dict[str, Any] = {"0": {"nnarx": stages}, "1": {"nnarx": stages}} if first else {"0": {}}
    models = {"plant_network": {"parts": {"other": {"per_seed": {"0": {"rmse": 1.0}}}, "nnarx": {"per_seed": seeds}}}}
    return Evidence(CASES["thiosulfate_cstr"], {}, {}, models)


def test_fit_is_held_to_its_limit() -> None:
    check = free_run_fit_at_least(99.0, "plant_network", "nnarx", "C_B")
    good, bad = (check.statement(evidence(row(1e-5, 90.0), row(2e-5, fit))) for fit in (99.2, 98.9))
    assert (good.holds, bad.holds) == (True, False)
    assert "99.20 %" in good.measured


def test_one_step_accuracy_says_little_only_where_it_does() -> None:
    check = partial(one_step_says_little, "plant_network", "nnarx", "C_B", "mol/l")
    assert check(evidence(row(1e-5, 90.0), row(2e-5, 99.0))).holds is True
    assert check(evidence(row(2e-5, 90.0), row(1e-5, 99.0))).holds is False
    assert check(evidence(row(1e-5, 99.0), row(2e-5, 90.0))).holds is False


def test_nothing_measured_is_no_verdict() -> None:
    nothing = evidence(None, None)
    assert free_run_fit_at_least(99.0, "plant_network", "nnarx", "C_B").statement(nothing).holds is None
    with pytest.raises(NotMeasuredError):
        one_step_says_little("plant_network", "nnarx", "C_B", "mol/l", nothing)
    with pytest.raises(NotMeasuredError):
        free_run_picture("plant_network", "C_B", "mol/l")(nothing)


def test_picture_has_a_point_a_seed_and_training() -> None:
    canvas = free_run_picture("plant_network", "C_B", "mol/l")(evidence(row(1e-5, 90.0), row(2e-5, 99.0)))
    points = [line for line in canvas.axes[0].lines if line.get_linestyle() == "None"]
    assert [len(line.get_xdata()) for line in points] == [2, 2]


@pytest.mark.parametrize("order", [2, 6])
def test_reference_models_are_told_with_their_itae(order: int) -> None:
    verdict = beats_the_classic_tables(evidence(None, None))
    assert verdict.holds is True
    assert f"n = {order}: " in verdict.measured
    canvas = reference_models_picture(evidence(None, None))
    cells = canvas.axes[1].tables[0].get_celld()
    assert cells[order, 0].get_text().get_text() == str(order)
    assert len(cells[order, 1].get_text().get_text().split()) == order - 1
