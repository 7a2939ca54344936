"""The benchmark's own plants: their rests, records and closed loops are what they are said to be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from benchmark_modules import own_plants_modules

from loopwright.pipeline.simulation.simulate import simulate_closed

MODULES = ("plant", "development", "untouched", "record", "loops", "store", "closed_plant", "observed")


@pytest.fixture(scope="module")
def own() -> Any:
    return own_plants_modules(MODULES)


class Proportional(torch.nn.Module):
    """A stand-in for a law of one loop: a move in proportion to the error, the samples counted in its state."""

    n_state = 1

    def forward(self, sp: Any, pv: Any, dv: Any, mv: Any, state: Any) -> tuple[Any, Any, Any]:
        return torch.clamp(mv + 0.2 * (sp - pv), 0.0, 100.0), state + 1, pv[..., :0]


@pytest.mark.parametrize("name", ["coupled", "level"])
def test_a_plant_rests_where_it_says_and_loads_move_it(own: Any, name: str) -> None:
    plant = {p.name: p for p in own.development.DEVELOPMENT}[name]()
    sp = plant.set_points(np.random.default_rng(0), 1)[0]
    x, mv = plant.rest(sp)
    np.testing.assert_allclose(plant.measure(x), sp, atol=1e-6)
    step, p = plant.stepper(), plant.parameters()
    np.testing.assert_allclose(step(x, mv, np.zeros(0), p), x, atol=1e-5)
    assert len(plant.load_names()) == len(plant.mv_signals)
    for i, load in enumerate(plant.load_names()):
        pushed = mv + 10.0 * np.eye(len(mv))[i]
        np.testing.assert_allclose(
            step(x, mv, np.zeros(0), plant.parameters({load: 10.0})), step(x, pushed, np.zeros(0), p)
        )


@pytest.mark.parametrize("name", ["exchanger", "level", "recycle", "drifting"])
def test_a_record_repeats_and_stays_within_the_signals(own: Any, name: str) -> None:
    plant = {p.name: p for p in (*own.development.DEVELOPMENT, *own.untouched.UNTOUCHED)}[name]()
    record, again = (own.record.record_of(plant, 400) for _ in range(2))
    assert record.digest() == again.digest()
    assert ((record.mv >= 0) & (record.mv <= 100)).all()
    assert len(np.unique(record.mv)) > 8
    assert record.pv.std() > 3 * plant.noise[0]


def test_loops_side_by_side_are_the_closed_loop_of_one(own: Any) -> None:
    plant = own.development.Exchanger()
    law, tests = Proportional(), own.loops.tests_of(plant)["loads"]
    y, u = own.loops.closed(law, plant, tests)

    def step(sp: Any, pv: Any, mv: Any) -> tuple[Any, Any]:
        return np.clip(mv + 0.2 * (sp - pv), 0, 100), np.zeros(0)

    second = tests[1].scenario
    alone = simulate_closed(plant, step, second, noise=plant.noise_std, seed=second.seed + 1)
    np.testing.assert_allclose(y[0, 1], alone.pv, atol=1e-9)
    np.testing.assert_allclose(u[0, 1], alone.mv, atol=1e-9)
    score = own.loops.scores(plant, tests, y[0], u[0])
    errors = [np.abs(t.scenario.sp - r) for t, r in zip(tests, y[0], strict=True)]
    assert score.nmae == pytest.approx(100 * np.mean(errors) / 25)


def test_an_upset_reaches_the_output_beside_the_plant(own: Any) -> None:
    plant = own.development.Coupled()
    tests = own.loops.tests_of(plant)["upsets"]

    class Still(Proportional):
        """A law that leaves the MVs alone."""

        def forward(self, sp: Any, pv: Any, dv: Any, mv: Any, state: Any) -> tuple[Any, Any, Any]:
            return mv, state, pv[..., :0]

    y, _ = own.loops.closed(Still(), plant, tests)
    np.testing.assert_allclose(y[0], np.stack([t.scenario.sp + t.upset for t in tests]), atol=1e-3)
    tenth = 0.1 * np.array([s.high - s.low for s in plant.sp_signals])
    for i in range(2):
        assert tests[0].upset[:, i].max() == pytest.approx(tenth[i], rel=1e-3)


def test_the_filter_of_the_observed_nmpc_finds_state_and_load_within_what_it_doubts(own: Any) -> None:
    """The equations are the plant's own, so that the error over its standard deviation is that of a normal draw."""
    plant = own.development.Exchanger()
    x, mv = plant.rest(np.array([0.5 * (s.low + s.high) for s in plant.sp_signals]))
    true, nominal, rng = plant.parameters({"load": 6.0}), plant.parameters(), np.random.default_rng(4)
    filtered = own.observed.Observer(plant, own.observed.moving_of(plant, 0.1), x, nominal)
    for k in range(400):
        filtered.see(plant.measure(x) + plant.noise_std * rng.standard_normal(1))
        moved = mv + 10.0 * np.sign(np.sin(k / 20))
        filtered.go_on(moved, nominal)
        x = plant.step(x, moved, plant.dv_nominal, true)
    doubts = np.sqrt(np.diag(filtered.cov))
    assert doubts[-1] < 2.0
    assert abs(filtered.z[-1] - 6.0) < 3 * doubts[-1]
    assert (np.abs(filtered.z[:-1] - x) < 4 * doubts[:-1]).all()
    assert filtered.told(nominal)[plant.parameter_names().index("load")] == filtered.z[-1]
