"""The monitor's detectors against theory, and the monitor against whatever a loop may give it."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from serving import Command, Controller, Manifest, Mode, Sample, Signal
from serving.monitor import Monitor
from serving.monitor.cusum import Cusum, Drift
from serving.monitor.error import Swing, harris_index
from serving.monitor.plight import Plight
from serving.monitor.residual import Foresight
from serving.monitor.rest import RestMap

pytest_plugins = ["small_laws"]

SP = (Signal("T", "K", 0.0, 100.0),)
MV = (Signal("u", "%", 0.0, 100.0),)


def test_a_cusum_finds_a_shift_as_fast_as_theory_says_and_is_quiet_without() -> None:
    """After a shift of d standard deviations a sum grows by d - slack a figure: limit / (d - slack), and whole ones."""
    rng = np.random.default_rng(0)
    quiet = Cusum(slack=1.0, limit=8.0)
    for k in range(20_000):
        quiet.add(float(rng.normal()), float(k))
        assert not quiet.found
    delays = []
    for _ in range(200):
        cusum, k = Cusum(slack=1.0, limit=8.0), 0
        while not cusum.found:
            cusum.add(3.0 + float(rng.normal()), float(k))
            k += 1
        delays.append(k)
        assert cusum.since_s <= k
    assert np.mean(delays) == pytest.approx(8.0 / 2.0 + 0.5, abs=0.6)


def test_a_shift_that_is_over_is_forgotten_and_a_downward_one_is_found_where_it_matters() -> None:
    both, up = Cusum(limit=5.0), Cusum(limit=5.0, both=False)
    for k in range(20):
        both.add(-4.0, k)
        up.add(-4.0, k)
    assert both.found
    assert not up.found
    for k in range(20, 60):
        both.add(0.0, k)
    assert not both.found


def test_what_hangs_together_in_time_raises_the_limit_that_it_learns() -> None:
    """An AR(1) figure of .9 stays beyond a standard deviation for long: theory's limit would cry wolf."""
    rng = np.random.default_rng(3)
    drift = Drift(learn=500, least=0.1, both=True)
    x, alarms = 0.0, 0
    for k in range(20_000):
        x = 0.9 * x + 0.436 * rng.normal()
        drift.add(x, k)
        alarms += drift.found
    assert drift.cusum.limit > 12.0
    assert alarms < 0.02 * 20_000


@pytest.mark.parametrize(("pole", "dead"), [(0.0, 1), (0.9, 1), (0.9, 2), (0.9, 5), (-0.5, 2)])
def test_the_harris_index_of_a_known_loop(pole: float, dead: int) -> None:
    """e(k) = a e(k-1) + w(k): eta = (1 - a^2) sum_{i < d} a^(2 i)."""
    rng = np.random.default_rng(1)
    e = np.zeros(20_000)
    w = rng.normal(size=len(e))
    for k in range(1, len(e)):
        e[k] = pole * e[k - 1] + w[k]
    theory = (1 - pole**2) * sum(pole ** (2 * i) for i in range(dead))
    assert harris_index(e, dead) == pytest.approx(theory, abs=0.03)
    assert harris_index(np.zeros(500), 2) == 1.0


def test_a_sine_swings_and_noise_does_not() -> None:
    rng = np.random.default_rng(2)
    sine, noise, over = Swing(0.5), Swing(0.5), Swing(0.5)
    for k in range(2_000):
        sine.add(2 * np.sin(2 * np.pi * k / 50) + 0.1 * rng.normal())
        noise.add(rng.normal())
        over.add(2 * np.sin(2 * np.pi * k / 50) if k < 1_000 else 0.0)
    assert sine.regularity() > 3
    assert sine.period() == pytest.approx(50, rel=0.05)
    assert sine.amplitude() == pytest.approx(2, rel=0.1)
    assert noise.regularity() < 1
    assert over.regularity() == 0


def rests(gain: float, load: float, n: int, rest: RestMap, seed: int, began: int = 0) -> None:
    """Periods of rest of mv = sp / gain + load at set points that change after each third."""
    rng = np.random.default_rng(seed)
    sp = 50.0
    for k in range(n):
        if k % 3 == 0:
            sp = rng.uniform(20, 60)
        rest.add(np.array([sp]), np.array([sp / gain + load + 0.3 * rng.normal()]), float(began + k))


def test_a_lower_gain_is_told_from_a_load() -> None:
    rest = RestMap(SP, MV, learn=150)
    rests(1.0, 0.0, 250, rest, seed=0)
    assert rest.learnt
    assert not rest.cusums[0].found
    gain = rest.gain(0)
    assert gain is not None
    assert gain[0] == pytest.approx(1.0, abs=0.05)
    memory = rest.memory()
    rests(1.0, 6.0, 90, rest, seed=1, began=250)
    assert rest.cusums[0].found
    assert rest.shift[0] == pytest.approx(0.06, abs=0.005)
    gain = rest.gain(0)
    assert gain is not None
    assert gain[0] == pytest.approx(1.0, abs=0.06)
    rest.recall(memory)
    rests(0.7, 0.0, 150, rest, seed=1, began=250)
    gain = rest.gain(0)
    assert gain is not None
    assert gain[0] == pytest.approx(0.7, abs=0.04)


def test_set_points_that_it_never_saw_are_learnt_and_not_judged() -> None:
    rest = RestMap(SP, MV, learn=60)
    for k in range(100):
        rest.add(np.array([30.0]), np.array([30.0]), float(k))
    for k in range(3):
        rest.add(np.array([80.0]), np.array([20.0]), 100.0 + k)
    assert not rest.cusums[0].found
    for k in range(20):
        rest.add(np.array([80.0]), np.array([35.0]), 200.0 + k)
    assert rest.cusums[0].found


def manifest(info: tuple[str, ...] = ()) -> Manifest:
    return Manifest("tank", "pid", 1.0, SP, SP, (), MV, 0, info, ("sp", "pv", "state"), {}, {})


@pytest.mark.parametrize("info", [(), ("next_T",)])
def test_a_plant_that_became_faster_is_foreseen_worse(info: tuple[str, ...]) -> None:
    rng = np.random.default_rng(4)
    foresight = Foresight(manifest(info), settle=20, learn=20)
    y, u = 50.0, 50.0
    for k in range(14_000):
        pole = 0.9 if k < 10_000 else 0.8
        if k % 20 == 0:
            u = rng.uniform(30, 70)
        foresight.add(np.array([y]), np.array([u]), np.array([0.9 * y + 0.1 * u]) if info else None, float(k))
        y = pole * y + (1 - pole) * u + 0.05 * rng.normal()
        if k == 9_999:
            assert foresight.learnt
            assert not foresight.drifts[0].found
    assert foresight.drifts[0].found
    assert foresight.ratio(0) > 1.5
    assert foresight.drifts[0].cusum.since_s == pytest.approx(10_000, abs=500)


def command(k: int, mode: Mode = Mode.AUTO, sp: float = 50.0, mv: float = 40.0, **changed: Any) -> Command:
    return Command(k, mode, np.array([sp]), np.array([mv]), np.array([mv]), np.zeros(0), **changed)


def loop(monitor: Monitor, n: int, seed: int, began: int = 0) -> None:
    rng = np.random.default_rng(seed)
    sp = 50.0
    for k in range(began, began + n):
        if k % 400 == 0:
            sp = rng.uniform(30, 70)
        pv = sp + 0.3 * rng.normal()
        monitor.observe(float(k), Sample(np.array([pv]), np.array([sp])), command(k, sp=sp, mv=sp + 0.1 * rng.normal()))


def test_nothing_that_a_loop_gives_raises_and_its_memory_is_bounded() -> None:
    monitor = Monitor(manifest(), started_s=0.0)
    loop(monitor, 3_000, seed=0)
    size = len(json.dumps(monitor.state()))
    rng = np.random.default_rng(0)
    strange: list[tuple[Sample | None, Command]] = [
        (None, command(0, Mode.HOLD, reason="lost")),
        (Sample(np.array([np.nan])), command(0)),
        (Sample(np.array([np.inf])), command(0)),
        (Sample(np.zeros(3)), command(0)),
        (Sample("x"), command(0)),  # type: ignore[arg-type]
        (Sample(np.array([1e300])), command(0)),
        (Sample(np.array([50.0])), command(0, Mode.SHADOW)),
        (Sample(np.array([50.0])), command(0, mv=np.nan)),
    ]
    for k in range(500):
        monitor.observe(3_000.0 + k, *strange[rng.integers(len(strange))])
    loop(monitor, 20_000, seed=1, began=3_500)
    text = json.dumps(monitor.state(), allow_nan=False)
    assert len(text) < 3 * size
    for verdict in monitor.verdicts():
        assert verdict.text
        assert verdict.level in {"as validated", "watch", "retrain", "not known yet"}
    json.dumps(monitor.numbers(), allow_nan=False)


def test_a_monitor_that_starts_again_goes_on_where_it_was() -> None:
    one = Monitor(manifest(), started_s=0.0)
    loop(one, 9_000, seed=0)
    other = Monitor.restored(manifest(), json.loads(json.dumps(one.state())))
    # A restart is a gap: what follows has nothing to do with what was.
    one._gap()
    for monitor in (one, other):
        loop(monitor, 9_000, seed=1, began=9_000)
    assert other.numbers() == pytest.approx(one.numbers(), rel=1e-3)
    assert [v.level for v in one.verdicts()] == [v.level for v in other.verdicts()]


@pytest.mark.parametrize("spoil", ["law", "shape", "missing", "kind"])
def test_what_another_controller_learnt_is_refused(spoil: str) -> None:
    state = json.loads(json.dumps(Monitor(manifest(), started_s=0.0).state()))
    if spoil == "law":
        state["law"] = "another"
    elif spoil == "shape":
        state["parts"]["rest"]["theta"] = [[0.0]]
    elif spoil == "missing":
        del state["parts"]["foresight"]
    else:
        state["parts"]["saturated"]["value"] = "x"
    with pytest.raises((ValueError, KeyError, TypeError)):
        Monitor.restored(manifest(), state)


def test_every_shipped_controller_has_a_monitor(controller: Controller) -> None:
    monitor = Monitor(controller.manifest, started_s=0.0)
    assert {v.level for v in monitor.verdicts()} <= {"not known yet", "as validated"}
    assert all(v.text for v in monitor.verdicts())


def watched(mv: np.ndarray, error: float, patience: int = 50) -> Plight:
    made = Plight([Signal("u", "%", 0.0, 100.0)], patience)
    for k, value in enumerate(mv):
        made.add(np.array([value]), error, float(k))
    return made


def test_an_mv_that_stays_at_its_end_beside_an_error_is_jammed_and_one_without_error_is_not() -> None:
    way = np.r_[np.linspace(40, 100, 20), np.full(60, 100.0)]
    jammed = watched(way, 0.4)
    assert jammed.jammed(0)
    assert jammed.end[0] == 1
    assert jammed.since_s[0] == 19
    assert not watched(way, 0.05).jammed(0)
    assert not watched(way[:60], 0.4).jammed(0)
    assert not watched(np.r_[way, 99.0], 0.4).jammed(0)


def test_an_mv_that_turns_round_at_each_scan_flutters_and_noise_does_not() -> None:
    rng = np.random.default_rng(3)
    to_and_fro = 50 + 10 * (-1.0) ** np.arange(100)
    assert watched(to_and_fro, 0.0).flutters(0)
    assert not watched(to_and_fro[:30], 0.0).flutters(0)
    assert not watched(50 + 0.1 * (to_and_fro - 50), 0.0).flutters(0)
    # Independent values turn round at two of three scans, steps of a walk at half of them.
    assert not watched(50 + 10 * rng.normal(size=2_000), 0.0).flutters(0)
    assert not watched(50 + 5 * np.sin(np.arange(2_000) / 5) + rng.normal(size=2_000), 0.0).flutters(0)
    discrete = Plight([Signal("v", "-", 0.0, 1.0, values=(0.0, 1.0))], 50)
    for k in range(100):
        discrete.add(np.array([float(k % 2)]), 0.0, float(k))
    assert not discrete.flutters(0)
