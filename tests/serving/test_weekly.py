"""What a monitor makes of signals that operators have out of use, and what is counted week by week."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from processes import within

from loopwright.pipeline.__main__ import main
from loopwright.serving import Command, Controller, Manifest, Mode, Sample, Signal
from loopwright.serving.errors import LoopError
from loopwright.serving.journal import Journal, JournalReader
from loopwright.serving.manifest import OperateEntry
from loopwright.serving.monitor import Monitor
from loopwright.serving.monitor.weekly import WEEK, WeeklyCounts, counts_of, week_of
from loopwright.serving.monitor.weekly_report import shares, week_report, week_reports
from loopwright.serving.operating import Operate
from loopwright.serving.station.recorder import MonitorRunner, Recorder

pytest_plugins = ["small_laws", "operated_files"]

CVS = Signal("T", "K", 0.0, 100.0), Signal("A", "%", 0.0, 100.0)
MVS = Signal("u", "%", 0.0, 100.0), Signal("v", "%", 0.0, 100.0)
MONDAY_S = 1_700_438_400.0  # 2023-11-20T00:00 UTC


def entries() -> tuple[OperateEntry, ...]:
    cv = [
        OperateEntry("cv", s.name, what, unit, default, low, high)  # type: ignore[arg-type]
        for s in CVS
        for what, unit, default, low, high in (
            ("use", "", 1.0, 0.0, 1.0), ("track", "", 1.0, 0.0, 1.0), ("low", s.unit, s.low, s.low, s.high),
            ("high", s.unit, s.high, s.low, s.high),
        )
    ]  # fmt: skip
    mv = [
        OperateEntry("mv", s.name, what, unit, default, low, high)  # type: ignore[arg-type]
        for s in MVS
        for what, unit, default, low, high in (
            ("use", "", 1.0, 0.0, 1.0), ("low", s.unit, s.low, s.low, s.high), ("high", s.unit, s.high, s.low, s.high),
            ("max_move", s.unit, 5.0, 0.1, 5.0), ("cost", "", 0.0, -1.0, 1.0),
        )
    ]  # fmt: skip
    return (*cv, *mv)


MANIFEST = Manifest(
    case="made", law="predictive", period_s=60.0, sp=CVS, pv=CVS, dv=(), mv=MVS, n_state=1, info=("next_T", "next_A"),
    inputs=("sp", "pv", "mv_applied", "state", "operate", "fresh"), operate=entries(),
    evidence={"scenarios": {"step": {"settling": 1200.0}}},
)  # fmt: skip
OPERATE = Operate(MANIFEST.operate)
SETTLE = 20  # scans


def scan(
    k: int, pv: list[float], mv: list[float], *, mode: Mode = Mode.AUTO, sp: tuple[float, float] = (50.0, 50.0),
    info: list[float] | None = None, fresh: list[int] | None = None, shed: tuple[str, ...] = (),
) -> tuple[Sample, Command]:  # fmt: skip
    """A scan whose read-back is the command before."""
    sample = Sample(pv=np.array(pv), mv_applied=np.array(mv), fresh=None if fresh is None else np.array(fresh))
    known = None if info is None else np.array(info)
    command = Command(k, mode, np.array(sp), np.array(mv), np.array(mv), known, shed=dict.fromkeys(shed, "bad"))
    return sample, command


def levels(monitor: Monitor) -> dict[str, str]:
    return {v.name: v.level for v in monitor.verdicts()}


# ------------------------------------------------------------------------------------------------------ false verdicts
@pytest.mark.parametrize("values", [{"A.use": 0}, {"A.track": 0}])
def test_the_error_of_a_variable_that_has_no_set_point_now_is_no_fault(values: dict[str, float]) -> None:
    """A stands 40 % off a set point that nobody wants; u is at its end for good reasons."""
    found = {}
    for name, operate in (("without", OPERATE.default), ("with", OPERATE.with_values(values))):
        monitor = Monitor(MANIFEST, started_s=MONDAY_S)
        for k in range(5 * SETTLE):
            monitor.observe(MONDAY_S + 60 * k, *scan(k, [50.0, 90.0], [100.0, 50.0]), operate)
        assert not monitor.trouble
        found[name] = levels(monitor)["u moves"], monitor.errors[1].count
    assert found == {"without": ("watch", 5 * SETTLE), "with": ("as validated", 0)}


def test_a_set_point_beyond_its_range_counts_as_the_range_s_end() -> None:
    monitor = Monitor(MANIFEST, started_s=MONDAY_S)
    operate = OPERATE.with_values({"T.high": 40.0})
    for k in range(10):
        monitor.observe(MONDAY_S + 60 * k, *scan(k, [39.0, 50.0], [50.0, 50.0], sp=(90.0, 50.0)), operate)
    assert monitor.errors[0].value == pytest.approx(0.01)


def test_an_mv_out_of_use_is_no_stuck_actuator() -> None:
    """Its read-back lies 1 % off what the law goes on to say; T is far off for another reason."""
    found = {}
    for name, use in (("in use", 1.0), ("out of use", 0.0)):
        monitor, operate = Monitor(MANIFEST, started_s=MONDAY_S), OPERATE.with_values({"v.use": use})
        for k in range(4 * SETTLE):
            sample, command = scan(k, [80.0, 50.0], [50.0 + (k % 7), 60.0])
            standing = replace(sample, mv_applied=np.array([50.0 + (k - 1) % 7, 59.0 - 1.5 * (k > 20)]))
            monitor.observe(MONDAY_S + 60 * k, standing, command, operate)
        found[name] = levels(monitor)["v read back"]
    assert found == {"in use": "watch", "out of use": "as validated"}


def test_an_mv_out_of_use_at_its_end_is_neither_jammed_nor_saturated() -> None:
    monitor, operate = Monitor(MANIFEST, started_s=MONDAY_S), OPERATE.with_values({"v.use": 0})
    for k in range(25 * SETTLE):
        monitor.observe(MONDAY_S + 60 * k, *scan(k, [80.0, 50.0], [50.0, 0.0]), operate)
    assert levels(monitor)["v moves"] == "as validated"
    assert monitor.saturated.value == 0.0
    assert monitor.saturated.count == 25 * SETTLE


def test_rest_at_another_cost_or_at_operators_limits_is_no_drift_of_the_plant() -> None:
    monitor = Monitor(MANIFEST, started_s=MONDAY_S)
    begun = dict[str, int]()
    for name, values, mv in (
        ("usual", {}, 50.0), ("cost", {"u.cost": 1.0}, 30.0), ("clamped", {"u.high": 40.0}, 40.0), ("again", {}, 50.0)
    ):  # fmt: skip
        for k in range(10 * SETTLE):
            monitor.observe(MONDAY_S + 60 * k, *scan(k, [50.0, 50.0], [mv, 50.0]), OPERATE.with_values(values))
        begun[name] = monitor.rest.judged
    assert not monitor.trouble
    assert begun["usual"] == begun["cost"] == begun["clamped"] < begun["again"]


# ------------------------------------------------------------------------------------------------------- slow analysers
def test_beside_a_slow_analyser_the_monitor_learns_from_new_readings_alone() -> None:
    """A is read each 20 scans, and what stands there meanwhile is any number."""
    rng, monitor = np.random.default_rng(0), Monitor(MANIFEST, started_s=MONDAY_S)
    for k in range(2_000):
        fresh = k % 20 == 0
        t, a = 50 + 0.1 * rng.normal(), 50 + 0.1 * rng.normal() if fresh else 1e6
        told = scan(k, [t, a], [50.0 + rng.normal(), 50.0], info=[50.0, 50.0], fresh=[1, int(fresh)])
        monitor.observe(MONDAY_S + 60 * k, *told, OPERATE.default)
    assert not monitor.trouble
    assert monitor.errors[0].count == 2_000
    assert monitor.errors[1].count == 100
    assert monitor.errors[1].value < 0.005
    chart = monitor.foresight.chart
    assert chart.count > 0
    figures = chart.figures[: chart.count]
    assert np.exp(figures / 2) == pytest.approx(0.001, rel=0.5)  # .1 of a range of 100, of each
    assert monitor.answers.blocks > 0
    assert monitor.spread.count + monitor.spread.pooled > 0


def test_with_each_reading_new_all_is_counted_as_without_fresh() -> None:
    rng, monitors = np.random.default_rng(1), [Monitor(MANIFEST, started_s=MONDAY_S) for _ in range(2)]
    for k in range(1_500):
        t, a, u = (50 + rng.normal() for _ in range(3))
        for monitor, fresh, operate in zip(monitors, (None, [1, 1]), (None, OPERATE.default), strict=True):
            monitor.observe(MONDAY_S + 60 * k, *scan(k, [t, a], [u, 50.0], info=[50.0, 50.0], fresh=fresh), operate)
    assert monitors[0].state() == monitors[1].state()


def test_what_an_older_release_has_learnt_is_taken_over() -> None:
    monitor = Monitor(MANIFEST, started_s=MONDAY_S)
    for k in range(700):
        monitor.observe(MONDAY_S + 60 * k, *scan(k, [50.1, 50.0], [50.0, 50.0], info=[50.0, 50.0]))
    state = json.loads(json.dumps(monitor.state()))
    del state["taste"], state["parts"]["foresight"]["readings"], state["parts"]["answers"]["readings"]
    again = Monitor.restored(MANIFEST, state)
    assert again.foresight.chart.count == monitor.foresight.chart.count > 0
    assert again.foresight.count == 0  # its present block was not counted reading by reading


# ------------------------------------------------------------------------------------------------------------- the week
def counted(
    scans: list[tuple[Sample, Command]], operate: np.ndarray | None = None, counts: WeeklyCounts | None = None
) -> WeeklyCounts:
    made = counts or WeeklyCounts()
    for k, (sample, command) in enumerate(scans):
        made.add(MANIFEST, sample, command, MONDAY_S + 60 * k, operate)
    return made


def test_modes_uses_limits_and_travel_are_counted_by_signal() -> None:
    made = counted([scan(k, [50.0, 50.0], [50.0, 50.0], mode=Mode.MANUAL) for k in range(10)])
    counted([scan(k, [52.0, 50.0], [50.0 + k % 2, 100.0]) for k in range(20)], OPERATE.default, made)
    made.add(MANIFEST, None, replace(scan(0, [0, 0], [0, 0])[1], mode=Mode.HOLD, law_mv=None), MONDAY_S)
    operate = OPERATE.with_values({"A.track": 0, "A.low": 40.0, "v.high": 60.0, "u.use": 0})
    counted([scan(k, [50.0, 39.0], [50.0, 60.0]) for k in range(10)], operate, made)
    counted([scan(k, [50.0, 39.0], [50.0, 60.0], shed=("A",)) for k in range(5)], operate, made)
    c = made.counts
    assert {m: c.get(m, 0) for m in Mode} == {"MANUAL": 10, "AUTO": 35, "HOLD": 1, "SHADOW": 0}
    assert c["all in use"] == 20
    assert (c["cv A tracked"], c["cv A ranged"], c["cv A shed"], c["cv A at_low"]) == (20, 10, 5, 10)
    assert (c["cv T error"], c["cv T readings"]) == (40.0, 35)
    assert (c["mv u moved"], c["mv u out"], c["mv u travel"]) == (20, 15, 19.0)
    assert (c["mv v end_high"], c["mv v clamped_high"], c["mv v high_limit"]) == (20, 15, 60.0)
    assert "cv A at_high" not in c
    found = shares(c)
    assert found["AUTO_share"] == pytest.approx(35 / 46)
    assert found["v_clamped_high_share"] == pytest.approx(15 / 35)
    assert found["T_mean_error"] == pytest.approx(40 / 35)
    assert found["u_travel_per_hour"] == pytest.approx(19 / (35 / 60))


def test_old_readings_are_no_errors_and_an_mv_that_moves_as_fast_as_it_may_is_counted() -> None:
    made = counted([scan(k, [50.0, 9.0], [5.0 * k, 50.0], fresh=[1, 0]) for k in range(5)], OPERATE.default)
    assert "cv A readings" not in made.counts
    assert made.counts["mv u fastest"] == 4


def test_a_new_week_is_counted_anew_and_begins_on_monday() -> None:
    assert week_of(MONDAY_S) == week_of(MONDAY_S + 6.99 * 86_400) == "2023-11-20"
    made = counted([scan(0, [50.0, 50.0], [50.0, 50.0])])
    made.add(MANIFEST, *scan(1, [50.0, 50.0], [50.0, 50.0]), MONDAY_S + 7 * 86_400)
    assert (made.week, made.counts["AUTO"]) == ("2023-11-27", 1)


def test_a_week_says_what_stands_out_and_what_the_validation_had() -> None:
    one = replace(
        MANIFEST, sp=CVS[:1], pv=CVS[:1], info=(), operate=(), inputs=("sp", "pv", "mv_applied", "state"),
        evidence={"scenarios": {"step_noise": {"mae": 0.5}}},
    )  # fmt: skip
    made = WeeklyCounts()
    for k in range(10):
        sample = Sample(pv=np.array([52.0]), mv_applied=np.array([0.0, 50.0]))
        at = np.array([0.0, 50.0])
        made.add(one, sample, Command(k, Mode.AUTO, np.array([50.0]), at, at, None), MONDAY_S + 60 * k)
    report = week_report(made.week, made.counts, {"T": "K", "u": "%", "v": "%"})
    assert [row[0] for row in report.rows] == ["T", "u", "v"]
    assert len(report.notes) == 2  # u at its end; the error of T
    (note,) = [note for note in report.notes if " T " in note]
    assert "2 K" in note
    assert "0.5 K" in note
    assert week_report("2023-11-20", {}, {}).rows == ()
    assert [len(line) > 0 for line in report.lines()] == [True] * (2 + 3 + 2)


@pytest.mark.parametrize("text", ["[]", '{"AUTO": -1}', '{"AUTO": NaN}', '{"AUTO": "1"}', "{"])
def test_counts_that_could_be_none_are_refused(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - which one says what is wrong
        counts_of(text)


# ---------------------------------------------------------------------------------------------------- over a restart
@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    journal = Journal(tmp_path / "loop.journal")
    yield Recorder(journal, lambda _: None)
    journal.close()


def ran(recorder: Recorder, controller: Controller, scans: int, began_s: float) -> MonitorRunner:
    """A loop in AUTO for so many scans, which ends without a word."""
    m, watching = controller.manifest, MonitorRunner(controller, recorder)
    pv, mv, sp = (np.array([s.middle for s in of]) for of in (m.pv, m.mv, m.sp))
    for k in range(scans):
        command = Command(k, Mode.AUTO, sp, mv, mv, None)
        watching.seen(controller, (Sample(pv=pv, mv_applied=mv), command, began_s + k), np.array(m.usual("operate")))
    assert within(10, lambda: recorder.journal.behind == 0)
    return watching


def test_a_loop_that_was_killed_goes_on_with_the_counts_of_its_week(recorder: Recorder, operated: Controller) -> None:
    recorder.time = SimpleNamespace(wall_s=lambda: MONDAY_S + 100)  # type: ignore[assignment]
    assert operated.manifest.period_s == 1.0
    ran(recorder, operated, 90, MONDAY_S)  # written once a minute: 30 scans are lost
    again = ran(recorder, operated, 10, MONDAY_S + 100)
    assert again.weekly.counts["AUTO"] == 70
    again.keep()
    assert within(10, lambda: recorder.journal.behind == 0)
    assert ran(recorder, operated, 1, MONDAY_S + 200).weekly.counts["AUTO"] == 71
    assert ran(recorder, operated, 1, MONDAY_S + 7 * 86_400).weekly.counts["AUTO"] == 1
    with closing(JournalReader(recorder.journal.path)) as reader:
        assert reader.learnt_names(WEEK) == ["week 2023-11-20"]


def test_a_week_that_somebody_forged_is_told_and_counted_anew(recorder: Recorder, operated: Controller) -> None:
    recorder.time = SimpleNamespace(wall_s=lambda: MONDAY_S)  # type: ignore[assignment]
    recorder.journal.keep("week 2023-11-20", '{"AUTO": -5}')
    assert within(10, lambda: recorder.journal.behind == 0)
    assert ran(recorder, operated, 3, MONDAY_S).weekly.counts["AUTO"] == 3
    with closing(JournalReader(recorder.journal.path)) as reader:
        assert [e.kind for _, e in reader.events()] == ["monitor"]


def test_the_command_prints_the_weeks_of_a_journal(
    recorder: Recorder, operated: Controller, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorder.journal.path
    with pytest.raises(LoopError, match="no week yet"):
        week_reports(path)
    recorder.begin(operated)
    ran(recorder, operated, 120, MONDAY_S).keep()
    assert within(10, lambda: recorder.journal.behind == 0)
    assert main(["loop", "report", str(path), "--weeks", "2"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert len([line for line in said if line.startswith("week of ")]) == 1
    assert any(line.split()[0] == "valve" for line in said if line)
    assert main(["loop", "report", str(path), "--weeks", "0"]) == 2
