"""The identified plant: its equation in numbers, its rest, and how each parameter spoils it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.manifest import Signal

LEVELS = (Signal("T", "degC", 0.0, 100.0), Signal("L", "m", 0.0, 4.0))
SIGNALS = Signals(5.0, LEVELS, LEVELS, (Signal("F", "kg/s", 0.0, 2.0),), (Signal("V", "%", 0.0, 100.0),))


def made(
    hidden: bool = True, pole: float = 0.8, most_dead_time: int = 0, bend: float = 0.1, push: float = 0.01
) -> IdentifiedPlant:
    w2 = bend * np.array([[1.0], [0.5], [0.0]]) * hidden
    arrays = IdentifiedArrays(
        a=np.array([[pole, 0.0, 0.1], [0.0, 0.7, 0.0], [0.0, 0.1, 0.5]]),
        b=np.array([[0.2, 0.0], [0.0, 0.1], [0.3, 0.1]]),
        c=np.array([push, 0.0, -0.02]),
        w1=np.array([[0.5, 0.0, 0.2, 1.0, 0.0]]),
        b1=np.array([0.1]),
        w2=w2,
        y_center=np.array([50.0, 2.0]),
        y_scale=np.array([10.0, 0.5]),
        v_center=np.array([50.0, 1.0]),
        v_scale=np.array([50.0, 0.2]),
        rest=np.zeros((3, 5)),
    )
    return IdentifiedPlant(SIGNALS, arrays, most_dead_time=most_dead_time)


def settled(plant: IdentifiedPlant, mv: float, **changed: float) -> np.ndarray:
    x, _ = plant.start
    for _ in range(300):
        x = plant.step(x, np.array([mv]), plant.dv_nominal, plant.parameters(changed))
    return plant.measure(x)


def test_it_starts_at_rest_and_stays_there() -> None:
    plant = made()
    x, mv = plant.start
    assert plant.step(x, mv, plant.dv_nominal, plant.parameters()) == pytest.approx(x, abs=1e-9)
    assert mv == pytest.approx([50.0])


@pytest.mark.parametrize("pole", [0.95, 0.9914, 0.998, 0.9995])
@pytest.mark.parametrize("hidden", [False, True])
def test_a_slow_plant_starts_at_rest_too(pole: float, hidden: bool) -> None:
    """With .9914 a thousandth of the way was left after 2,000 periods, and the start was taken for an integrator's."""
    plant = made(hidden, pole, bend=0.2 * (1 - pole), push=0.2 * (1 - pole))
    x, mv = plant.start
    after = x
    for _ in range(500):
        after = plant.step(after, mv, plant.dv_nominal, plant.parameters())
    assert plant.measure(after) == pytest.approx(plant.measure(x), abs=1e-6)


@pytest.mark.parametrize(("pole", "push"), [(1.0, 0.0), (1.002, 0.0), (0.9999, 0.1)])
def test_what_rests_nowhere_or_far_away_starts_at_the_centre_of_the_outputs(pole: float, push: float) -> None:
    plant = made(False, pole, push=push)
    assert plant.measure(plant.start[0]) == pytest.approx([50.0, 2.0])


def test_a_gain_turns_about_the_start() -> None:
    plant = made(hidden=False)
    start = plant.measure(plant.start[0])
    once, twice = (settled(plant, 60.0, gain_V=g) - start for g in (1.0, 2.0))
    assert twice == pytest.approx(2 * once)
    assert settled(plant, 50.0, gain_V=3.0) == pytest.approx(start)


def test_a_time_constant_keeps_the_rests() -> None:
    plant = made()
    assert settled(plant, 70.0, time_constant=1.5) == pytest.approx(settled(plant, 70.0), rel=1e-9)
    x, _ = plant.start
    moved = [plant.step(x, np.array([90.0]), plant.dv_nominal, plant.parameters({"time_constant": t})) for t in (1, 2)]
    assert moved[1] - x == pytest.approx((moved[0] - x) / 2)


def test_a_faster_plant_stays_stable() -> None:
    plant = made(hidden=False, pole=-0.7)
    assert settled(plant, 70.0, time_constant=0.7) == pytest.approx(settled(plant, 70.0), rel=1e-9)


def test_a_load_is_added_to_its_output_each_period() -> None:
    plant = made(hidden=False)
    x, mv = plant.start
    pushed = plant.step(x, mv, plant.dv_nominal, plant.parameters({"load_L": 0.05}))
    assert plant.measure(pushed) - plant.measure(x) == pytest.approx([0.0, 0.05], abs=1e-9)


@pytest.mark.parametrize("dead_time", [0, 1, 3])
def test_a_dead_time_shifts_the_answer(dead_time: int) -> None:
    plant = made(most_dead_time=3)
    plain = made()
    mvs = np.random.default_rng(0).uniform(0, 100, (40, 1))
    (x, _), (z, _) = plant.start, plain.start
    p, late, prompt = plant.parameters({"dead_time": dead_time}), [], []
    for mv in mvs:
        x, z = plant.step(x, mv, plant.dv_nominal, p), plain.step(z, mv, plain.dv_nominal, plain.parameters())
        late.append(plant.measure(x))
        prompt.append(plain.measure(z))
    assert np.array(late)[dead_time:] == pytest.approx(np.array(prompt)[: 40 - dead_time], rel=1e-9)


def test_half_a_period_lies_between_its_neighbours() -> None:
    plant = made(hidden=False, most_dead_time=2)
    x, _ = plant.start
    answers = [
        plant.step(x, np.array([80.0]), plant.dv_nominal, plant.parameters({"dead_time": d})) for d in (0, 0.5, 1)
    ]
    assert answers[1][:3] == pytest.approx((answers[0][:3] + answers[2][:3]) / 2)


def test_runs_side_by_side_equal_single_ones() -> None:
    plant = made(most_dead_time=2)
    rng = np.random.default_rng(3)
    x = rng.normal(size=(4, plant.n_x))
    mv = rng.uniform(0, 100, (4, 1))
    single = [plant.step(a, b, plant.dv_nominal, plant.parameters()) for a, b in zip(x, mv, strict=True)]
    assert plant.many(4)(x, mv) == pytest.approx(np.array(single))
    assert plant.measured(x).shape == (4, 2)


def test_an_integrator_starts_at_the_centre_of_its_outputs() -> None:
    plant = made(hidden=False, pole=1.0)
    assert plant.measure(plant.start[0]) == pytest.approx([50.0, 2.0])
    assert plant.measure(plant.start_at(np.array([70.0, 1.0]))) == pytest.approx([70.0, 1.0])


def test_its_signals_parameters_and_pickle() -> None:
    plant = made(most_dead_time=1)
    assert plant.parameter_names() == ("gain_V", "time_constant", "dead_time", "load_T", "load_L")
    assert plant.parameter_units()["load_T"] == "degC"
    assert plant.signals == SIGNALS
    again = pickle.loads(pickle.dumps(plant))
    x, mv = plant.start
    assert np.array_equal(
        again.step(x, mv, plant.dv_nominal, plant.parameters()), plant.step(x, mv, plant.dv_nominal, plant.parameters())
    )


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"gian_V": 1.0}, "has no parameter"),
        ({"dead_time": 3.0}, "must be 0 to 0"),
        ({"time_constant": 0.1}, "above 0.5"),
    ],
)
def test_parameters_that_cannot_be(changed: dict[str, float], message: str) -> None:
    with pytest.raises(PlantError, match=message):
        made().parameters(changed)


def test_arrays_that_do_not_fit_the_signals() -> None:
    few = Signals(5.0, LEVELS, LEVELS, (), SIGNALS.mv)
    with pytest.raises(PlantError, match="2 inputs got 2 PVs, 1 MVs and 0"):
        IdentifiedPlant(few, made().arrays)
