"""A plant in whose place stands a model: rest, gain, load, side by side."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import PlantError
from pipeline.plants.identified import Identification, IdentifiedPlant, plant_of
from pipeline.plants.signals import Signals
from pipeline.simulation.simulate import simulate_batch, simulate_open
from serving.manifest import Signal

LEVEL, VALVE, INFLOW = (
    Signal("level", "m", 0.0, 4.0),
    Signal("valve", "%", 0.0, 100.0),
    Signal("inflow", "l/s", 0.0, 2.0),
)
POLE, UNITS = 0.8, 2  # tanh units


def made(pole: float = POLE) -> IdentifiedPlant:
    rng = np.random.default_rng(0)
    arrays = {
        "a": np.array([[pole, 0.3], [0.0, 0.5]]),
        "b": np.array([[0.0, 0.05], [0.4, 0.0]]),
        "c": np.array([0.01, 0.0]),
        "w1": rng.normal(size=(UNITS, 4)),
        "b1": rng.normal(size=UNITS),
        "w2": 0.02 * rng.normal(size=(2, UNITS)),
        "y_center": np.array([2.0]),
        "y_scale": np.array([0.5]),
        "v_center": np.array([50.0, 1.0]),
        "v_scale": np.array([50.0, 0.4]),
        "noise": np.array([0.02]),
    }
    signals = Signals(10.0, (LEVEL,), (LEVEL,), (INFLOW,), (VALVE,))
    kind = plant_of("tank", "Tank", signals)
    return kind(lambda: Identification(arrays, np.array([40.0]), np.array([1.1])))


def test_it_starts_at_rest_and_measures_in_the_units_of_its_signals() -> None:
    plant = made()
    x0, mv0 = plant.start
    after = simulate_open(plant, x0, np.tile(mv0, (50, 1)))
    assert plant.measured(after) == pytest.approx(np.tile(plant.measure(x0), (51, 1)), abs=1e-7)
    assert plant.noise_std == pytest.approx([0.01])
    assert plant.dv_nominal == pytest.approx([1.1])


def test_the_gain_scales_what_the_output_does_about_its_start() -> None:
    plant = made()
    (x0, _), dv = plant.start, plant.dv_nominal
    y0 = plant.measure(x0)
    ends = []
    for gain in (1.0, 1.5):
        x, p = x0, plant.parameters({"gain": gain})
        for _ in range(200):
            x = plant.step(x, np.array([70.0]), dv, p)
        ends.append(plant.measure(x) - y0)
    assert abs(ends[0][0]) > 0.1
    assert ends[1] == pytest.approx(1.5 * ends[0])


def test_a_load_acts_as_the_mv_does() -> None:
    plant = made()
    (x0, mv0), dv = plant.start, plant.dv_nominal
    loaded, moved = x0, x0
    for _ in range(30):
        loaded = plant.step(loaded, mv0, dv, plant.parameters({"load_valve": 7.0}))
        moved = plant.step(moved, mv0 + 7.0, dv, plant.parameters())
        assert loaded == pytest.approx(moved)
    assert plant.parameter_units() == {"gain": "-", "load_valve": "%"}


def test_runs_side_by_side_equal_each_alone() -> None:
    plant, rng = made(), np.random.default_rng(1)
    x0 = np.tile(plant.start[0], (3, 1)) + np.append(0.1 * rng.normal(size=2), 0.0)
    moves = rng.uniform(0, 100, (3, 20, 1))
    together = simulate_batch(plant, x0, moves)
    for row, x, mv in zip(together, x0, moves, strict=True):
        assert row == pytest.approx(simulate_open(plant, x, mv))


def test_a_model_that_never_rests_is_refused_with_its_mv() -> None:
    with pytest.raises(PlantError, match="does not come to rest under valve = 40"):
        _ = made(pole=1.02).start


def test_an_unknown_parameter_is_named_with_those_that_there_are() -> None:
    with pytest.raises(PlantError, match=r"no parameter .gian.; it has gain, load_valve"):
        made().parameters({"gian": 2.0})
