"""The NMPC that knows an identified plant: its equation, an optimum that is known, and what is kept of its figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from own_cases import two_lags

from loopwright.pipeline.cases.own_plant import own_case
from loopwright.pipeline.optimal import model_bounds as kept_bounds
from loopwright.pipeline.optimal.model_bounds import SampledHorizon, model_bounds, run_sampled, shares, transition
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving.manifest import Signal

POLE, GAIN = 0.9, 2.0


def plant_of(seed: int, n_y: int = 2, n_mv: int = 2, n_dv: int = 1, n_x: int = 4, hidden: int = 3) -> IdentifiedPlant:
    rng = np.random.default_rng(seed)
    a, n_v = rng.normal(size=(n_x, n_x)), n_mv + n_dv
    arrays = IdentifiedArrays(
        a=0.8 * a / np.abs(np.linalg.eigvals(a)).max(), b=rng.normal(size=(n_x, n_v)), c=0.1 * rng.normal(size=n_x),
        w1=rng.normal(size=(hidden, n_x + n_v)), b1=rng.normal(size=hidden), w2=0.1 * rng.normal(size=(n_x, hidden)),
        y_center=rng.normal(size=n_y), y_scale=1 + rng.random(n_y), v_center=rng.normal(size=n_v),
        v_scale=1 + rng.random(n_v), rest=np.zeros((n_x, n_y + n_v + 1)),
    )  # fmt: skip
    y, d, u = (
        [Signal(f"{kind}{i}", "m", -5.0, 5.0) for i in range(n)] for kind, n in (("y", n_y), ("d", n_dv), ("u", n_mv))
    )
    return IdentifiedPlant(Signals(1.0, tuple(y), tuple(y), tuple(d), tuple(u)), arrays, most_dead_time=2)


@given(seed=st.integers(0, 2**16), dead=st.floats(0, 2), tau=st.floats(0.7, 2))
@settings(max_examples=15, deadline=None)
def test_the_solver_s_equation_is_the_plant_s(seed: int, dead: float, tau: float) -> None:
    plant, rng = plant_of(seed), np.random.default_rng(seed)
    p = plant.parameters({"gain_u1": 1.3, "time_constant": tau, "dead_time": dead, "load_y0": 0.2})
    x, mv = rng.normal(size=plant.n_x), rng.normal(size=2)
    ours = np.array(transition(plant)(x, mv, p, shares(plant, p), plant.dv_nominal)).ravel()
    np.testing.assert_allclose(ours, plant.step(x, mv, plant.dv_nominal, p), atol=1e-12)


def lag() -> IdentifiedPlant:
    arrays = IdentifiedArrays(
        a=np.array([[POLE]]), b=np.array([[(1 - POLE) * GAIN]]), c=np.zeros(1), w1=np.zeros((0, 2)), b1=np.zeros(0),
        w2=np.zeros((1, 0)), y_center=np.zeros(1), y_scale=np.ones(1), v_center=np.zeros(1), v_scale=np.ones(1),
        rest=np.zeros((1, 3)),
    )  # fmt: skip
    y = (Signal("y", "m", -2.0, 2.0),)
    return IdentifiedPlant(Signals(1.0, y, y, (), (Signal("u", "V", -1.0, 1.0),)), arrays)


def errors_of(test: Scenario, pv: np.ndarray, mv: np.ndarray) -> dict[str, float]:
    return {"error": float(np.abs(test.sp - pv).sum()), "largest": float(np.abs(mv).max())}


def test_a_lag_is_driven_at_its_limit_until_it_arrives() -> None:
    plant = lag()
    test = Scenario("t", "T", np.ones((60, 1)), np.zeros(1), np.zeros(1), hold=60)
    y, total = 0.0, 0.0
    for _ in range(60):
        total += abs(1 - y)
        y = min(POLE * y + (1 - POLE) * GAIN, 1.0)
    figures = run_sampled(SampledHorizon(plant, 20), test, errors_of)
    assert figures["failures"] == 0
    assert figures["error"] == pytest.approx(total, rel=0.01)


def test_a_load_is_known_one_sample_late() -> None:
    plant = lag()
    load = np.where(np.arange(40) >= 10, 0.05, 0.0)
    test = Scenario("t", "T", np.zeros((40, 1)), np.zeros(1), np.zeros(1), {"load_y": load})
    figures = run_sampled(SampledHorizon(plant, 20), test, errors_of)
    # The first sample of the load passes; from then on the MV cancels it, and takes back what has passed.
    assert figures["error"] == pytest.approx(0.05, rel=0.02)


def test_figures_are_kept_until_the_model_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    case, kept, asked = two_lags(), tmp_path / "bounds.json", []

    def solved(case, item):
        asked.append(item)
        return {"mae": 1.0 + item[1], "failures": 0.0}

    monkeypatch.setattr(kept_bounds, "_bound", solved)
    monkeypatch.setattr(kept_bounds, "parallel_map", lambda function, work, label: [function(item) for item in work])
    first = model_bounds(case, kept)
    assert first["held_out"]["nmpc"] == first["held_out_noise"]["nmpc"] == {"mae": 2.0, "failures": 0.0}
    assert len(asked) == len(set(asked)) == 3 + 3 + 6
    text = kept.read_text()
    assert (model_bounds(case, kept), len(asked), kept.read_text()) == (first, 12, text)
    assert len(json.loads(text)["figures"]) > 6
    path = case.models / "plant1.npz"
    with np.load(path) as file:
        changed = {**file, "a": 0.99 * file["a"]}
    np.savez(path, **changed)
    model_bounds(own_case("it"), kept)
    assert len(asked) > 12
