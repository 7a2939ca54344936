"""The sampling period follows from how long the plant takes to settle, whatever the step of the export."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from dirty_plant import clean, screen_of, write
from scipy.signal import lfilter
from undrawn import draw_nothing

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.config.exports import ExportParams, screened_record
from loopwright.pipeline.historian.cleaning.record_rows import WINDOWED
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.settling import (
    FINE_EXPORT,
    MOST_PERIODS,
    Pace,
    SettlingAnswer,
    _settling,
    in_words,
    of_period,
    pace_of,
)
from loopwright.pipeline.stages.screen import screen

START_S = 1_709_532_000.0


def lagged(u: np.ndarray, *lags_s: float, dead_s: int = 0) -> np.ndarray:
    """The answer (n,) to u (n,), a row a second: first-order lags in a row, and a dead time."""
    y = np.r_[np.full(dead_s, u[0]), u[: len(u) - dead_s]]
    for lag in lags_s:
        a = np.exp(-1 / lag)
        y = lfilter([0, 1 - a], [1, -a], y)
    return y


def steps(seed: int, n: int, shortest: int, longest: int) -> np.ndarray:
    """Moves of an MV from -30 to 30 that are held for so many rows."""
    random, u, k = np.random.default_rng(seed), np.empty(n), 0
    while k < n:
        hold = int(random.integers(shortest, longest))
        u[k : k + hold], k = random.uniform(-30, 30), k + hold
    return u


def noise(seed: int, n: int, sd: float) -> np.ndarray:
    return np.random.default_rng(1000 + seed).normal(0, sd, n)


def pace(pvs: list[np.ndarray], mvs: list[np.ndarray], step_s: float = 1.0) -> Pace:
    columns = {f"{role}{i}": (role, v) for role, group in (("pv", pvs), ("mv", mvs)) for i, v in enumerate(group)}
    time_s = step_s * np.arange(len(pvs[0]))
    good = np.zeros(len(time_s), np.uint8)
    series = {tag: Series(tag, time_s, v, good.copy(), Counter()) for tag, (_, v) in columns.items()}
    return pace_of(series, [Tag(tag, role) for tag, (role, _) in columns.items()], step_s)


def slow(seed: int, n: int, hold: tuple[int, int] = (600, 3000)) -> tuple[np.ndarray, np.ndarray]:
    """A plant that settles in 800 s, and its MV."""
    u = steps(seed, n, *hold)
    return 0.5 * lagged(u, 300, 60, dead_s=30), u


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("hold", [(600, 3000), (20, 120)])
def test_a_slow_plant_with_noise_and_hum(seed: int, hold: tuple[int, int]) -> None:
    y, u = slow(seed, 20_000, hold)
    hum = 0.5 * np.sin(2 * np.pi * np.arange(len(y)) / 7)
    found = pace([y + hum + noise(seed, len(y), 0.4)], [u])
    assert found.slowest is not None
    assert found.slowest.settles_s == pytest.approx(800, rel=0.2)
    assert found.period(1.0) in {15.0, 20.0}


@pytest.mark.parametrize("seed", range(3))
def test_a_stuck_sensor_does_not_change_the_pace(seed: int) -> None:
    u = steps(seed, 4000, 40, 80)
    y = lagged(u, 30, dead_s=3) + noise(seed, len(u), 0.1)
    stuck = y.copy()
    stuck[2000:2120] = y[2000]
    for values in (y, stuck):
        found = pace([values], [u], 10.0)
        assert found.period(10.0) == 10.0
        assert found.slowest is not None
        assert found.slowest.settles_s == pytest.approx(720, rel=0.1)
        assert found.slowest.shown


@pytest.mark.parametrize("seed", range(3))
def test_a_dead_time_counts(seed: int) -> None:
    u = steps(seed, 20_000, 300, 1200)
    found = pace([lagged(u, 30, dead_s=150) + noise(seed, len(u), 0.3)], [u])
    assert found.slowest is not None
    assert found.slowest.settles_s == pytest.approx(150 + 2.3 * 30, rel=0.25)
    assert 0.0 < found.period(1.0) <= 10.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rows", [20_000, 100_000])
def test_an_integrator_does_not_blow_up_the_period(seed: int, rows: int) -> None:
    u = np.where(steps(seed, rows, 100, 600) > 0, 10.0, -10.0)
    level = np.cumsum(u - u.mean()) * 1e-3
    assert pace([level + noise(seed, rows, 0.2)], [u]).period(1.0) == 1.0
    late = np.cumsum(lagged(u - u.mean(), 60, dead_s=20)) * 1e-3  # later by 80 s than one that begins at once
    assert pace([late + noise(seed, rows, 0.2)], [u]).period(1.0) <= 10.0


@pytest.mark.parametrize("seed", range(3))
def test_the_slowest_of_two_loops_counts_and_the_fast_one_keeps_some_rows(seed: int) -> None:
    n = 20_000
    u, v = steps(seed, n, 600, 3000), steps(seed + 50, n, 600, 3000)
    fast, slowly = lagged(u, 12) + 0.2 * lagged(v, 20), 0.3 * lagged(u, 200) + 0.8 * lagged(v, 300, 40, dead_s=30)
    found = pace([fast + noise(seed, n, 0.3), slowly + noise(seed + 9, n, 0.3)], [u, v])
    settles = {(a.pv, a.mv): a.settles_s for a in found.answers}
    assert settles["pv0", "mv0"] == pytest.approx(30, rel=0.3)
    assert settles["pv1", "mv1"] == pytest.approx(850, rel=0.2)
    assert found.period(1.0) == 15.0  # 20 for the slow one alone
    assert pace([slowly + noise(seed, n, 0.3)], [u, v]).period(1.0) == 20.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lag_s", [5, 10, 20])
def test_an_export_that_suits_keeps_its_step(seed: int, lag_s: int) -> None:
    u = steps(seed, 20_000, 20, 120)
    drift = lagged(noise(seed, len(u), 200.0), 5000)
    for load in (0.0, drift):
        found = pace([lagged(u, lag_s) + load + noise(seed + 7, len(u), 0.3)], [u])
        assert found.period(1.0) == 1.0
        assert of_period(found, 1.0, 1.0, given=False) == []


def test_sparse_fits_that_a_load_bends_leave_the_word_to_finer_ones() -> None:
    # (rows taken as one, whether the answer settles, rows that it takes); from a furnace of which 27 rows are dead time
    rows = [(1, True, 292.0), (3, True, 121.0), (10, True, 229.0), (30, True, 7.0), (100, True, 11.0)]
    assert _settling(rows) == (292.0, True)
    assert Pace((SettlingAnswer("pv0", "mv0", 584.0, shown=True),)).period(2.0) == 12.0
    # The same spread over a plant that its rows suit says nothing.
    assert _settling([(factor, kind, n / 5) for factor, kind, n in rows[:3]] + [(30, True, 9.0)]) == (0.0, False)


def test_rows_that_show_a_long_settling_keep_their_step_and_the_remark_names_a_better_one() -> None:
    answer = SettlingAnswer("pv0", "mv0", 1600.0, shown=True)
    found = Pace((answer,))
    assert found.period(10.0) == 10.0
    (finding,) = of_period(found, 10.0, 10.0, given=False)
    assert finding.tag == "pv0"
    assert finding.words == (
        "takes about 27 min to settle after mv0, 160 rows of 10 s: predictive control looks at most 60 ahead; "
        "--period 30 lets it look as far as the plant settles"
    )
    assert found.period(1600 / FINE_EXPORT - 0.1) > 1600 / MOST_PERIODS - 1


@pytest.mark.parametrize("step_s", [0.04, 0.7, 1.0, 6.0, 7.5])
@pytest.mark.parametrize("settles", [61, 100, 333, 1234, 50_000])
def test_the_period_is_a_multiple_of_the_step_and_the_plant_settles_in_time(step_s: float, settles: int) -> None:
    period = Pace((SettlingAnswer("pv0", "mv0", settles * step_s, shown=False),)).period(step_s)
    assert period / step_s == pytest.approx(round(period / step_s))
    assert 25 <= settles * step_s / period <= MOST_PERIODS + 1e-6


def test_what_nobody_moves_has_no_pace() -> None:
    y = noise(0, 5000, 1.0)
    assert pace([y], [np.zeros(5000)]).answers == ()
    assert pace([y], [steps(0, 5000, 20, 60)]).answers == ()
    assert pace([y[:20]], [y[:20]]).answers == ()
    assert Pace().period(3.0) == 3.0


def test_a_long_export_is_looked_at_in_parts() -> None:
    y, u = slow(0, 2 * WINDOWED, (600, 3000))
    found = pace([y + noise(0, len(y), 0.2)], [u])
    assert found.slowest is not None
    assert found.slowest.settles_s == pytest.approx(800, rel=0.2)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(4.0, "4 s"), (90, "90 s"), (130, "2.2 min"), (800, "13 min"), (9000, "2.5 h"), (2e5, "2.3 days")],
)
def test_a_length_of_time_in_words(seconds: float, words: str) -> None:
    assert in_words(seconds) == words


@pytest.mark.parametrize("seed", range(2))
def test_a_dead_sensor_does_not_change_the_period(tmp_path: Path, seed: int) -> None:
    data = clean()
    flat = 50 + np.random.default_rng(seed).normal(0, 0.1, 250).round(3)
    pv = data.pv.copy()
    pv[500:750] = flat
    assert screen_of(data.with_(pv=pv), tmp_path).report.period_s == 6.0


def test_new_says_the_period_and_the_stage_makes_the_same_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    draw_nothing(monkeypatch)
    Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")
    y, u = slow(3, 15_000)
    y = 55 + y + noise(3, len(y), 0.2)
    rows = [[f"{START_S + k:.0f}", f"{a:.3f}", f"{b:.2f}"] for k, (a, b) in enumerate(zip(y, 50 + u, strict=True))]
    write(Path("fast.csv"), rows, ("", "TIC.PV", "TIC.OP"))
    assert main(["new", "fast", "fast.csv", "--pv", "TIC.PV", "--mv", "TIC.OP"]) == 0
    said = capsys.readouterr().out
    assert "TIC.PV: one row every 20 s: it takes about 13 min to settle after TIC.OP" in said
    assert "and the export has a reading every 1 s; --period says another" in said
    assert "one row every 20 s" in Path("data/fast/screening.html").read_text()
    found = yaml.safe_load(Path("params.yaml").read_text())
    assert found["plants"]["fast"]["period_s"] == found["exports"]["fast"]["period_s"] == 20.0
    screen("fast")
    again = json.loads(screened_record("fast").with_name("screening.json").read_text())
    first = json.loads(Path("data/fast/screening.json").read_text())
    assert {k: v for k, v in again.items() if k != "findings"} == {k: v for k, v in first.items() if k != "findings"}
    said_again = [f["words"] for f in again["findings"] if f["kind"] == "period"]
    assert [words + "; --period says another" for words in said_again] == [
        f["words"] for f in first["findings"] if f["kind"] == "period"
    ]
    given = ["--pv", "TIC.PV", "--mv", "TIC.OP", "--period", "2", "--replace", "--anyway"]
    assert main(["new", "fast", "fast.csv", *given]) == 0
    assert "rows of 2 s: predictive control looks at most 60 ahead" in capsys.readouterr().out
    assert ExportParams.read("fast").period_s == 2.0
