"""Daily work: under the MVs of the record the replay is the record, and under its old law it nearly is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identified_models import scaled_model
from own_cases import case_of, loop_of, section

from loopwright.pipeline.cases.own_model import OwnPlant
from loopwright.pipeline.cases.own_plant import DAILY, OwnCase
from loopwright.pipeline.cases.own_tests import LEAST_DAILY_ROWS, MOST_DAILY_ROWS, day, spread, windows
from loopwright.pipeline.evaluation.trials import Trials
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.metrics import mae
from loopwright.pipeline.records.record_file import RecordedSetPoints, stretches
from loopwright.pipeline.simulation.simulate import simulate_closed
from loopwright.pipeline.tuning.rules import PidSettings

KC, TI_S, ROWS = 0.15, 12.0, 1500
POLES = (0.9, 0.93, 0.85)  # of the law's model, and of the plants of the tests: none is the record's
PLANT, GAIN = 0.9, 2.0


def record(same_row: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """PV, MV and set point (n, 1) each of a lag under a PI, with a load and noise that nobody measures."""
    random = np.random.default_rng(3)
    pv, mv, sp = (np.zeros((ROWS, 1)) for _ in range(3))
    x = load = u = r = p1 = 0.0
    for k in range(ROWS):
        y = x + 0.02 * random.normal()
        if random.random() < 0.02:
            r = random.uniform(-0.6, 0.6)
        u = float(np.clip(u + KC * (r - y - p1 + (r - y) / TI_S), -1, 1))
        p1 = r - y
        pv[k], mv[k], sp[k] = y, u, r
        load += -load / 100 + 0.03 * random.normal()
        x = PLANT * x + (1 - PLANT) * (GAIN * u + load)
    return pv, np.roll(mv, 1, axis=0) if same_row else mv, sp


def own(values: np.ndarray, pv: np.ndarray, mv: np.ndarray) -> OwnCase:
    models = [scaled_model(1, 1, 0, 1, a=[[p]], b=[[(1 - p) * GAIN]], rest=np.eye(1, 3)) for p in POLES]
    case = case_of(section(1, 1), models, pv, mv)
    RecordedSetPoints(("y0",), values).write(case.data)
    return case


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("same_row", [False, True])
def test_under_the_recorded_mvs_any_model_gives_the_recorded_outputs(same_row: bool) -> None:
    pv, mv, sp = record(same_row)
    case = own(sp, pv, mv)
    plant, rows = case.members[0], slice(400, 900)
    assert isinstance(plant, OwnPlant)
    one = day(plant, case.record, sp, rows, same_row=same_row)
    assert one is not None
    given = iter(one.mv)
    (test, *_) = case.scenarios()[DAILY]
    test = replace(test, sp=one.sp, x0=one.x0, mv0=one.mv0, changes={"load_y0": one.load[:, 0]}, dv=one.dv)
    loop = simulate_closed(plant, lambda *_: (next(given), ()), test)
    np.testing.assert_allclose(loop.pv, pv[rows], atol=1e-12)
    assert one.mv0 == pytest.approx(mv[rows.start - 1 + same_row])


def test_under_the_old_law_the_replay_has_the_error_and_the_travel_of_the_record() -> None:
    pv, mv, sp = record()
    case = own(sp, pv, mv)
    law = PID(case.signals, PidSettings(KC, TI_S))
    for test in case.scenarios()[DAILY]:
        loop = loop_of(law, test)
        rows = np.flatnonzero(np.isclose(sp[: ROWS - test.samples, 0], test.sp[0, 0]))
        (start,) = (k for k in rows if np.array_equal(sp[k : k + test.samples], test.sp))
        known = slice(start, start + test.samples)
        assert mae(test.sp, loop.pv) == pytest.approx(mae(sp[known], pv[known]), rel=0.03)
        assert np.abs(np.diff(loop.mv[:, 0])).sum() == pytest.approx(np.abs(np.diff(mv[known, 0])).sum(), rel=0.03)


def test_the_recorded_noise_is_not_added_to_and_weighs_nothing_in_the_gate() -> None:
    pv, mv, sp = record()
    case = own(sp, pv, mv)
    keys = {piece.key for piece in Trials(case, 1).pieces("base", 0, Path("x.onnx"))}
    assert {"daily", "held_out", "held_out_noise"} <= keys
    assert "daily_noise" not in keys
    assert DAILY not in case.weights
    assert f"{mae(sp[1:-1], pv[1:-1]):.3g} m" in case.scenarios()[DAILY][0].title


def test_there_is_no_such_test_without_set_points_or_where_they_are_known_for_short_times_only() -> None:
    pv, mv, sp = record()
    case = own(np.where(np.arange(ROWS)[:, None] % LEAST_DAILY_ROWS, sp, np.nan), pv, mv)
    assert DAILY not in case.scenarios()
    assert len(case.lacking) == 1  # the report says so
    case = own(sp, pv, mv)
    case.data.with_name("set_points.npz").unlink()
    assert DAILY not in case.with_held_out((7, 8)).scenarios()


def test_windows_lie_within_a_run_and_within_what_is_known() -> None:
    pv, mv, sp = record()
    long = np.tile(sp, (6, 1))
    long[4000:4100] = np.nan
    case = own(long, np.tile(pv, (6, 1)), np.tile(mv, (6, 1)))
    found = windows(case.record, long, 30)
    assert all(LEAST_DAILY_ROWS <= rows.stop - rows.start <= MOST_DAILY_ROWS for rows in found)
    assert all(np.isfinite(long[rows]).all() for rows in found)
    assert [rows.stop for rows in found] == [2001, 3999, 6101, 8101, 8999]
    assert spread(found) == [found[0], found[2], found[4]]  # of 6,000 rows
    assert spread(found[:1]) == found[:1]
    assert spread([]) == []
    short = [slice(k, k + 300) for k in range(0, 9000, 400)]
    assert len(spread(short)) == 20


def test_stretches_end_at_runs_and_at_what_is_not_known() -> None:
    known = np.array([1, 1, 1, 0, 1, 1, 1, 1, 1], dtype=bool)
    run = np.array([0, 0, 0, 0, 0, 0, 1, 1, 1])
    assert stretches(known, run, 2) == [slice(0, 3), slice(4, 6), slice(6, 9)]
    assert stretches(known, run, 3) == [slice(0, 3), slice(6, 9)]


def test_set_points_come_back_by_the_names_of_their_pvs(tmp_path: Path) -> None:
    values = np.array([[1.0, np.nan], [2.0, 3.0]])
    RecordedSetPoints(("a", "b"), values).write(tmp_path / "record.parquet")
    found = RecordedSetPoints.beside(tmp_path / "record.parquet")
    assert found is not None
    np.testing.assert_array_equal(found.of(["b", "a"]), values[:, ::-1])
    assert found.of(["a", "c"]) is None
    assert RecordedSetPoints.beside(tmp_path / "other" / "record.parquet") is None
