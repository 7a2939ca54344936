"""The first step test sees what linear theory says, and the experiment that it plans stays inside the ranges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.excitation.planned import excited, first_test, planned
from loopwright.pipeline.plants.simulator_file import FileSimulator

LAG = """
class Lag:
    period_s = 1.0
    pv = {{"y": ("K", -2, 2)}}
    mv = {{"u": ("%", -10, 10)}}
    noise = {{"y": 0.01}}
    def start(self):
        return [0.0], [0.0]
    def step(self, x, mv, dv):
        return [{pole} * x[0] + {gain} * mv[0]]
    def measure(self, x):
        return [x[0]]
"""
TANK = """
class Tank:
    period_s = 5.0
    pv = {"level": ("%", 0, 100)}
    mv = {"inlet": ("%", 0, 100)}
    dv = {"outlet": ("%", 35, 65)}
    noise = {"level": 0.1}
    def start(self):
        return [50.0, 50.0, 50.0], [50.0], [50.0]
    def step(self, x, mv, dv):
        return [x[0] + 0.05 * (x[1] - dv[0]), x[2], mv[0]]
    def measure(self, x):
        return [x[0]]
"""


def plant(folder: Path, text: str) -> FileSimulator:
    (folder / "own.py").write_text(text)
    return FileSimulator(folder / "own.py")


def test_a_lag_has_its_gain_and_its_settling_time(tmp_path: Path) -> None:
    test = first_test(plant(tmp_path, LAG.format(pole=0.9, gain=0.05)))
    assert test.settles
    assert test.at_rest
    assert test.gain[0][0] == pytest.approx(0.5, rel=1e-3)
    assert test.settling_periods == pytest.approx(np.log(0.05) / np.log(0.9), abs=1.5)
    assert (test.low[0], test.high[0]) == (-3.0, 3.0)  # 2 / 0.5 is 4, and a share of 0.45 of the range goes too far


def test_the_experiment_of_a_lag_fills_the_safe_range_and_no_more(tmp_path: Path) -> None:
    lag = plant(tmp_path, LAG.format(pole=0.9, gain=0.05))
    plan = planned(lag, first_test(lag), 2000)
    record = excited(lag, plan, 0)
    assert len(record) == 2000
    assert np.all(np.abs(record.pv) <= 2.0)
    assert np.all(np.abs(record.mv) <= 3.0)
    assert np.ptp(record.mv) > 5.0
    holds = np.diff(np.flatnonzero(np.diff(record.mv[:, 0])))
    assert plan.mv_hold[0] <= holds.min() <= holds.max() <= plan.mv_hold[1]
    np.testing.assert_array_equal(excited(lag, plan, 0).pv, record.pv)
    assert not np.array_equal(excited(lag, plan, 1).mv, record.mv)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_tank_that_integrates_does_not_run_over(seed: int, tmp_path: Path) -> None:
    tank = plant(tmp_path, TANK)
    test = first_test(tank)
    assert not test.settles
    assert test.gain[0][0] == pytest.approx(0.05, rel=0.01)  # a period
    record = excited(tank, planned(tank, test, 3000), seed)
    inside = (record.pv >= 0) & (record.pv <= 100)
    assert inside.mean() > 0.995
    assert np.ptp(record.pv) > 50
    assert len(np.unique(record.dv)) > 10


def test_a_start_that_moves_is_told(tmp_path: Path) -> None:
    assert not first_test(plant(tmp_path, TANK.replace("50.0], [50.0], [50.0]", "50.0], [50.0], [45.0]"))).at_rest


def test_a_plant_that_answers_to_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PlantError, match="no process variable answers to a step of 5 % of any MV"):
        first_test(plant(tmp_path, LAG.format(pole=0.9, gain=0.0)))


def test_a_plant_without_room_is_refused(tmp_path: Path) -> None:
    steep = plant(tmp_path, LAG.format(pole=0.9, gain=5.0))
    with pytest.raises(PlantError, match="u cannot move from its start"):
        planned(steep, first_test(steep), 1000)
