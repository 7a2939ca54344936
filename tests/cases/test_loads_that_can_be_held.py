"""Tests with loads of own plants: none that no controller can hold, and their weight then goes to the others."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from own_cases import controllers_of_a_lag

from loopwright.pipeline.cases.operating_range import SCALES, OperatingRange, held_at
from loopwright.pipeline.cases.own_plant import GATE
from loopwright.pipeline.cases.own_tests import ABOVE_NOISE, LEAST_LOAD, TEST_LOAD, held_load, load_size, whole_load
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.rests import courses
from loopwright.serving.manifest import Signal


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def wanted_load(reach: OperatingRange, monkeypatch: pytest.MonkeyPatch) -> float:
    """The load before anything is asked of the MVs."""
    with monkeypatch.context() as patch:
        patch.setattr("loopwright.pipeline.cases.operating_range.can_command", lambda *_: True)
        found = held_load(reach, reach.model, 0)
    assert found is not None
    return found


@pytest.mark.parametrize("upwards", [True, False])
def test_a_load_that_a_model_answers_by_a_swing_is_sized_by_its_largest_effect(upwards: bool) -> None:
    """Of a bleach plant the model came back to a twentieth: sized by that, its test left the range for any law."""
    comes_back = np.array([[0.9, -0.1], [0.1, 0.99]])
    arrays = IdentifiedArrays(
        comes_back, np.array([[0.1], [0.0]]), np.zeros(2), np.zeros((0, 3)), np.zeros(0), np.zeros((2, 0)),
        np.array([50.0]), np.array([4.0]), np.array([50.0]), np.array([50.0]), np.zeros((2, 3)),
    )  # fmt: skip
    pv, mv = (Signal("T", "degC", 0.0, 100.0),), (Signal("V", "%", 0.0, 100.0),)
    plant = IdentifiedPlant(Signals(1.0, pv, pv, (), mv), arrays)
    record = SimpleNamespace(pv=4.0 * np.sin(np.arange(200))[:, None])
    reach: Any = SimpleNamespace(
        hold=400, integrates=(), record=record, model=SimpleNamespace(noise_std=np.array([0.1]))
    )
    (x, applied), size = plant.start, load_size(reach, 0)
    load = whole_load(reach, plant, 0, upwards)
    y = courses(plant, x, applied[None], 400, plant.parameters({"load_T": load}))[0, :, 0] - 50.0
    assert np.sign(load) == (1 if upwards else -1)
    assert np.abs(y).max() == pytest.approx(size, rel=1e-6)
    assert abs(y[-1]) < 0.5 * size


def test_a_plant_with_room_has_all_loads_and_its_weights_as_they_are() -> None:
    case = controllers_of_a_lag({})
    assert len(case.scenarios()["load"]) == 3
    assert case.weights == GATE
    assert case.lacking == ()


def test_where_nothing_can_be_held_there_is_no_load_and_the_report_says_why() -> None:
    """The valve rests within 5 % of its end, where no load leaves it enough room."""
    case = controllers_of_a_lag({}, moved=(0.97, 0.99))
    assert [held_load(case.reach, case.reach.model, 0, up) for up in (True, False)] == [None, None]
    assert "load" not in case.scenarios()
    assert case.weights.keys() == GATE.keys() - {"load"}
    assert sum(case.weights.values()) == pytest.approx(1.0, abs=1e-3)
    assert case.weights["held_out"] / case.weights["spoilt"] == pytest.approx(GATE["held_out"] / GATE["spoilt"], 1e-3)
    (line,) = case.lacking
    assert line.startswith("There is no test with loads: ")
    assert "cannot hold any load" in line
    assert line.endswith("Its weight goes to the other tests.")


def test_a_small_room_gives_the_load_that_fits_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Downwards the valve must open further, by at most what is left of its range."""
    case = controllers_of_a_lag({}, moved=(-0.6, 0.6))
    reach = case.reach
    wanted = wanted_load(reach, monkeypatch)
    rest = reach.model.start[1][0]
    # room for a twentieth of what the load asks of the valve; a tenth is the smallest that was tried before
    (x, mv), cvs = reach.model.start, reach.model.measure(reach.model.start[0])[:1]
    p = reach.model.parameters({"load_y0": -0.05 * wanted})
    held = held_at(reach.model, (x, mv), cvs, reach.model.mv_signals, p)
    assert held is not None
    edge = float(held[1][0])

    def can_command(_: object, values: np.ndarray, room: float = 0.0) -> bool:
        return room == 0.0 or rest - 1e-9 <= values[0] <= edge

    monkeypatch.setattr("loopwright.pipeline.cases.operating_range.can_command", can_command)
    found = held_load(reach, reach.model, 0, upwards=False)
    assert found is not None
    assert LEAST_LOAD <= -found / wanted <= 0.05 < SCALES[-1]
    assert -found / wanted == pytest.approx(0.05, abs=LEAST_LOAD)
    assert held_load(reach, reach.model, 0, upwards=True) is None


@pytest.mark.parametrize(("noise", "standard"), [(0.01, TEST_LOAD), (0.5, None)])
def test_a_load_is_seen_above_the_noise_and_its_test_says_its_size(noise: float, standard: float | None) -> None:
    """The record's standard deviation is .6: a quarter is .15, and three times a noise of .5 is 1.5."""
    case = controllers_of_a_lag({}, moved=(-0.5, 0.5), noise=noise)
    spread = float(case.record.pv[:, 0].std())
    size = load_size(case.reach, 0)
    assert size == pytest.approx(TEST_LOAD * spread if standard else ABOVE_NOISE * noise)
    test = case.scenarios()["load"][0]
    assert test.title.startswith(f"A load that moves y0 by {size:.3g} m if no controller acts; or as much as")
    assert test.plant is not None
    (x, mv), load = test.plant.start, {"load_y0": test.changes["load_y0"][-1]}
    for _ in range(case.hold):
        x = test.plant.step(x, mv, test.plant.dv_nominal, test.plant.parameters(load))
    moved = abs(float(test.plant.measure(x)[0] - test.plant.measure(test.x0)[0]))
    assert moved == pytest.approx(size, rel=0.01)


def test_a_load_that_the_mvs_cut_says_how_much_is_left() -> None:
    """Loads of 3 where the valve, at its end, moves the level by 2: some are cut, and the title has the smallest."""
    case = controllers_of_a_lag({}, noise=1.0)
    tests = case.scenarios()["load"]
    (title,) = {test.title for test in tests}
    share = float(title.rpartition("at least ")[2].removesuffix(" % of it"))
    assert title.startswith(
        "A load that moves y0 by 3 m if no controller acts; or as much as the MVs can hold, which is"
    )
    wanted = [whole_load(case.reach, test.plant, 0) for test in tests]
    least = min(abs(test.changes["load_y0"][-1]) / load for test, load in zip(tests, wanted, strict=True))
    assert share == pytest.approx(100 * least, rel=0.05)
    assert 20 < share < 70
