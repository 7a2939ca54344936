"""The input ``ahead``: its place in the manifest, what of it a step refuses, and rows side by side."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identified_models import random_model
from predictive_loops import law_of

from loopwright.pipeline.export.gate import export
from loopwright.serving import ArtifactError, ContractError, Controller, SampleError
from loopwright.serving.conformance.steps import answered
from loopwright.serving.first_steps import take
from loopwright.serving.manifest import Manifest
from loopwright.serving.preview.ahead import AheadInput, AheadSignal
from loopwright.serving.preview.differences import Differences
from loopwright.serving.vectorized_controller import VectorizedController

pytest_plugins = ["small_laws", "operated_files", "course_files"]
N = 12


def given(controller: Controller, **changed: Any) -> dict[str, Any]:
    """Inputs of a step from the middle of all ranges."""
    usual = {name: np.array(controller.manifest.usual(name)) for name in ("sp", "pv", "dv", "mv_applied")}
    return {**usual, "state": controller.cold_state(), **changed}


def test_the_manifest_says_what_it_is_and_comes_back_from_json(previewing: Controller) -> None:
    m = previewing.manifest
    assert m.ahead is not None
    assert m.inputs[-1] == "ahead"
    assert (m.ahead.horizon, m.ahead.period_s, m.sizes()["ahead"]) == (N, 1.0, 3 * N)
    assert [(s.group, s.signal) for s in m.ahead.signals] == [("sp", "y0"), ("sp", "y1"), ("dv", "d0")]
    assert Manifest.from_json(m.to_json()) == m


def test_a_manifest_without_it_has_no_word_of_it(operated: Controller) -> None:
    assert "ahead" not in json.loads(operated.manifest.to_json())
    assert operated.manifest.sizes()["ahead"] == 0


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a.pop("horizon"),
        lambda a: a.update(horizon=0),
        lambda a: a.update(horizon=2.5),
        lambda a: a.update(horizon=10**9),
        lambda a: a.update(period_s=2.0),
        lambda a: a.update(period_s="1"),
        lambda a: a.update(more=1),
        lambda a: a.update(signals=[]),
        lambda a: a.update(signals=a["signals"][:2]),
        lambda a: a.update(signals=a["signals"][::-1]),
        lambda a: a.update(signals=[a["signals"][0], *a["signals"]]),
        lambda a: a["signals"][0].update(group="pv"),
        lambda a: a["signals"][0].update(low=3.0),
        lambda a: a["signals"][0].update(high="3"),
        lambda a: a["signals"][0].pop("unit"),
    ],
)
def test_a_manifest_that_says_it_wrongly_is_refused(previewing: Controller, change: Any) -> None:
    row = json.loads(previewing.manifest.to_json())
    change(row["ahead"])
    with pytest.raises(ArtifactError, match="ahead"):
        Manifest.from_json(json.dumps(row))


def test_a_law_that_reads_it_needs_it_in_the_manifest(previewing: Controller) -> None:
    with pytest.raises(ArtifactError, match="ahead"):
        replace(previewing.manifest, ahead=None)


def test_nothing_to_come_is_the_default(previewing: Controller) -> None:
    usual, zeros = (previewing.step(**given(previewing, **more)) for more in ({}, {"ahead": np.zeros(3 * N)}))
    assert all(np.array_equal(a, b) for a, b in zip(usual, zeros, strict=True))
    coming = previewing.step(**given(previewing, ahead=np.full(3 * N, 0.5)))
    assert not np.array_equal(coming.mv, usual.mv)


def test_the_file_is_the_one_without_it_but_for_rounding(previewing: Controller, tmp_path: Path) -> None:
    """The graph sums in another order; the law itself is equal to the bit, see tests/laws."""
    law = law_of(random_model(3, n_y=2, n_mv=2, n_dv=1, n_hidden=0), horizon=N)
    export(law, tmp_path / "held.onnx", case="made", provenance={})
    held, state = Controller(tmp_path / "held.onnx"), previewing.cold_state()
    for answer in answered(previewing)[:60]:
        inputs = {n: v for n, v in answer.given.inputs.items() if n != "ahead"}
        one, other = (of.step(**inputs, state=state) for of in (held, previewing))
        np.testing.assert_allclose(one.mv, other.mv, rtol=0, atol=1e-11)
        state = other.state


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros(3 * N - 1),
        np.zeros((N, 3)),
        ["0"] * (3 * N),
        np.full(3 * N, np.nan),
        np.where(np.arange(3 * N) == 4, np.inf, 0.0),
        np.where(np.arange(3 * N) == 4, 3.1, 0.0),
        np.where(np.arange(3 * N) == 5, -1.1, 0.0),
    ],
)
def test_what_cannot_be_is_refused_and_not_clipped(previewing: Controller, wrong: Any) -> None:
    with pytest.raises(ContractError, match="ahead"):
        previewing.step(**given(previewing, ahead=wrong))


def test_a_refusal_names_signal_and_sample(previewing: Controller) -> None:
    with pytest.raises(ContractError, match=r"y1 is 3\.1 m at sample 2"):
        previewing.step(**given(previewing, ahead=np.where(np.arange(3 * N) == 4, 3.1, 0.0)))


def test_a_present_value_outside_its_range_may_stay_or_come_back(previewing: Controller) -> None:
    out, back, away = (np.tile([0.0, 0.0, by], N) for by in (0.0, -0.3, 0.1))
    for ahead in (out, back):
        previewing.step(**given(previewing, dv=[1.2], ahead=ahead))
    with pytest.raises(ContractError, match="d0"):
        previewing.step(**given(previewing, dv=[1.2], ahead=away))


def test_a_value_that_is_no_number_is_refused_for_itself(previewing: Controller) -> None:
    with pytest.raises(SampleError, match="y0"):
        previewing.step(**given(previewing, sp=[np.nan, 0.0], ahead=np.full(3 * N, 0.1)))


def test_a_law_without_it_refuses_it(operated: Controller) -> None:
    with pytest.raises(ContractError, match="does not read ahead"):
        operated.step(**given(operated, ahead=np.zeros(3)))
    rows = VectorizedController(operated, 1)
    with pytest.raises(ContractError, match="does not read ahead"):
        rows.step(**{n: np.array([v]) for n, v in given(operated).items()}, ahead=np.zeros((1, 3)))


@pytest.mark.parametrize("of", ["previewing", "operated_previewing"])
def test_rows_are_the_steps_of_the_controller_bit_for_bit(of: str, request: pytest.FixtureRequest) -> None:
    controller: Controller = request.getfixturevalue(of)
    rng, n = np.random.default_rng(0), 5
    size = controller.manifest.sizes()["ahead"]
    rows = {name: 0.5 * rng.uniform(-1, 1, (n, len(v))) for name, v in given(controller).items()}
    rows |= {"state": np.zeros((n, controller.manifest.n_state)), "ahead": 0.4 * rng.uniform(-1, 1, (n, size))}
    found = VectorizedController(controller, n).step(**rows)
    for k in range(n):
        step = controller.step(**{name: v[k] for name, v in rows.items()})
        assert step.mv.tobytes() == found.mv[k].tobytes()
        assert step.state.tobytes() == found.state[k].tobytes()
    rows["ahead"][3, 0] = 9.0
    with pytest.raises(ContractError, match="row 3: ahead: y0"):
        VectorizedController(controller, n).step(**rows)


def test_its_first_steps_are_taken_with_all_that_is_to_come(operated_previewing: Controller) -> None:
    take(operated_previewing)


def test_differences_end_at_the_ranges() -> None:
    ahead = AheadInput(2, 1.0, (AheadSignal("sp", "a", "K", 0.0, 10.0), AheadSignal("dv", "b", "K", 0.0, 10.0)))
    found = Differences(ahead).within(np.array([[1.0, 5.0], [-9.0, 9.0]]), np.array([4.0, 11.0]))
    np.testing.assert_array_equal(found, [1.0, 0.0, -4.0, 0.0])
    assert not Differences(ahead).within(np.ones((2, 2)), np.array([np.nan, np.nan])).any()
