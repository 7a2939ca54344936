"""The identification example of seed 002: what Table 1 there can have been, and what it says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.cases.ph_neutralization.identification_example import IdentificationExamplePart, example_record
from loopwright.pipeline.cases.ph_neutralization.models import MODELS
from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.config.params import parse
from loopwright.pipeline.models import Learnt
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.part import Source

N = 100


@pytest.fixture(scope="module")
def learnt() -> Learnt:
    return IdentificationExamplePart().learn(Source(None, ThiosulfateCstr().signals))


@pytest.fixture(scope="module")
def figures(learnt: Learnt) -> dict[str, Any]:
    return learnt.metrics


def test_the_plant_is_the_equation() -> None:
    u = np.sin(np.arange(6.0))
    record = example_record(u, noise=np.full(6, 0.5))
    z = record.pv[:, 0] - 0.5
    assert z[0] == 0
    for t in range(1, 6):
        assert z[t] == pytest.approx(z[t - 1] / (1 + z[t - 1] ** 2) + u[t - 1] ** 3)


def test_the_published_errors_come_about_without_noise_in_the_compared_data(figures: dict[str, Any]) -> None:
    """Reference: NNARX .055 (paper .0424), linearized .599 (.5989), recursive 2.57 (2.12) and 8.25 (9.86).

    The true equation's linearization has .599; a network trained on noisy data strays around that.
    """
    found = figures["one_step"]
    assert found["nnarx"]["median"] < 0.055
    assert found["linearized"]["median"] == pytest.approx(0.599, rel=0.15)
    assert found["linearized"]["min"] > 0.4
    assert found["linearized"]["max"] < 0.9
    assert found["recursive_0.8"]["median"] == pytest.approx(2.57, abs=0.005)
    assert found["recursive_0.5"]["median"] == pytest.approx(8.25, abs=0.005)


def test_with_the_noise_in_them_no_model_could_have_had_those_errors(figures: dict[str, Any]) -> None:
    least = 0.5 * N * 0.1**2
    assert all(row["min"] > least for row in figures["one_step_noisy"].values())
    order = [figures["one_step_noisy"][k]["median"] for k in ("nnarx", "linearized", "recursive_0.8", "recursive_0.5")]
    assert order == sorted(order)


def test_the_linearization_is_ahead_of_recursive_models_only_where_inputs_are_smooth(figures: dict[str, Any]) -> None:
    smooth, white = figures["one_step"], figures["one_step_white"]
    for name in ("recursive_0.8", "recursive_0.5"):
        assert smooth["linearized"]["max"] < smooth[name]["min"]
        assert white["linearized"]["median"] > 3 * white[name]["median"]


def test_the_exact_equations_linearization_has_the_published_error() -> None:
    record = example_record(np.sin(2 * np.pi * np.arange(N) / 25))
    y, u = record.pv[:, 0], record.mv[:, 0]
    error = 0.0
    for t in range(2, N):
        slope_y, slope_u = (1 - y[t - 2] ** 2) / (1 + y[t - 2] ** 2) ** 2, 3 * u[t - 2] ** 2
        error += (y[t] - y[t - 1] - slope_y * (y[t - 1] - y[t - 2]) - slope_u * (u[t - 1] - u[t - 2])) ** 2
    assert error == pytest.approx(0.5989, abs=2e-4)


def test_the_set_is_asked_for_by_its_kind_and_saved_as_the_median_network(learnt: Learnt) -> None:
    part = parse(MODELS["identification_example"], {"networks": 7, "samples": 500}, "part")
    assert isinstance(part, IdentificationExamplePart)
    assert isinstance(learnt.model, NNARX)
    assert learnt.predictions is not None
    error = ((learnt.predictions["measured"] - learnt.predictions["nnarx"]) ** 2).sum()
    assert error == pytest.approx(learnt.metrics["one_step"]["nnarx"]["median"])
    assert len(learnt.predictions["time_s"]) == N - 2
