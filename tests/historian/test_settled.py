"""A settling time decides something where it is certain; loads and controllers make a plant seem slow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import PERIOD_S, START_S, Clean, clean, screen_of
from scipy.signal import lfilter

from loopwright.pipeline.config.known import Known
from loopwright.pipeline.historian import settling
from loopwright.pipeline.historian.cleaning.findings import Finding, InputReport
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.screening import spelt
from loopwright.pipeline.historian.settling import certain, step_answers
from loopwright.pipeline.historian.step_test import (
    AMPLITUDE_UNDER_LOADS,
    GUESSED_H,
    LARGEST_AMPLITUDE,
    LONGEST_H,
    UNKNOWN_PERIODS,
    load_sd,
    planned,
)
from loopwright.pipeline.report.screening import sayings

LOAD_SD, LAG, DEAD = 4.0, 20, 7


def load(n: int, seed: int, rows: int = 360) -> np.ndarray:
    """A load (n,) that comes and goes with a time constant of so many rows."""
    a = np.exp(-1 / rows)
    random = np.random.default_rng(seed)
    return np.asarray(lfilter([LOAD_SD * np.sqrt(1 - a * a)], [1, -a], random.normal(size=n + 2000))[2000:])


def dryer(n: int = 6000, seed: int = 0, moved: bool = True) -> Clean:
    """T answers to the fuel by 1.2 degC/% and to the feed; a PI loop holds it, and gives way to two step tests."""
    data, random, slow = clean(n, seed), np.random.default_rng(seed), load(n, seed)
    noise, a = random.normal(0, 0.2, n), np.exp(-1 / LAG)
    fuel, y = np.full(n, 50.0), np.empty(n)
    heat = held = 0.0
    before = 0.0
    for k in range(n):
        y[k] = 90 + heat + slow[k] + noise[k]
        error = 90 - y[k]
        held = float(np.clip(held + 0.25 * (error - before + error / 40), -50, 50))
        by_hand = moved and any(start <= k < start + 360 for start in (n // 4, 3 * n // 4))
        fuel[k], before = 50 + ((4.0 if (k // 60) % 2 else -4.0) if by_hand else held), error
        heat = a * heat + (1 - a) * (1.2 * (fuel[max(k - DEAD, 0)] - 50) - 0.02 * (data.dv[k] - 500))
    return Clean(START_S + PERIOD_S * np.arange(n), y.round(3), fuel.round(3), data.dv)


@pytest.mark.parametrize("seed", range(2))
def test_loads_and_a_controller_do_not_decide_the_period_or_the_test(seed: int, tmp_path: Path) -> None:
    report = screen_of(dryer(seed=seed), tmp_path).report
    valve = report.verdict.inputs[0]
    assert report.period_s == PERIOD_S
    assert (valve.settling_s, valve.certain) == (0.0, ())
    assert report.verdict.carries != "yes"
    test = planned([replace(valve, low=0.0, high=100.0)], [50.0], PERIOD_S)
    assert 1 < test.hours < LONGEST_H
    assert max(abs(v - 50) for (v,) in test.values) * 1.2 > 2 * LOAD_SD  # the answer stands out of the load
    slow = replace(test, ramp_s=(-0.0, *[60.0] * (len(test.hold_s) - 1)))  # the first step may change nothing
    assert slow.table().splitlines()[1].split(",")[3] == "0"


@pytest.mark.parametrize("drift", [0.0, 10.0])
def test_what_an_open_loop_shows_is_certain(drift: float, tmp_path: Path) -> None:
    data = clean(3000)
    found = screen_of(data.with_(pv=data.pv + drift * np.linspace(0, 1, 3000)), tmp_path)
    valve = found.report.verdict.inputs[0]
    assert valve.certain == ("TIC-101.PV",)
    assert valve.settling_s == pytest.approx(24 * PERIOD_S, rel=0.25)


@pytest.mark.parametrize(("rows", "sure"), [(30, True), (300, False)])
def test_another_model_must_agree(rows: int, sure: bool) -> None:
    random = np.random.default_rng(3)
    u = np.repeat(random.uniform(-1, 1, 200), 20)
    y = lfilter([0, 0.1], [1, -0.9], u) + random.normal(0, 0.02, 4000)
    assert bool(certain(y, [u], np.zeros(4000, np.int64), {0: rows})) is sure


def test_inputs_that_settle_alike_share_a_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    random, n = np.random.default_rng(5), 8000
    u, v = (np.repeat(random.uniform(-20, 20, n // 50), 50) for _ in range(2))
    y = lfilter([0, 0.1], [1, -0.9], u - 0.5 * v) + random.normal(0, 0.1, n)
    fits = []
    monkeypatch.setattr(settling, "step_answers", lambda *given: fits.append(given) or step_answers(*given))
    assert certain(y, [u, v], np.zeros(n, np.int64), {0: 23, 1: 24}) == {0, 1}
    assert len(fits) == 1


def test_the_answer_and_its_error_are_those_of_the_plant_beside_a_slow_load() -> None:
    random, n = np.random.default_rng(4), 20_000
    u = np.repeat(random.uniform(-20, 20, n // 40), 40)
    y = lfilter([0, 0.1], [1, -0.9], u) + load(n, 5)
    (found,) = step_answers(y, [u], np.zeros(n, np.int64), 50) or [None]
    assert found is not None
    truth = 1 - 0.9**found.lag
    assert np.all(np.abs(found.value - truth) < 4 * found.sd + 0.03)
    assert found.sd[-1] < 0.1


def report_of(tmp_path: Path, **changed: object) -> InputReport:
    return replace(screen_of(clean(), tmp_path).report.verdict.inputs[0], low=0.0, high=100.0, **changed)


@pytest.mark.parametrize("settling", [{"settling_s": 0.0, "uncertain_s": 9e6, "certain": ()}, {"settling_s": 9e6}])
def test_a_step_test_takes_hours(settling: dict[str, object], tmp_path: Path) -> None:
    report = report_of(tmp_path, **settling)
    assert planned([report], [50.0], 30.0).hours <= LONGEST_H
    for period_s in (30.0, 60.0, 300.0, 600.0, 900.0, 1800.0, 3600.0):
        test = planned([report] * 2, [50.0] * 2, period_s)
        assert LONGEST_H / 4 < test.hours <= LONGEST_H
        shortest = min(test.hold_s)
        assert test.reading_s == (shortest / 5 if shortest < 5 * period_s else 0.0)
    guessed = planned([replace(report, settling_s=0.0, uncertain_s=300.0)], [50.0], 1.0)
    assert planned([replace(report, settling_s=300.0)], [50.0], 1.0).hours == guessed.hours
    assert planned([replace(report, settling_s=0.0, uncertain_s=9e6)], [50.0], 1.0).hours < GUESSED_H * 1.05
    unknown = planned([replace(report, settling_s=0.0, uncertain_s=0.0)], [50.0], 10.0)
    assert unknown.hold_s[0] == UNKNOWN_PERIODS * 10


def test_a_step_is_sized_over_the_load_within_range_and_rate(tmp_path: Path) -> None:
    report = report_of(tmp_path, load_move=9.0, settling_s=600.0)
    assert planned([report], [50.0], 10.0).sizes == (9.0,)
    assert planned([replace(report, load_move=80.0)], [50.0], 10.0).sizes == (100 * AMPLITUDE_UNDER_LOADS,)
    assert planned([replace(report, load_move=80.0, certain=())], [50.0], 10.0).sizes == (100 * LARGEST_AMPLITUDE,)
    assert planned([replace(report, load_move=80.0)], [50.0], 10.0, {report.name: 1.0}).sizes == (10.0,)
    assert all(0 <= v <= 100 for (v,) in planned([replace(report, load_move=80.0)], [97.0], 10.0).values)


def test_the_load_is_that_within_a_window() -> None:
    slow, run = load(40_000, 1), np.zeros(40_000, np.int64)
    assert load_sd(slow, run, 10_000) == pytest.approx(LOAD_SD, rel=0.25)
    assert load_sd(slow, run, 20) < 0.3 * LOAD_SD
    assert load_sd(np.full(100, np.nan), run[:100], 20) == 0.0


def test_a_signal_has_one_spelling_in_findings_and_verdict(tmp_path: Path) -> None:
    tags = (Tag("Kiln 3 Temp", "pv", name="Kiln_3_Temp"), Tag("Fuel flow", "mv", name="Fuel_flow"))
    words = "takes about 2 h to settle after Fuel flow"
    (said,) = spelt([Finding("period", "Kiln 3 Temp", words)], tags)
    assert (said.tag, said.words) == ("Kiln_3_Temp", words.replace("Fuel flow", "Fuel_flow"))


def test_every_pair_is_asked_for_where_nothing_is_clear(tmp_path: Path) -> None:
    verdict = screen_of(dryer(moved=False), tmp_path).report.verdict
    silent = replace(verdict.inputs[0], gain={"TIC-101.PV": 0.0}, rate={}, first_answer_s={})
    (line,) = sayings(replace(verdict, inputs=(silent,)), {})
    assert "not clear from the record" in line
    assert line.endswith("?")
    known = [Known("TIC-101.PV", silent.name, "+")]
    (line,) = sayings(replace(verdict, inputs=(silent,)), {}, known)
    assert not line.endswith("?")  # of what an engineer says nobody is asked again
