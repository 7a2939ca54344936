"""The part: what it recovers of plants whose truth is known, its verdict, its members, its numbers in params.yaml."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import made_plants
import numpy as np
import pytest
import torch
from finished import free_run, plant_of

from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import ModelError, ParamsError
from loopwright.pipeline.models import MODELS, load_model
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.part import Learnt, Source
from loopwright.pipeline.simulation.rests import local_gains

LINEAR = IdentifiedPart(orders=(2, 3), units=(), minutes=0.02)
SMALL = IdentifiedPart(orders=(2, 2), units=(6,), minutes=0.02)


def identified(learnt: Learnt) -> Identified:
    assert isinstance(learnt.model, Identified)
    return learnt.model


def noise_sd(learnt: Learnt, name: str = "y0") -> float:
    return float(learnt.metrics["outputs"][name]["noise_sd"])


def test_second_order_with_dead_time() -> None:
    learnt = LINEAR.learn(Source(made_plants.second_order(1000, delay=4), made_plants.signals_of(1, 1)))
    assert learnt.metrics["gains"]["y0"]["u0"]["gain"] == pytest.approx(0.5, rel=0.01)
    assert learnt.metrics["gains"]["y0"]["u0"]["sign"] == "+"
    assert learnt.metrics["free_run_rmse"] < 1.1 * 0.1
    assert noise_sd(learnt) == pytest.approx(0.1, rel=0.1)
    assert learnt.metrics["dead_times"]["u0"] == 5  # four, and one through the second lag
    assert learnt.metrics["spectral_radius"] == pytest.approx(0.9, abs=0.01)
    assert learnt.metrics["residual"]["y0"]["autocorrelated"] < 0.1
    assert float(identified(learnt).dead[0]) == 5


def test_a_record_of_two_values_shows_no_curve() -> None:
    record = made_plants.second_order(1000)
    mv = np.where(record.mv > 50, 80.0, 20.0)
    pv = 20 + 0.5 * np.convolve(mv[:, 0], 0.1 * 0.9 ** np.arange(60))[: len(mv), None]
    learnt = LINEAR.learn(Source(replace(record, mv=mv, pv=pv), made_plants.signals_of(1, 1)))
    words = learnt.metrics["structure"]["verdict"]
    assert words.endswith("; but u0 moves between 2 values only (20 and 80 %): a curve between them cannot be seen")


def test_two_by_two_with_a_measured_disturbance() -> None:
    record, signals = made_plants.two_by_two(1000, measured=True), made_plants.signals_of(2, 2, 1)
    learnt = LINEAR.learn(Source(record, signals))
    gains = learnt.metrics["gains"]
    found = [[gains[y][v]["gain"] for v in ("u0", "u1", "d0")] for y in ("y0", "y1")]
    assert np.array(found) == pytest.approx(np.array([[0.5, -0.3, 2.0], [0.2, 0.6, -1.0]]), rel=0.02)
    assert gains["y0"]["u1"]["sign"] == "-"
    assert noise_sd(learnt, "y1") == pytest.approx(0.1, rel=0.1)
    model = identified(learnt)
    assert (model.n_y, model.n_mv, model.n_dv) == (2, 2, 1)
    assert learnt.metrics["disturbances"] == {"d0": {"noise_sd": 0}}


def test_noise_of_a_measured_disturbance_is_found() -> None:
    record, signals = made_plants.two_by_two(2000, measured=True), made_plants.signals_of(2, 2, 1)
    noisy = replace(record, dv=record.dv + 0.2 * np.random.default_rng(1).normal(size=record.dv.shape))
    learnt = LINEAR.learn(Source(noisy, signals))
    model = identified(learnt)
    assert learnt.metrics["disturbances"]["d0"]["noise_sd"] == pytest.approx(0.2, rel=0.15)
    assert float(model.dv_noise * model.v_scale[2:]) == pytest.approx(0.2, rel=0.15)
    assert float(model.dv_change * model.v_scale[2:]) == pytest.approx(np.diff(record.dv, axis=0).std(), rel=0.15)


def test_noise_of_a_measured_disturbance_makes_no_gain_too_small() -> None:
    record, signals = made_plants.two_by_two(2000, measured=True), made_plants.signals_of(2, 2, 1)
    noisy = replace(record, dv=record.dv + np.random.default_rng(2).normal(size=record.dv.shape))
    # What the smoothed readings miss wanders, so that by itself the search takes a model with loads.
    for correction, error in ((0.0, 0.015), (None, 0.03)):
        gains = replace(LINEAR, correction=correction).learn(Source(noisy, signals)).metrics["gains"]
        assert [gains[y]["d0"]["gain"] for y in ("y0", "y1")] == pytest.approx([2.0, -1.0], rel=error)


def test_a_second_process_variable_is_an_output_where_all_measured_ones_are() -> None:
    record, signals = made_plants.two_by_two(600), made_plants.signals_of(2, 2)
    source = Source(record, replace(signals, sp=signals.pv[:1]))
    alone, both = (identified(replace(LINEAR, outputs=o).learn(source)) for o in ("controlled", "measured"))
    assert (alone.n_y, both.n_y) == (1, 2)
    assert LINEAR.groundwork() != replace(LINEAR, outputs="measured").groundwork()
    assert both.y_center.numpy() == pytest.approx(record.pv.mean(axis=0))


def test_an_integrator_keeps_its_slope_and_its_poles_inside() -> None:
    learnt = LINEAR.learn(Source(made_plants.integrator(800), made_plants.signals_of(1, 1)))
    assert learnt.metrics["gains"]["y0"]["u0"]["gain"] == pytest.approx(0.05, rel=0.03)
    assert learnt.metrics["gains"]["y0"]["u0"]["rate"] is True
    assert 0.995 < learnt.metrics["spectral_radius"] <= 1 + 1e-6
    assert noise_sd(learnt) == pytest.approx(0.1, rel=0.1)
    plant = plant_of(identified(learnt), made_plants.signals_of(1, 1))
    assert plant.measure(plant.start_at(np.array([52.0]))) == pytest.approx([52.0])


def test_a_record_from_a_closed_loop() -> None:
    learnt = LINEAR.learn(Source(made_plants.closed_loop(1500), made_plants.signals_of(1, 1)))
    assert learnt.metrics["gains"]["y0"]["u0"]["gain"] == pytest.approx(0.8, rel=0.02)
    assert learnt.metrics["free_run_rmse"] < 1.1 * 0.1


def test_several_runs_each_with_its_own_start() -> None:
    record = made_plants.second_order(1200, delay=0, runs=6)
    learnt = LINEAR.learn(Source(record, made_plants.signals_of(1, 1)))
    assert learnt.metrics["gains"]["y0"]["u0"]["gain"] == pytest.approx(0.5, rel=0.01)
    assert learnt.metrics["free_run_rmse"] < 1.1 * 0.1


def test_a_gain_that_changes_needs_a_network() -> None:
    record, signals = made_plants.hammerstein(600), made_plants.signals_of(1, 1)
    learnt = SMALL.learn(Source(record, signals))
    structure = learnt.metrics["structure"]
    assert structure["hidden"] == 6
    assert structure["nonlinear_factor"] > 5
    assert structure["verdict"].startswith("nonlinear by a factor of")
    assert learnt.metrics["free_run_rmse"] < 1.6 * 0.1
    assert noise_sd(learnt) == pytest.approx(0.1, rel=0.1)
    plant = plant_of(identified(learnt), signals)
    x, _ = plant.start
    for u in (30.0, 70.0):
        for _ in range(80):
            x = plant.step(x, np.array([u]), plant.dv_nominal, plant.parameters())
        assert plant.measure(x)[0] == pytest.approx(made_plants.curve(u), abs=0.3)
    assert json.dumps(learnt.metrics)


def test_the_same_record_gives_the_same_bytes(tmp_path: Path) -> None:
    source = Source(made_plants.hammerstein(150), made_plants.signals_of(1, 1), seed=3)
    part = IdentifiedPart(orders=(2, 2), units=(3,), minutes=0.003)
    models = [identified(part.learn(source)).state_dict() for _ in range(2)]
    assert all(torch.equal(models[0][name], value) for name, value in models[1].items())


def test_its_file_and_its_free_run(tmp_path: Path) -> None:
    record = made_plants.second_order(800)
    learnt = LINEAR.learn(Source(record, made_plants.signals_of(1, 1)))
    learnt.model.save(tmp_path / "m.npz")
    again = load_model(tmp_path / "m.npz")
    assert type(again) is MODELS["identified"].model is Identified
    predicted = free_run(again, record.pv, record.mv)
    assert float(np.sqrt(np.mean((predicted - record.pv) ** 2))) < 1.05 * 0.1


def test_a_long_record_gives_its_liveliest_blocks() -> None:
    record = made_plants.second_order(1500)
    learnt = replace(LINEAR, rows=600).learn(Source(record, made_plants.signals_of(1, 1)))
    assert learnt.metrics["n_train"] <= 600
    assert learnt.metrics["gains"]["y0"]["u0"]["gain"] == pytest.approx(0.5, rel=0.02)


def test_the_gain_of_a_long_record_is_that_at_its_middle() -> None:
    """Only lively rows are fitted, but the picture of gains and a reader go by the medians of the whole record."""
    record, signals = made_plants.hammerstein(2100, quiet=1400, at=25.0), made_plants.signals_of(1, 1)
    learnt = replace(SMALL, rows=600).learn(Source(record, signals))
    found = learnt.metrics["gains"]["y0"]["u0"]
    assert found["gain"] == pytest.approx(0.1 + 0.009 * 25.0, rel=0.1)
    assert found["rate"] is False
    middle = np.median(record.mv, axis=0)
    drawn, _ = local_gains(plant_of(identified(learnt), signals, mv=middle), 0, middle, middle, 1)
    assert found["gain"] == pytest.approx(float(drawn[0, 0]), rel=0.05)
    assert learnt.metrics["step_responses"]["y0"]["u0"]["middle"][-1] == pytest.approx(found["gain"], rel=0.4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"member": 3}, "member is 3; an ensemble has"),
        ({"outputs": "all"}, "outputs is 'all'; known: controlled, measured"),
        ({"orders": [3, 2]}, r"orders are \[3, 2\]; give the least"),
        ({"units": [0]}, r"units are \[0\]; each must be"),
        ({"minutes": 0.0}, "minutes is 0; it must be positive"),
        ({"rows": 10}, "rows is 10; it must be at least 100"),
        ({"correction": 2.0}, "correction is 2; it must lie"),
    ],
)
def test_numbers_that_cannot_be(options: dict[str, object], message: str) -> None:
    with pytest.raises(ParamsError, match=message):
        parse(MODELS["identified"], options, "part")


def test_it_needs_a_record() -> None:
    with pytest.raises(ModelError, match="learns from a record"):
        LINEAR.learn(Source(None, made_plants.signals_of(1, 1)))
