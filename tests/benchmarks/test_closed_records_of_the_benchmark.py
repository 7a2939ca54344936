"""The benchmark's plants in closed loop: what their records and their export hold, and the old loop that keeps them."""

from __future__ import annotations

import csv
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmark_modules import FOLDER, own_plants_modules

MODULES = (
    "plant", "loops", "record", "store", "closed_plant", "closed_development", "closed_untouched", "closed_record",
    "closed_product", "closed_benchmark", "closed_refused",
)  # fmt: skip
ROWS = 600


@pytest.fixture(scope="module")
def own() -> Any:
    return own_plants_modules(MODULES)


def plants(own: Any) -> dict[str, Any]:
    """The plants by name."""
    return {p.name: p() for p in (*own.closed_development.CLOSED_DEVELOPMENT, *own.closed_untouched.CLOSED_UNTOUCHED)}


def test_the_twelve_cover_what_they_shall(own: Any) -> None:
    found = plants(own)
    assert len(found) == 12
    assert len(own.closed_development.CLOSED_DEVELOPMENT) == 6
    assert sorted(len(p.mv_signals) for p in found.values()) == [1] * 10 + [2, 3]
    assert sum(bool(p.measured_disturbances) for p in found.values()) >= 3
    for plant in found.values():
        assert len(plant.loops) == len(plant.mv_signals) == len(plant.sp_signals)
    spans = {n: p.sp_signals[0].high - p.sp_signals[0].low for n, p in found.items()}
    assert max(p.noise[0] / spans[n] for n, p in found.items()) == pytest.approx(0.1)


@pytest.mark.parametrize(
    "name",
    [
        "dryer", "sump", "crest", "foam", "sticking", "growth",
        "boiler", "blender", "sluice", "fouling", "evaporator", "belt",
    ],
)  # fmt: skip
def test_a_record_repeats_and_the_old_loop_holds_its_plant(own: Any, name: str) -> None:
    plant = plants(own)[name]
    record, again = (own.closed_record.closed_record_of(plant, ROWS) for _ in range(2))
    for part in ("sp", "pv", "op", "manual", "dv", "true"):
        np.testing.assert_array_equal(getattr(record, part), getattr(again, part))
    other = own.closed_record.closed_record_of(plant, ROWS, seed=1)
    assert not np.array_equal(record.pv, other.pv)
    assert ((record.op >= 0) & (record.op <= 100)).all()
    for i, signal in enumerate(plant.pv_signals):
        assert ((record.true[:, i] > signal.low) & (record.true[:, i] < signal.high)).all()
        span = plant.sp_signals[i].high - plant.sp_signals[i].low
        auto = ~record.manual[:, i]
        assert np.abs(record.true - record.sp)[auto, i].mean() < 0.35 * span
        assert len(np.unique(record.sp[:, i])) < 20  # an operator's set points are rare
    assert np.std(record.pv - record.true, axis=0) == pytest.approx(plant.noise_std, rel=0.15)


def test_what_wanders_moves_the_plant_as_far_as_its_set_points_do(own: Any) -> None:
    """With the MV left alone, and the set points as operators choose them."""
    for name, plant in plants(own).items():
        if name in {"sump", "boiler"}:
            continue  # a level has no answer at rest
        n, rng = 5_000, np.random.default_rng(3)
        courses = {k: v for k, v in plant.drift(n, rng).items() if k.startswith("wander")}
        first = plant.with_parameters({k: float(v[0]) for k, v in courses.items()})
        x, mv = first.rest(np.array([s.middle for s in plant.sp_signals]))
        p = np.tile(plant.parameters(), (n, 1))
        for key, values in courses.items():
            p[:, plant.parameter_names().index(key)] = values
        step, y = plant.stepper(), np.empty((n, len(plant.pv_signals)))
        for k in range(n):
            y[k] = plant.measured(x)
            x = step(x, mv, plant.dv_nominal, p[k])
        moved = y.std(axis=0) / own.closed_plant.operated(plant, 40_000, rng).std(axis=0)
        assert (moved > 0.8).all(), name
        assert (moved < 3.0).all(), name


def test_times_in_manual_are_a_twentieth_to_an_eighth_of_the_rows(own: Any) -> None:
    for plant in plants(own).values():
        manual, hand = own.closed_record.hands(plant, 12_000, np.random.default_rng(0))
        assert ((manual.mean(axis=0) > 0.05) & (manual.mean(axis=0) < 0.12)).all(), plant.name
        assert not hand[~manual].any()
        assert np.count_nonzero(hand, axis=0).min() > 10


def test_the_export_is_what_the_product_reads(own: Any, tmp_path: Path) -> None:
    plant, file = plants(own)["dryer"], tmp_path / "dryer.csv"
    record = own.closed_record.closed_record_of(plant, ROWS)
    own.closed_record.write_export(plant, record, file)
    with file.open(newline="") as lines:
        head, *rows = csv.reader(lines)
    assert head == ["Timestamp", "TIC-101.SP", "TIC-101.PV", "TIC-101.OP", "TIC-101.MODE", "FI-7"]
    assert len(rows) == ROWS
    times = [datetime.fromisoformat(row[0]) for row in rows]
    assert {(b - a).total_seconds() for a, b in pairwise(times)} == {plant.period_s}
    assert {row[4] for row in rows} <= {"AUTO", "MAN"}
    np.testing.assert_allclose([float(row[2]) for row in rows], record.pv[:, 0], atol=0.01)
    with own.closed_record.truth_beside(file).open(newline="") as lines:
        head, *truth = csv.reader(lines)
    assert head == ["Timestamp", "TIC-101", "wander", "feed"]
    np.testing.assert_allclose([float(row[1]) for row in truth], record.true[:, 0], rtol=1e-5)
    found = own.closed_product.read(file, own.closed_record.roles(plant))
    assert [s.name for s in found.signals.pv] == ["TIC-101.PV"]
    assert [s.name for s in found.signals.mv] == ["TIC-101.OP"]
    assert [s.name for s in found.signals.dv] == ["FI-7"]
    assert found.signals.period_s % plant.period_s == 0
    assert len(found.record) > 0.9 * ROWS * plant.period_s / found.signals.period_s


def test_the_old_loop_is_a_pi_within_the_ends_of_its_output(own: Any) -> None:
    loop = own.closed_plant.OldLoop("TIC-1", 0.5, 100.0, 10.0, 60.0)
    law = own.closed_record.OldLaw([loop], 10.0)
    state, mv, none = torch.zeros(law.n_state, dtype=torch.float64), torch.tensor([40.0]), torch.zeros(0)
    sp, moved = torch.tensor([5.0]), []
    for pv in (5.0, 3.0, 3.0):
        mv, state, _ = law(sp, torch.tensor([pv]), none, mv, state)
        moved.append(float(mv))
    assert moved == pytest.approx([40.0, 40.0 + 0.5 * (2 + 0.1 * 2), 41.1 + 0.5 * 0.1 * 2])
    mv, _, _ = law(torch.tensor([500.0]), torch.tensor([3.0]), none, mv, state)
    assert float(mv) == 60.0
    mv, _, _ = law(torch.tensor([500.0]), torch.tensor([3.0]), none, torch.tensor([80.0]), state)
    assert float(mv) == 80.0  # where a hand left it


def test_a_slower_law_steps_at_its_own_period(own: Any) -> None:
    class Counts:
        n_state = 1

        def __call__(self, sp: Any, pv: Any, dv: Any, mv: Any, state: Any) -> Any:
            return mv + 1, state + 1, pv[..., :0]

    for periods, steps in ((2.0, [0, 2, 4, 6, 8]), (2.5, [0, 3, 5, 8])):
        law = own.closed_product.Paced(Counts(), periods)
        state, mv, moved = torch.zeros(3, 2), torch.zeros(3, 1), []
        for k in range(10):
            after, state, _ = law(mv, mv, mv[:, :0], mv, state)
            moved += [k] if float(after[0]) > float(mv[0]) else []
            mv = after
        assert moved == steps
        assert state[0].tolist() == [10, len(steps)]


def test_measured_disturbances_reach_the_controller_and_wandering_loads_do_not(own: Any) -> None:
    plant = plants(own)["dryer"]
    tests = own.closed_plant.closed_tests_of(plant)
    assert set(tests) == {"set points", "loads", "day"}
    seen: list[Any] = []

    class Still:
        n_state = 0

        def __call__(self, sp: Any, pv: Any, dv: Any, mv: Any, state: Any) -> Any:
            seen.append(dv.clone())
            return mv, state, pv[..., :0]

    short = tests["loads"][:1]
    own.loops.closed(Still(), plant, short)
    shown = torch.cat(seen).numpy()
    changes = short[0].scenario.changes
    assert set(changes) == {"load", "wander", "feed"}
    np.testing.assert_allclose(shown[:, 0], changes["feed"], atol=0.3)
    assert np.abs(changes["load"]).max() == own.loops.LOAD


@pytest.mark.parametrize("kind", ["regulation", "follower", "wrong tags", "shuffled"])
def test_records_that_must_be_refused_are_what_they_are_said_to_be(own: Any, kind: str) -> None:
    plant = plants(own)["crest"]
    rows, normal = 400, own.closed_record.closed_record_of(plant, 400, 3)
    record, again = (own.closed_refused.KINDS[kind](plant, rows, 3) for _ in range(2))
    np.testing.assert_array_equal(record.pv, again.pv)
    if kind in {"regulation", "follower"}:
        assert len(np.unique(record.sp)) == 1
        assert not record.manual.any()
        assert np.ptp(record.op) > 1.0
    if kind == "wrong tags":
        np.testing.assert_array_equal(record.op, normal.op)
        assert abs(np.corrcoef(record.true[:, 0], normal.true[:, 0])[0, 1]) < 0.9
    if kind == "shuffled":
        np.testing.assert_array_equal(np.sort(record.pv, axis=0), np.sort(normal.pv, axis=0))
        assert np.abs(np.diff(record.true[:, 0])).mean() > 3 * np.abs(np.diff(normal.true[:, 0])).mean()


def test_what_moves_with_a_pv_and_moves_nothing_leaves_the_plant_to_its_loads(own: Any) -> None:
    plant = plants(own)["dryer"]
    follower = own.closed_refused.KINDS["follower"](plant, 400, 0)
    courses = plant.drift(400, np.random.default_rng(0))
    first = plant.with_parameters({key: float(values[0]) for key, values in courses.items()})
    x, _ = first.rest(follower.sp[0])
    p = np.tile(plant.parameters(), (400, 1))
    for key, values in courses.items():
        p[:, plant.parameter_names().index(key)] = values
    step, valves, y = plant.stepper(), plant.rest(follower.sp[0])[1], np.empty(400)
    for k in range(400):
        y[k] = plant.measured(x)[0]
        x = step(x, valves, plant.dv_nominal, p[k])
    np.testing.assert_allclose(follower.true[:, 0], y, atol=1e-9)


def test_a_shipped_file_steps_each_test_as_the_runtime_does(own: Any) -> None:
    law = own.closed_product.Shipped(FOLDER.parent / "artifacts" / "thiosulfate_cstr" / "pid.onnx")
    controller, rng = law.controller, np.random.default_rng(0)
    ranges = {role: controller.manifest.signals(role) for role in ("sp", "pv", "dv", "mv")}
    drawn = {
        role: torch.tensor([[rng.uniform(s.low, s.high) for s in group] for _ in range(3)], dtype=torch.float64)
        for role, group in ranges.items()
    }
    state = torch.zeros(3, law.n_state, dtype=torch.float64)
    for _ in range(2):
        moved, after, _ = law(drawn["sp"], drawn["pv"], drawn["dv"], drawn["mv"], state)
        for i in range(3):
            sp, pv, mv = (drawn[role][i].numpy() for role in ("sp", "pv", "mv"))
            step = controller.step(sp=sp, pv=pv, mv_applied=mv, state=state[i].numpy())
            np.testing.assert_array_equal(moved[i], step.mv)
            np.testing.assert_array_equal(after[i], step.state)
        state = after
    assert law.refused == 0


def test_the_summary_counts_over_all_plants(own: Any) -> None:
    first = own.closed_benchmark.FIRST

    def score(value: float) -> dict[str, list[float]]:
        return {**{test: [value, 1.0] for test in own.closed_benchmark.TESTS}, first: [value]}

    others = {"old loop": score(10.0), "tuned PID": score(4.0), "NMPC": {first: [2.0]}}
    rows = [
        (others, {"predictive": score(3.0), "pid": score(9.0)}),
        (others, {"pid": score(5.0)}),
        (others, {}),
    ]
    lines = own.closed_benchmark.summary(rows).splitlines()
    assert lines[0].startswith("a controller for 2 of 3")
    assert "set points 2 of 3" in lines[1]
    assert "set points 1 of 3" in lines[2]
    assert "2.00 in the median, 2.50 at worst" in lines[3]


def test_the_tuned_pid_keeps_within_the_ends_of_the_old_loops_output(own: Any) -> None:
    plant = plants(own)["crest"]

    class Wild:
        n_state = 0

        def __call__(self, sp: Any, pv: Any, dv: Any, mv: Any, state: Any) -> Any:
            return mv + 1e3 * torch.sign(sp - pv), state, pv[..., :0]

    law = own.closed_benchmark.Within(Wild(), plant)
    low, high, mv = torch.tensor([[0.0]]), torch.tensor([[90.0]]), torch.tensor([[40.0]])
    assert float(law(high, low, low, mv, low)[0]) == plant.loops[0].high
    assert float(law(low, high, low, mv, low)[0]) == plant.loops[0].low
