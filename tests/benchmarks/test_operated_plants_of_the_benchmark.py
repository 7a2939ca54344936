"""The benchmark's plants under ranges and costs: days repeat, records stay within bounds, and a small contest runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_modules import FOLDER, benchmark_modules

from loopwright.pipeline.laws.predictive.operating import entries_of
from loopwright.serving.operating import Operate

MODULES = (
    "operated_plant", "pid_blocks", "figures", "separating", "mixing", "heating", "moving", "from_record",
    "perfect_economic", "contest", "operating_changes",
)  # fmt: skip
NAMES = ("column", "tank", "blender", "furnace", "exchanger", "pumps", "evaporator", "reactor")


@pytest.fixture(scope="module")
def own() -> Any:
    return benchmark_modules(MODULES, FOLDER / "operated_plants")


@pytest.fixture(scope="module")
def plants(own: Any) -> dict[str, Any]:
    """The plants by name."""
    both = (own.separating, ("COLUMN", "EVAPORATOR")), (own.mixing, ("TANK", "BLENDER"))
    more = (own.heating, ("FURNACE", "EXCHANGER")), (own.moving, ("PUMPS", "REACTOR"))
    found = [getattr(module, name) for module, names in (*both, *more) for name in names]
    return {p.name: p for p in found}


def test_the_eight_cover_what_they_shall(plants: dict[str, Any]) -> None:
    assert sorted(plants) == sorted(NAMES)
    sizes = {(len(p.pv), len(p.mv)) for p in plants.values()}
    assert (2, 2) in sizes
    assert (4, 3) in sizes
    assert sum(len(p.mv) > len(p.sp) for p in plants.values()) >= 2
    assert sum(any(n.endswith(".cost") for n in p.operate) for p in plants.values()) >= 4
    assert plants["blender"].late == {0: 5}
    assert plants["blender"].every == {0: 20}
    for p in plants.values():
        entries = entries_of(p.signals, len(p.pv), (), (), p.operate)  # raises for what operators may not set
        values = dict(zip(Operate(entries).places, Operate(entries).default, strict=True))
        assert all(values[name] == value for name, value in p.operate.items())


@pytest.mark.parametrize("name", NAMES)
def test_a_record_and_a_day_repeat_and_stay_on_the_plant(own: Any, plants: dict[str, Any], name: str) -> None:
    plant = plants[name]
    record, again = (own.from_record.record_of(plant, 600) for _ in range(2))
    np.testing.assert_array_equal(record.pv, again.pv)
    for signal, values in zip(plant.mv, record.mv.T, strict=True):
        assert signal.low <= values.min() < values.max() <= signal.high
        assert np.abs(np.diff(values)).max() <= signal.max_move + 1e-9
    assert np.isfinite(record.pv).all()
    day, other = plant.day(1, 50), plant.day(2, 50)
    np.testing.assert_array_equal(day.w, plant.day(1, 50).w)
    assert not np.array_equal(day.noise, other.noise)
    x, mv = plant.start
    after = plant.step(x, mv, plant.dv0, plant.w0)
    np.testing.assert_allclose(after, x, atol=1e-6 * np.abs(x).max())


@pytest.mark.parametrize("name", NAMES)
def test_the_pids_hold_their_plant(own: Any, plants: dict[str, Any], name: str) -> None:
    plant = plants[name]
    day = plant.day(7, 120)
    run = own.figures.run_day(plant, plant.scheme(plant, np.array(list(plant.settings.values()))), day)
    figures = own.figures.figures_of(plant, [day], [run])
    assert figures.error < 20
    assert figures.beyond < 20


def test_the_search_of_settings_ends_where_the_cost_is_below_zero(own: Any) -> None:
    found = own.pid_blocks.searched(np.array([4.0, 1.0]), lambda n: float((np.log(n) ** 2).sum()) - 5.0)
    assert np.abs(np.log(found)).max() < 0.1
    still = own.pid_blocks.searched(np.array([4.0]), lambda n: -5.0)
    np.testing.assert_array_equal(still, [4.0])


def test_figures_of_a_made_up_run(own: Any, plants: dict[str, Any]) -> None:
    plant = plants["column"]
    day = plant.day(1, 60)
    pv = np.column_stack([day.sp[:, 0] + 0.25, np.full(60, 2.0), np.full(60, 30.0)])
    pv[50:, 1] = 3.0  # half of what counts, half a unit above the limit of a range of 2.5
    run = own.figures.Run(pv, np.full((60, 2), 40.0))
    found = own.figures.figures_of(plant, [day], [run])
    assert found.error == pytest.approx(10.0)
    assert found.inside == pytest.approx(50.0)
    assert found.beyond == pytest.approx(100 * 0.5 * 0.5 / 2.5 / 2)
    assert found.profit == pytest.approx(-40 * 20)
    assert found.travel == 0.0


def test_a_late_reading_is_late(own: Any, plants: dict[str, Any]) -> None:
    plant = plants["blender"]
    x, mv = plant.start
    true, shown = [], []
    for _ in range(12):
        both = plant.look(x)
        true.append(both[0][0])
        shown.append(both[1][0])
        x = plant.step(x, mv + np.array([8.0, 0, -8]), plant.dv0, plant.w0)
    np.testing.assert_allclose(shown[5:], true[:-5])
    assert true[-1] > true[0]


def test_the_perfect_filter_follows_what_wanders(own: Any, plants: dict[str, Any]) -> None:
    plant = plants["pumps"]
    seen = own.perfect_economic.TrueFilter(plant)
    x, mv = plant.start
    w = np.array([3.0, 2.0])
    for _ in range(60):
        seen.see(plant.look(x)[1], np.ones(2))
        seen.go_on(mv, plant.dv0)
        x = plant.step(x, mv, plant.dv0, w)
    assert np.abs(seen.z[2:] - w).max() < 0.8
    assert np.abs(seen.z[:2] - x).max() < 0.5


def test_a_small_contest(own: Any, plants: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own.from_record, "FOLDER", tmp_path)
    monkeypatch.setattr(own.contest, "FOLDER", tmp_path)
    monkeypatch.setattr(own.contest, "tuned_settings", lambda plant: np.array(list(plant.settings.values())))
    fit = own.from_record.Fit(rows=900, minutes=0.02)
    found = own.contest.contested(plants["pumps"], fit=fit, seeds=(3,), samples=70)
    assert set(found.figures) == {"ours", "PID", "NMPC"}
    assert found.figures["NMPC"].error < found.figures["PID"].error
    assert found.figures["ours"].error < 2 * found.figures["PID"].error
    assert len(own.contest.rows_of(found).splitlines()) == 3
