"""Times that nobody should learn from: those that a person leaves out, and stops of the plant with their warm-up."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import PERIOD_S, START_S, TAGS, Clean, answer, cells, clean, screen, screen_of, steps, write

from loopwright.pipeline.config.exports import ExportParams, TimeSpan
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.screening import Screened

DATES = "2024-03-04T06:10:00..2024-03-04T06:20:00"  # minutes 10 to 20 of the record


@pytest.mark.parametrize(
    "text",
    [
        DATES,
        "2024-03-04 06:10..2024-03-04 06:20",
        "2024-03-04T07:10+01:00..2024-03-04T07:20+01:00",
        "600..1200",
        f"{START_S + 600}..{START_S + 1200}",
    ],
)
def test_a_time_is_left_out_however_it_is_written(text: str, tmp_path: Path) -> None:
    found = screen_of(clean(), tmp_path, leave_out=[text])
    assert found.report.dropped_rows == {"left_out": 100}
    rows = np.flatnonzero(found.code == Reason.LEFT_OUT)
    assert (rows[0], rows[-1]) == (100, 199)
    assert found.report.runs == 2


@pytest.mark.parametrize("text", [DATES, DATES.replace(":00..", ":00+02:00..") + "+02:00", "600..1200"])
def test_a_date_counts_in_the_zone_that_a_person_named(text: str, tmp_path: Path) -> None:
    data = clean()
    rows = [[datetime.fromtimestamp(float(t), UTC).strftime("%Y-%m-%d %H:%M:%S"), *row] for t, *row in cells(data)]
    found = screen(write(tmp_path / "export.csv", rows), time_zone="+02:00", leave_out=[text])
    left_out = np.flatnonzero(found.code == Reason.LEFT_OUT)
    assert (left_out[0], left_out[-1]) == (100, 199)


def test_days_are_left_out_to_their_end_and_a_time_without_rows_is_said(tmp_path: Path) -> None:
    found = screen_of(clean(), tmp_path, leave_out=["2024-03-05..2024-03-06", "2024-03-04T06:10..2024-03-04T06:20"])
    assert [(f.tag[:10], f.drops) for f in found.report.findings if f.kind == "left_out"] == [
        ("2024-03-05", False),
        ("2024-03-04", True),
    ]
    with pytest.raises(RecordError, match="1500 x a time that was asked to be left out"):
        screen_of(clean(), tmp_path, leave_out=["2024-03-04..2024-03-04"])


@pytest.mark.parametrize(
    "text", ["", "5", "..", "5..", "7..5", "a..b", "2024-02-30..2024-03-01", "2024-03-01..5", "1..2..3", "nan..5",
             "2024-03-01T06:00Z..2024-03-02T06:00"]
)  # fmt: skip
def test_what_is_no_interval_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        TimeSpan.of(text)
    with pytest.raises(ValueError, match=r".+"):
        ExportParams("tank", (Path("x.csv"),), (), leave_out=(text,))


def test_dates_need_an_export_with_dates(tmp_path: Path) -> None:
    data = clean()
    with pytest.raises(RecordError, match="give its seconds"):
        screen_of(data.with_(time_s=data.time_s - START_S), tmp_path, leave_out=[DATES])


def with_a_stop(seed: int, first: int = 2000, last: int = 2700, rest: float = 0.0) -> tuple[Clean, np.ndarray]:
    """A plant without feed and heat for a while, cooling down, and heated up again; where (n,) it is at work.

    The valve rests at ``rest`` [%].
    """
    random, n = np.random.default_rng(seed), 5000
    mv, dv = steps(random, n, 25, 75), 500 + steps(random, n, -50, 50)
    mv[first:last], dv[first:last] = rest, 0.0
    mv[last : last + 40], dv[last : last + 40] = 60.0, np.linspace(0, 500, 40)
    y = np.full(n, 60.0)
    for k in range(n - 1):
        rest = 20 + 0.8 * mv[max(k - 2, 0)] - 0.02 * (dv[k] - 500) if dv[k] > 50 else 15.0
        y[k + 1] = y[k] + (0.03 if dv[k] > 50 else 0.01) * (rest - y[k])
    work = np.ones(n, dtype=bool)
    work[first : last + int(np.argmax(y[last:] > np.quantile(y[:first], 0.02)))] = False
    dv = np.where(dv > 0, dv + random.normal(0, 0.5, n), 0.0)
    return Clean(
        START_S + PERIOD_S * np.arange(n), np.round(y + random.normal(0, 0.1, n), 3), mv, np.round(dv, 2)
    ), work


def stopped(found: Screened) -> np.ndarray:
    return found.code == Reason.STOP


@pytest.mark.parametrize(("seed", "rest"), [(0, 0.0), (1, 0.0), (2, 0.0), (0, 3.0), (1, 15.0)])
def test_a_stop_is_called_one_and_goes_with_its_warm_up(seed: int, rest: float, tmp_path: Path) -> None:
    data, work = with_a_stop(seed, rest=rest)
    found = screen_of(data, tmp_path)
    assert [f.kind for f in found.report.findings if f.kind in {"stop", "sentinel", "zero", "unlike"}] == ["stop"]
    assert np.mean(stopped(found)[~work]) > 0.98
    assert np.mean(stopped(found)[work]) < 0.01
    assert found.report.verdict.carries == "yes"


def test_a_closed_valve_and_a_large_load_are_no_stop(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    mv, dv = steps(random, 1500, 30, 70), 500 + steps(random, 1500, -50, 50)
    mv[600:700], dv[600:700] = 0.0, 700.0
    pv = np.round(answer(mv, dv) + random.normal(0, 0.1, 1500), 3)
    data = Clean(START_S + PERIOD_S * np.arange(1500), pv, mv, dv)
    assert not stopped(screen_of(data, tmp_path)).any()
    alone = screen_of(data, tmp_path, TAGS[:2])
    assert not stopped(alone).any()


def test_the_largest_moves_of_a_record_are_no_stop(tmp_path: Path) -> None:
    """A test by hand takes the MV higher than ever, and the PV, moved by a load too, farther than the MV explains."""
    random, n = np.random.default_rng(6), 3000
    mv, dv = 45 + steps(random, n, -5, 5), 500 + random.normal(0, 0.5, n)
    mv[1500:1560] = 60.0
    load = np.convolve(np.where((np.arange(n) >= 1480) & (np.arange(n) < 1570), 25.0, 0.0), np.full(20, 0.05))[:n]
    pv = np.round(answer(mv, dv) + load + random.normal(0, 0.1, n), 3)
    data = Clean(START_S + PERIOD_S * np.arange(n), pv, mv, np.round(dv, 2))
    assert not stopped(screen_of(data, tmp_path)).any()


def regulated(seed: int, first: int, last: int, valve: float) -> Clean:
    """A valve that works from 40 to 50 %, and stands at ``valve`` from row ``first`` to ``last``; the feed goes on."""
    random, n = np.random.default_rng(seed), 4000
    mv, dv = steps(random, n, 40, 50), 500 + random.normal(0, 5, n)
    mv[first:last] = valve
    pv = np.round(answer(mv, dv) + random.normal(0, 0.1, n), 3)
    return Clean(START_S + PERIOD_S * np.arange(n), pv, mv, np.round(dv, 2))


def test_a_stop_is_seen_beside_a_warm_up_that_is_longer(tmp_path: Path) -> None:
    """Rows of the warm-up, a tenth of the record, are not where the plant works."""
    random, n = np.random.default_rng(0), 4000
    mv, dv = steps(random, n, 40, 50), 500 + random.normal(0, 5, n)
    mv[2000:2400], mv[2400:2800] = 0.0, np.linspace(0.0, 45.0, 400)
    pv = np.round(answer(mv, dv) + random.normal(0, 0.1, n), 3)
    found = stopped(screen_of(Clean(START_S + PERIOD_S * np.arange(n), pv, mv, np.round(dv, 2)), tmp_path))
    rows = np.flatnonzero(found)
    assert abs(rows[0] - 2000) <= 3
    assert 2650 < rows[-1] < 2850


def test_a_record_may_end_in_a_stop(tmp_path: Path) -> None:
    rows = np.flatnonzero(stopped(screen_of(regulated(0, 3400, 4000, 0.0), tmp_path)))
    assert (abs(rows[0] - 3400) <= 3, rows[-1]) == (True, 3999)


def test_a_shut_valve_for_long_is_a_stop_though_the_feed_goes_on(tmp_path: Path) -> None:
    found = screen_of(regulated(0, 2000, 2600, 0.0), tmp_path)
    rows = np.flatnonzero(stopped(found))
    assert abs(rows[0] - 2000) <= 3
    assert 2600 < rows[-1] < 2650
    (stop,) = [f for f in found.report.findings if f.kind == "stop"]
    assert "2024-03-04T09:19:57..2024-03-04T10:2" in stop.words
    kept = (TAGS[0], replace(TAGS[1], ends="keep"), TAGS[2])
    assert not stopped(screen_of(regulated(0, 2000, 2600, 0.0), tmp_path, kept)).any()


@pytest.mark.parametrize("valve", [0.0, 100.0])
def test_a_test_at_an_end_stays_and_a_line_asks_about_it(valve: float, tmp_path: Path) -> None:
    tags = (TAGS[0], replace(TAGS[1], low=0.0, high=100.0), TAGS[2])
    found = screen_of(regulated(1, 2000, 2060, valve), tmp_path, tags)
    assert not stopped(found).any()
    (rest,) = [f for f in found.report.findings if f.kind == "rest"]
    left_out = rest.words.partition("--leave-out ")[2].split()[0]
    asked = screen_of(regulated(1, 2000, 2060, valve), tmp_path, tags, leave_out=[left_out])
    rows = np.flatnonzero(asked.code == Reason.LEFT_OUT)
    assert abs(rows[0] - 2000) <= 5
    assert 2060 < rows[-1] < 2100


def test_a_range_that_the_table_guessed_states_no_end(tmp_path: Path) -> None:
    """It writes an MV's lowest and highest reading as low and high, unless its unit is %."""
    data = regulated(2, 2000, 2600, 70.0)
    guess = replace(TAGS[1], unit="m3/h", low=float(data.mv.min()), high=70.0)
    for tag, stops in ((guess, False), (replace(guess, low=0.0), True)):
        assert bool(stopped(screen_of(data, tmp_path, (TAGS[0], tag, TAGS[2]))).any()) is stops


@pytest.mark.parametrize(("unit", "coldest"), [("degC", 0.1), ("", 0.6)])
def test_cold_weather_is_no_stop(unit: str, coldest: float, tmp_path: Path) -> None:
    """A cooling valve is closed, and the ambient temperature is nearly 0 degC: the plant works."""
    random, n = np.random.default_rng(3), 3000
    cold = np.interp(np.arange(n), [0, 1800, 1900, 2100, 2200, n], [15, 14, coldest, coldest, 15, 16])
    ambient = cold + np.where((np.arange(n) > 1900) & (np.arange(n) < 2100), 0.02, 1.0) * random.normal(0, 1, n)
    y, total, mv, pv = 20.0, 50.0, np.zeros(n), np.zeros(n)
    for k in range(n):
        error = y - (20 + (k // 100 % 3) - 1)
        total = min(max(total + 0.8 * error, 0.0), 100.0)
        mv[k] = np.round(np.clip(10 * error + total, 0, 100), 2)
        y += 0.05 * (ambient[k] + 14 - y - 0.18 * mv[k])
        pv[k] = round(y + 0.03 * random.normal(), 3)
    assert np.mean(mv[1920:2100] == 0) > 0.9
    data = Clean(START_S + PERIOD_S * np.arange(n), pv, mv, np.round(ambient, 2))
    assert not stopped(screen_of(data, tmp_path, (*TAGS[:2], replace(TAGS[2], unit=unit)))).any()


def test_a_feed_that_is_off_again_and_again_is_how_the_plant_is_run(tmp_path: Path) -> None:
    random, n = np.random.default_rng(4), 4000
    mv, dv = np.repeat(random.uniform(40, 50, n // 200).round(1), 200), 500 + random.normal(0, 5, n)
    dv[np.arange(n) % 400 < 60] = 0.0
    pv = np.round(answer(mv, dv) + random.normal(0, 0.1, n), 3)
    data = Clean(START_S + PERIOD_S * np.arange(n), pv, mv, np.round(dv, 2))
    assert not stopped(screen_of(data, tmp_path)).any()
