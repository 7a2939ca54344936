"""The monitor's detectors against theory, and the monitor against whatever a loop may give it."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.serving import Command, Controller, Manifest, Mode, Sample, Signal
from loopwright.serving.monitor import Monitor
from loopwright.serving.monitor.actuator_checks import ActuatorFaults
from loopwright.serving.monitor.cusum import Chart, answer_scans, correlation, run_limit, settle_scans, upper_scatter
from loopwright.serving.monitor.loop_statistics import Foresight, Swing, harris_index
from loopwright.serving.monitor.plant_drift import Answers, RestMap

pytest_plugins = ["small_laws"]

SP = (Signal("T", "K", 0.0, 100.0),)
MV = (Signal("u", "%", 0.0, 100.0),)


def charted(figures: np.ndarray, learn: int, **changed: Any) -> tuple[Chart, np.ndarray]:
    """A chart after these figures (N, n), and for each the first one at which it was found (N: never)."""
    chart = Chart(figures.shape[1], learn, **{"weekly": 1_000.0, "rate": 1.0, **changed})
    first = np.full(figures.shape[1], len(figures))
    for k, row in enumerate(figures):
        chart.add(row, float(k))
        first = np.where((chart.found > 0) & (first == len(figures)), k, first)
    return chart, first


def test_the_limit_of_a_sum_gives_the_run_length_that_theory_says() -> None:
    """One-sided sums of white figures with known mean and scatter, and limits for 1,000 figures."""
    rng, limit, n, length = np.random.default_rng(0), run_limit(0.5, 1_000.0), 400, 4_000
    alarms, sums = 0, np.zeros(n)
    for _ in range(length):
        sums = np.maximum(sums + rng.normal(size=n) - 0.5, 0.0)
        alarms += int(np.sum(sums > limit))
        sums[sums > limit] = 0.0
    assert n * length / alarms == pytest.approx(1_000, rel=0.15)


def test_the_unfavourable_end_of_a_scatter_is_that_of_its_distribution() -> None:
    rng = np.random.default_rng(1)
    for freedom in (4, 10, 50):
        s = rng.normal(size=(20_000, freedom + 1)).std(axis=1, ddof=1)
        assert np.mean(s * upper_scatter(freedom, 1.645) >= 1) == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("pole", [0.0, 0.5, 0.9])
def test_the_correlation_of_an_ar_1_figure_is_not_thought_smaller_than_it_is(pole: float) -> None:
    """1 + 2 sum rho = (1 + a) / (1 - a); the largest of many estimates lies above it, but below twice that."""
    found = np.median(correlation(ar1(np.random.default_rng(2), pole, 2_000, 40)))
    assert 0.9 < found / ((1 + pole) / (1 - pole)) < 2.0


def ar1(rng: np.random.Generator, pole: float, length: int, n: int) -> np.ndarray:
    x = np.zeros((length, n))
    x[0] = rng.normal(size=n)
    for k in range(1, length):
        x[k] = pole * x[k - 1] + np.sqrt(1 - pole**2) * rng.normal(size=n)
    return x


@pytest.mark.parametrize(("pole", "learn"), [(0.0, 20), (0.0, 300), (0.5, 60), (0.9, 300), (0.95, 300)])
def test_false_alarms_are_as_rare_as_asked_for_whether_or_not_figures_hang_together(pole: float, learn: int) -> None:
    """Asked for: one in 5 weeks of 1,000 figures. Watched: 100 charts for four weeks, so that 80 would be too many."""
    figures = ar1(np.random.default_rng(3), pole, 2 * learn + 4_000, 100)
    _, first = charted(figures, learn, rate=0.2)
    assert np.sum(first < len(figures)) <= 20


@pytest.mark.parametrize("scatter", [0.1, 0.5, 0.8, 0.95])
def test_figures_that_scatter_by_less_than_matters_hang_together_all_the_same(scatter: float) -> None:
    """``least`` is no reason to call them white: as rare as above, and learnt no later where they hardly scatter."""
    figures = scatter * ar1(np.random.default_rng(9), 0.9, 600 + 4_000, 100)
    _, first = charted(figures, 300, rate=0.2, least=1.0)
    assert np.sum(first < len(figures)) <= 20
    assert scatter > 0.1 or charted(figures[:60, :1], 60, least=1.0)[0].learnt


def test_a_shift_is_found_soon_and_its_time_is_told() -> None:
    rng = np.random.default_rng(4)
    figures = rng.normal(size=(300, 50))
    figures[200:] += 4.0
    chart, first = charted(figures, 100)
    assert (first >= 200).all()
    assert (first < 215).all()  # of 50 figures: the slack allows for the one whose learning time flattered most
    assert (np.abs(chart.since_s - 200) <= 3).all()
    assert chart.shift(0) == pytest.approx(4.0, abs=1.0)


def test_one_strange_figure_is_no_shift_and_one_that_is_over_is_forgotten() -> None:
    figures = np.random.default_rng(5).normal(size=(400, 1))
    figures[200] = 1e6
    assert charted(figures, 100)[1][0] == 400
    figures[250:270] += 8.0
    chart, first = charted(figures, 100)
    assert 250 < first[0] < 270
    assert not chart.found[0]
    assert chart.rises[0] == 1


def test_a_shift_downwards_counts_where_it_matters() -> None:
    figures = np.random.default_rng(6).normal(size=(200, 1))
    figures[100:] -= 5.0
    assert charted(figures, 100)[1][0] < 110
    assert charted(figures, 100, both=False)[1][0] == 200


def test_learning_lasts_longer_where_figures_hang_together_longer() -> None:
    slow, quick = Chart(1, 40, weekly=1e3, rate=1.0), Chart(1, 40, weekly=1e3, rate=1.0)
    for k, (a, b) in enumerate(
        zip(ar1(np.random.default_rng(7), 0.98, 300, 1), ar1(np.random.default_rng(8), 0.0, 300, 1), strict=True)
    ):
        slow.add(a, k)
        quick.add(b, k)
        if k == 40:
            assert quick.learnt
            assert not slow.learnt
    assert slow.learnt
    assert slow.pool in {2, 4}


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


def rest_map(learn: int) -> RestMap:
    return RestMap(SP, MV, learn=learn, weekly=1_000.0, rate=0.1)


def test_a_lower_gain_is_told_from_a_load() -> None:
    rest = rest_map(150)
    rests(1.0, 0.0, 250, rest, seed=0)
    assert rest.learnt
    assert not rest.chart.found[0]
    gain = rest.gain(0)
    assert gain is not None
    assert gain[0] == pytest.approx(1.0, abs=0.05)
    memory = rest.memory()
    rests(1.0, 6.0, 90, rest, seed=1, began=250)
    assert rest.chart.found[0]
    assert rest.chart.shift(0) == pytest.approx(0.06, abs=0.005)
    gain = rest.gain(0)
    assert gain is not None
    assert gain[0] == pytest.approx(1.0, abs=0.06)
    rest.recall(memory)
    rests(0.7, 0.0, 150, rest, seed=1, began=250)
    gain = rest.gain(0)
    assert gain is not None
    assert gain[0] == pytest.approx(0.7, abs=0.04)


def test_set_points_that_it_never_saw_are_learnt_and_not_judged() -> None:
    rest = rest_map(60)
    for k in range(100):
        rest.add(np.array([30.0]), np.array([30.0]), float(k))
    for k in range(3):
        rest.add(np.array([80.0]), np.array([20.0]), 100.0 + k)
    assert not rest.chart.found[0]
    for k in range(20):
        rest.add(np.array([80.0]), np.array([35.0]), 200.0 + k)
    assert rest.chart.found[0]


def manifest(info: tuple[str, ...] = ()) -> Manifest:
    return Manifest("tank", "pid", 1.0, SP, SP, (), MV, 0, info, ("sp", "pv", "state"), {}, {})


def first_order(pole_after: float, gain_after: float, watch: Callable[[np.ndarray, np.ndarray, float], None]) -> None:
    """y(k+1) = a y + (1 - a) g u + noise with a = .9, g = 1 for 10,000 scans, and others for 4,000."""
    rng = np.random.default_rng(4)
    y, u = 50.0, 50.0
    for k in range(14_000):
        pole, gain = (0.9, 1.0) if k < 10_000 else (pole_after, gain_after)
        if k % 20 == 0:
            u = rng.uniform(30, 70)
        watch(np.array([y]), np.array([u]), float(k))
        y = pole * y + (1 - pole) * gain * u + 0.05 * rng.normal()


def test_a_plant_that_became_faster_is_foreseen_worse_by_its_law() -> None:
    foresight = Foresight(manifest(("next_T",)), block=100, learn=40, weekly=1_000.0, rate=0.1)

    def watch(pv: np.ndarray, mv: np.ndarray, k: float) -> None:
        foresight.add(pv, 0.9 * pv + 0.1 * mv, k)
        if k == 9_999:
            assert foresight.chart.learnt
            assert not foresight.chart.found[0]

    first_order(0.8, 1.0, watch)
    assert foresight.chart.found[0]
    assert foresight.ratio(0) > 1.5
    assert foresight.chart.since_s[0] == pytest.approx(10_000, abs=500)


@pytest.mark.parametrize(("pole", "gain"), [(0.9, 1.0), (0.91, 1.0), (0.89, 1.0), (0.9, 1.02)])
def test_a_plant_that_answers_otherwise_is_found_though_it_is_foreseen_as_well(pole: float, gain: float) -> None:
    """A time constant that is 11 % off shifts what errors go with, long before their size tells."""
    answers = Answers(manifest(), block=100, model=30, learn=40, weekly=1_000.0, rate=0.1)

    def watch(pv: np.ndarray, mv: np.ndarray, k: float) -> None:
        answers.add(pv, mv, None, k)
        if k == 9_999:
            assert answers.learnt
            assert answers.changed(0) is None

    first_order(pole, gain, watch)
    if (pole, gain) == (0.9, 1.0):
        assert answers.changed(0) is None
    else:
        assert answers.changed(0) == pytest.approx(10_000, abs=500)


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


@cache
def learned() -> Monitor:
    """A monitor whose charts have learnt; for a test that gives it more, a copy."""
    monitor = Monitor(manifest(), started_s=0.0)
    loop(monitor, 9_000, seed=0)
    return monitor


def test_nothing_that_a_loop_gives_raises_and_its_memory_is_bounded() -> None:
    monitor = Monitor(manifest(), started_s=0.0)
    loop(monitor, 3_000, seed=0)
    size = len(json.dumps(monitor.state()))
    rng = np.random.default_rng(0)
    strange: list[tuple[Sample | None, Command]] = [
        (None, command(0, Mode.HOLD, fault="lost")),
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


def test_a_loop_that_has_held_for_a_while_is_not_judged_by_its_first_scans() -> None:
    """How much of its time a loop holds is known after 20 settling times; a start is no measure of it."""
    monitor = Monitor(manifest(), started_s=0.0)
    measured = monitor.hold.learn

    def verdict() -> Any:
        return next(v for v in monitor.verdicts() if v.name == "time in HOLD")

    for k in range(measured):
        assert (verdict().level, verdict().value) == ("not known yet", None)
        assert verdict().text.startswith("still measured")
        monitor.observe(float(k), None, command(k, Mode.HOLD if k < measured // 4 else Mode.AUTO))
    assert (verdict().level, verdict().value) == ("watch", pytest.approx(0.25, abs=0.01))
    for k in range(measured, 20 * measured):
        monitor.observe(float(k), None, command(k))
    assert verdict().level == "as validated"


def test_a_monitor_that_starts_again_goes_on_where_it_was() -> None:
    one = copy.deepcopy(learned())
    other = Monitor.restored(manifest(), json.loads(json.dumps(one.state())))
    # A restart is a gap: what follows has nothing to do with what was.
    one._gap()
    for monitor in (one, other):
        loop(monitor, 9_000, seed=1, began=9_000)
    assert other.numbers() == pytest.approx(one.numbers(), rel=1e-3)
    assert [v.level for v in one.verdicts()] == [v.level for v in other.verdicts()]


def test_a_clock_that_is_set_changes_no_verdict() -> None:
    """What it counts, it counts by scans."""
    right, wrong = Monitor(manifest(), started_s=0.0), Monitor(manifest(), started_s=0.0)
    rng = np.random.default_rng(9)
    for k in range(12_000):
        sp = 40.0 + 20 * (k // 400 % 2)
        sample = Sample(np.array([sp + 0.3 * rng.normal()]), np.array([sp]))
        said = command(k, sp=sp, mv=sp + 0.1 * rng.normal() + 5 * (k > 11_000))
        right.observe(float(k), sample, said)
        wrong.observe(float(k) + (-3_600 if 5_000 < k < 8_000 else 86_400 if k >= 8_000 else 0), sample, said)
    assert [v.level for v in right.verdicts()] == [v.level for v in wrong.verdicts()]
    assert right.numbers() == wrong.numbers()


def test_the_first_answer_is_the_evidence_s_and_two_where_nobody_knows() -> None:
    m = manifest()
    assert answer_scans(m) == [2]
    assert answer_scans(replace(m, evidence={"dead_time_periods": [5]})) == [5]
    for strange in ([None], [0], [1.5], [True], ["3"], [10_000], [1, 2], "x", None):
        assert answer_scans(replace(m, evidence={"dead_time_periods": strange})) == [2]


def test_a_settling_time_is_that_of_the_tests_without_noise() -> None:
    rows = {"up": {"settling": 30.0}, "down": {"settling": 40.0}, "up_noise": {"settling": 900.0}}
    assert (
        settle_scans(replace(manifest(), evidence={"scenarios": {**rows, "none": {"settling": 0.0}, "odd": 3}})) == 40
    )
    assert settle_scans(manifest()) == 100


@cache
def learnt() -> Any:
    """What a monitor keeps whose charts have learnt."""
    return json.loads(json.dumps(learned().state()))


ANOTHER: list[tuple[str, Any]] = [
    ("law", "another"), ("law", None), ("settle", 1), ("settle", None), ("started_s", "now"), ("started_s", math.nan),
    ("started_s", 1e15), ("parts", []), ("parts", None), ("parts rest theta", [[0.0]]), ("parts foresight", None),
    ("parts swings", {}), ("parts swings", []), ("parts swings 0", 1), ("parts saturated value", "x"),
    ("parts saturated value", None), ("parts saturated value", math.nan), ("parts saturated value", True),
    ("parts saturated value", 10**400), ("parts saturated count", None), ("parts saturated count", 1.5),
    ("parts saturated count", -1), ("parts spread since_s", [1e15]), ("parts spread since_s", ["1"]),
    ("parts spread mean", [None]), ("parts spread mean", [[1.0]]), ("parts spread mean", [math.inf]),
    ("parts spread scatter", [0.0]), ("parts spread pool", 0), ("parts spread pool", True),
    ("parts spread weekly", 0.0), ("parts spread limit", [-1.0]), ("parts spread found", [2.0]),
    ("parts spread rises", [1e9]),
    ("parts swings 0 intervals", ["a"]), ("parts swings 0 intervals", "abc"), ("parts swings 0 intervals", [[1]]),
    ("parts swings 0 intervals", [1] * 100_000), ("parts swings 0 since", -3), ("parts answers model frozen", 1),
    ("parts answers model p", [[1.0], [1.0, 2.0]]),
]  # fmt: skip


@pytest.mark.parametrize(("place", "kept"), ANOTHER, ids=[f"{i} {place}" for i, (place, _) in enumerate(ANOTHER)])
def test_what_another_controller_learnt_or_nobody_is_refused(place: str, kept: Any) -> None:
    *way, last = (int(step) if step.isdigit() else step for step in place.split())
    state = json.loads(json.dumps(learnt()))
    at = state
    for step in way:
        at = at[step]
    assert at[last] is not None
    at[last] = kept
    with pytest.raises(ValueError, match=r"learnt|must be|is missing|in place of|is no|outside"):
        Monitor.restored(manifest(), state)
    if isinstance(at, dict):
        del at[last]
        with pytest.raises(ValueError, match=r"learnt|must be|is missing|in place of|is no|outside"):
            Monitor.restored(manifest(), state)


def answers_well(state: Any) -> None:
    """A memory is refused; or its monitor gives verdicts and numbers, now and after some scans, that are JSON."""
    try:
        monitor = Monitor.restored(manifest(), state)
    except ValueError:
        return
    for n in (0, 250):
        loop(monitor, n, seed=1, began=9_000)
        assert {v.level for v in monitor.verdicts()} <= {"as validated", "watch", "retrain", "not known yet"}
        json.dumps([asdict(v) for v in monitor.verdicts()], allow_nan=False)
        json.dumps(monitor.numbers(), allow_nan=False)


NUMBERS = st.one_of(
    st.integers(),
    st.floats(),
    st.sampled_from([0, 1, -1, 300, 1e5, 1e15, 1e99, -1e99, 10**12, 10**400, math.nan, math.inf, -math.inf]),
)
TREES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.text(), NUMBERS),
    lambda tree: st.one_of(st.lists(tree), st.dictionaries(st.text(), tree)),
    max_leaves=8,
)


@given(TREES)
def test_a_memory_that_is_any_tree_is_refused(tree: Any) -> None:
    answers_well(tree)
    answers_well({**learnt(), "parts": tree})
    answers_well({**learnt(), "parts": {**learnt()["parts"], "spread": tree}})


def regular(tree: list[Any]) -> bool:
    """Whether it is an array, which a list that was forged before need not be."""
    try:
        return bool(np.shape(tree))
    except ValueError:
        return False


def forged(tree: Any, data: st.DataObject) -> Any:
    """A memory with some value replaced: by a number in all places of an array, or by any tree."""
    if isinstance(tree, dict) and tree:
        name = data.draw(st.sampled_from(sorted(tree)))
        return {**tree, name: forged(tree[name], data)}
    if isinstance(tree, list) and tree and isinstance(tree[0], dict):
        return [forged(tree[0], data), *tree[1:]]
    if isinstance(tree, list) and regular(tree) and data.draw(st.booleans()):
        return np.full(np.shape(tree), data.draw(st.floats(-1e100, 1e100))).tolist()
    if isinstance(tree, int) and data.draw(st.booleans()):
        return data.draw(st.integers(0, 10**12))
    return data.draw(st.one_of(NUMBERS, TREES))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, of numbers that nothing could have measured
@settings(max_examples=60)
@given(st.data())
def test_a_forged_memory_is_refused_or_does_no_harm(data: st.DataObject) -> None:
    state = learnt()
    for _ in range(data.draw(st.integers(1, 3))):
        state = forged(state, data)
    answers_well(state)


def test_a_monitor_that_fails_says_so_and_never_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = Monitor.restored(manifest(), learnt())
    monkeypatch.setattr(monitor, "actuators", None)
    monkeypatch.setattr(monitor, "saturated", None)
    (said,) = monitor.verdicts()
    assert (said.name, said.level) == ("monitor", "watch")
    assert "the monitor itself failed" in said.text
    assert monitor.numbers() == {}


def test_every_shipped_controller_has_a_monitor(controller: Controller) -> None:
    monitor = Monitor(controller.manifest, started_s=0.0)
    assert {v.level for v in monitor.verdicts()} <= {"not known yet", "as validated"}
    assert all(v.text for v in monitor.verdicts())


def watched(mv: np.ndarray, error: float, patience: int = 50) -> ActuatorFaults:
    made = ActuatorFaults([Signal("u", "%", 0.0, 100.0)], patience)
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
    to_and_fro = 50 + 10 * (-1.0) ** np.arange(120)
    assert watched(to_and_fro, 0.0).flutters(0)
    assert not watched(to_and_fro[:80], 0.0).flutters(0)
    assert not watched(50 + 0.1 * (to_and_fro - 50), 0.0).flutters(0)
    # Independent values turn round at two of three scans, steps of a walk at half of them.
    noisy = ActuatorFaults([Signal("u", "%", 0.0, 100.0)], 50)
    for k, value in enumerate(50 + 10 * rng.normal(size=20_000)):
        noisy.add(np.array([value]), 0.0, float(k))
        assert not noisy.flutters(0), k
    assert not watched(50 + 5 * np.sin(np.arange(2_000) / 5) + rng.normal(size=2_000), 0.0).flutters(0)
    discrete = ActuatorFaults([Signal("v", "-", 0.0, 1.0, values=(0.0, 1.0))], 50)
    for k in range(100):
        discrete.add(np.array([float(k % 2)]), 0.0, float(k))
    assert not discrete.flutters(0)
