"""The loop's promises: no bump, no drift, no exception, and an MV at every scan."""

from __future__ import annotations

import copy
import functools
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shipped_files import SHIPPED

import loopwright.serving.loop
import loopwright.serving.scan_grid
from loopwright.serving import (
    Command,
    Complete,
    Controller,
    ControlLoop,
    EndpointError,
    Fallback,
    LoopError,
    Mode,
    MonotonicClock,
    OutputError,
    Rate,
    Sample,
    Signal,
    SimulatedEndpoint,
    VirtualClock,
    default_guards,
)

pytest_plugins = ["small_laws"]
PERIOD = 0.5


@pytest.fixture(scope="module")
def shared(pi_file: Path) -> Controller:
    return Controller(pi_file)


@pytest.fixture
def make_loop(shared: Controller) -> Callable[..., ControlLoop]:
    def make(endpoint: Any = None, **options: Any) -> ControlLoop:
        values = {"sp": 1.0, "mv": 40.0, "mode": Mode.AUTO, "clock": VirtualClock(100.0), "warm_lead_s": 0, **options}
        return ControlLoop(shared, endpoint, **values)

    return make


def sample(level: float = 0.8, mv: float | None = 40.0, **changed: Any) -> Sample:
    values = {"pv": np.array([level, 300.0]), "dv": np.zeros(1), **changed}
    return Sample(mv_applied=None if mv is None else np.array([mv]), **values)


class Tank:
    """level' = 0.95 level + 0.001 valve + 0.01, and everything that a test wants to go wrong."""

    def __init__(self, level: float = 0.8, mv: float = 40.0) -> None:
        self.level, self.mv, self.written = level, mv, [mv]
        self.read_fails: set[int] = set()
        self.write_fails: set[int] = set()
        self.reads = self.writes = 0

    def read(self) -> Sample:
        self.reads += 1
        if self.reads - 1 in self.read_fails:
            raise EndpointError("no route to the tank")
        return sample(self.level, self.mv)

    def write(self, mv: np.ndarray) -> None:
        self.writes += 1
        if self.writes - 1 in self.write_fails:
            raise TimeoutError("the tank does not answer")
        self.mv = float(mv[0])
        self.written.append(self.mv)
        self.level = 0.95 * self.level + 0.001 * self.mv + 0.01


# ---------------------------------------------------------------------- modes
def test_auto_reaches_the_set_point(make_loop: Callable[..., ControlLoop]) -> None:
    tank = Tank()
    report = make_loop(tank).run(800)
    assert (report.scans, report.missed, report.faults) == (800, 0, 0)
    assert tank.level == pytest.approx(1.0, abs=1e-9)


def test_the_loop_is_the_law_and_nothing_else(shared: Controller, make_loop: Callable[..., ControlLoop]) -> None:
    loop, state, rng = make_loop(), shared.cold_state(), np.random.default_rng(0)
    for _ in range(50):
        s = sample(rng.uniform(0, 2), rng.uniform(0, 100))
        step = shared.step(sp=1.0, pv=s.pv, mv_applied=s.mv_applied, state=state)
        command = loop.scan(s)
        assert np.array_equal(command.mv, step.mv)
        assert np.array_equal(command.info, step.info)
        state = step.state


def test_manual_to_auto_does_not_bump(make_loop: Callable[..., ControlLoop]) -> None:
    """In MANUAL the law sees the applied MV, so AUTO starts from there: at rest on set point it stays."""
    loop = make_loop(mode=Mode.MANUAL, sp=0.8)
    loop.set_mv(63.0)
    for _ in range(20):
        command = loop.scan(sample(0.8, 63.0))
        assert command.mode is Mode.MANUAL
        assert command.mv.tolist() == [63.0]
        assert command.law_mv is not None
    loop.set_mode(Mode.AUTO)
    assert loop.scan(sample(0.8, 63.0)).mv.tolist() == [63.0]


def test_without_read_back_the_last_command_counts_as_applied(make_loop: Callable[..., ControlLoop]) -> None:
    blind, seeing = make_loop(), make_loop()
    for level in (0.8, 0.85, 0.9):
        expected = seeing.scan(sample(level, float(seeing.mv[0])))
        assert np.array_equal(blind.scan(sample(level, None)).mv, expected.mv)


def test_operator_hold_stays(make_loop: Callable[..., ControlLoop]) -> None:
    loop = make_loop(recover_after=1)
    loop.scan(sample())
    held = loop.mv
    loop.set_mode(Mode.HOLD)
    for level in (0.1, math.nan, 1.9, 1.9, 1.9):
        assert np.array_equal(loop.scan(sample(level)).mv, held)
    assert loop.mode is Mode.HOLD


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda loop: loop.set_sp(2.5), r"set point level = 2.5 m is outside \[0, 2\] m"),
        (lambda loop: loop.set_sp(math.nan), "set point level = nan"),
        (lambda loop: loop.set_sp([1, 1]), r"shape \(2,\); it needs \(1,\): level \[m\]"),
        (lambda loop: loop.set_sp("high"), "set point has the type <U4; it needs numbers"),
        (lambda loop: loop.set_sp(["1"]), "set point has the type <U1; it needs numbers"),
        (lambda loop: loop.set_sp(True), "set point has the type bool; it needs numbers"),
        (lambda loop: loop.set_mv(50), "in MANUAL only; the loop is in AUTO"),
        (lambda loop: loop.run(1), "run needs an endpoint"),
    ],
)
def test_orders_outside_the_configuration_are_refused(
    make_loop: Callable[..., ControlLoop], act: Callable[[ControlLoop], Any], message: str
) -> None:
    loop = make_loop()
    with pytest.raises(LoopError, match=message):
        act(loop)
    assert loop.sp.tolist() == [1.0]
    assert loop.mv.tolist() == [40.0]


@pytest.mark.parametrize("options", [{"sp": 3.0}, {"mv": -1.0}, {"recover_after": 0}])
def test_a_loop_that_cannot_work_is_not_made(make_loop: Callable[..., ControlLoop], options: dict[str, Any]) -> None:
    with pytest.raises(LoopError):
        make_loop(**options)


# ---------------------------------------------------------------------- faults
@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (sample(math.nan), "PV level is nan"),
        (sample(5.0), "outside its range"),
        (sample(age_s=9.0), "9 s old"),
        (sample(0.8, math.nan), "applied MV valve is nan"),
        (sample(pv=np.zeros(5)), "shape"),
    ],
)
def test_a_bad_sample_holds_with_its_reason(make_loop: Callable[..., ControlLoop], bad: Sample, reason: str) -> None:
    loop = make_loop()
    before = loop.scan(sample()).mv
    command = loop.scan(bad)
    assert command.mode is Mode.HOLD
    assert reason in command.fault
    assert np.array_equal(command.mv, before)
    assert command.law_mv is None
    # Good samples alone do not end it: an operator must, unless recover_after says otherwise.
    for _ in range(10):
        command = loop.scan(sample())
        assert (command.mode, np.array_equal(command.mv, before)) == (Mode.HOLD, True)
        assert reason in command.fault
    loop.set_mode(Mode.AUTO)
    assert loop.scan(sample()).fault == ""


def test_recovery_needs_good_samples_in_a_row_and_starts_cold(make_loop: Callable[..., ControlLoop]) -> None:
    loop = make_loop(recover_after=3)
    modes = [loop.scan(sample(v)).mode for v in (0.8, math.nan, 0.8, 0.8, math.nan, 0.8, 0.8, 0.8)]
    assert modes == [Mode.AUTO, *[Mode.HOLD] * 6, Mode.AUTO]
    assert loop.fault == ""


def test_a_law_error_holds_the_applied_mv(make_loop: Callable[..., ControlLoop], monkeypatch: Any) -> None:
    loop = make_loop(guards=(), recover_after=2)
    loop.scan(sample())
    command = loop.scan(sample(math.nan, 37.0))  # no guard: the controller itself refuses
    assert (command.mode, command.mv.tolist()) == (Mode.HOLD, [37.0])
    assert "level [m] is nan" in command.fault

    def explode(**_: Any) -> None:
        raise RuntimeError("out of memory")

    loop.set_mode(Mode.AUTO)
    with monkeypatch.context() as patch:
        patch.setattr(loop.controller, "step", explode)
        assert loop.scan(sample()).fault == "out of memory"


def slow_loop(shared: Controller, **options: Any) -> ControlLoop:
    """A loop whose valve moves by at most 5 % a period, with a law that moves by 1.3 % of an error of 1 m."""
    given = {"mv": [40.0], "mode": Mode.AUTO, **options}
    return ControlLoop(limited(shared, 5.0), sp=[1.0], **given)


def limited(controller: Controller, max_move: float | None) -> Controller:
    """The same law, in a manifest with another largest move."""
    changed = copy.copy(controller)
    (valve,) = controller.manifest.mv
    changed.manifest = replace(controller.manifest, mv=(replace(valve, max_move=max_move),))
    changed._bind()
    return changed


def test_the_way_by_hand_begins_at_the_read_back_of_a_sample_that_is_refused(shared: Controller) -> None:
    """Nobody said where the valve stands, and the first sample has a bad sensor, but a sound read-back."""
    loop = slow_loop(shared, mv=None, mode=Mode.MANUAL)
    loop.set_mv([90.0])
    refused = Sample(pv=np.array([np.nan, 300.0]), mv_applied=np.array([40.0]), dv=np.zeros(1))
    command = loop.scan(refused)
    assert command.fault
    assert command.mv.tolist() == [45.0]


def test_a_move_beyond_the_mvs_rate_is_a_fault_and_never_written(shared: Controller) -> None:
    loop = slow_loop(shared, guards=())
    assert loop.scan(sample(-2.8)).mv[0] == pytest.approx(44.94)
    loop = slow_loop(shared, guards=())
    command = loop.scan(sample(-2.9))
    assert (command.mode, command.mv.tolist(), bool(command.fault)) == (Mode.HOLD, [40.0], True)
    # Others moved the valve while the loop could not write: the law moves from there.
    loop = slow_loop(shared, guards=())
    before = loop.mv
    loop.scan(sample(-2.8))
    loop.unwritten(before, "the plant cannot be written")
    loop.set_mode(Mode.AUTO)
    assert loop.scan(sample(-2.8, 70.0)).mv[0] == pytest.approx(74.94)


def test_by_hand_an_mv_is_no_faster_than_it_may_move(shared: Controller) -> None:
    """It goes on through samples that are refused, and gets where the operator wants it."""
    loop = slow_loop(shared, mode=Mode.MANUAL)
    loop.set_mv([52.0])
    assert (loop.mv.tolist(), loop.mv_wanted.tolist()) == ([40.0], [52.0])
    assert [loop.scan(sample()).mv[0], loop.scan(sample(math.nan)).mv[0]] == [45.0, 50.0]
    assert [loop.miss("nothing is read").mv[0], loop.scan(sample()).mv[0]] == [52.0, 52.0]
    loop.set_mv([0.0])
    assert loop.scan(sample()).mv[0] == 47.0
    loop.set_mv([46.0])  # another word on the way
    assert [loop.scan(sample()).mv[0] for _ in range(2)] == [46.0, 46.0]


@pytest.mark.parametrize("mode", [Mode.AUTO, Mode.SHADOW, Mode.HOLD])
def test_a_change_of_mode_ends_the_way_by_hand(shared: Controller, mode: Mode) -> None:
    loop = slow_loop(shared, mode=Mode.MANUAL)
    loop.set_mv([100.0])
    loop.scan(sample())
    loop.set_mode(mode)
    loop.scan(sample(mv=45.0))
    loop.set_mode(Mode.MANUAL)
    stands = loop.mv[0]
    assert [loop.scan(sample(mv=45.0)).mv[0] for _ in range(3)] == [stands] * 3


def test_a_step_by_hand_that_did_not_arrive_is_no_step(shared: Controller) -> None:
    loop = slow_loop(shared, mode=Mode.MANUAL)
    loop.set_mv([60.0])
    before = loop.mv
    loop.scan(sample())
    assert loop.unwritten(before, "the plant cannot be written").mv.tolist() == [40.0]
    assert loop.scan(sample(mv=30.0)).mv.tolist() == [30.0]  # where it is found it stays
    assert loop.scan(sample(mv=30.0)).mv.tolist() == [30.0]
    # A plant that reads nothing back has the MV before the lost one.
    loop = slow_loop(shared, mode=Mode.MANUAL)
    loop.set_mv([60.0])
    loop.scan(sample(mv=None))
    loop.unwritten(before, "the plant cannot be written")
    assert [loop.scan(sample(mv=None)).mv[0] for _ in range(2)] == [45.0, 50.0]


def test_where_nobody_knows_the_mv_the_operator_says_where_it_is(shared: Controller) -> None:
    loop = slow_loop(shared, mode=Mode.MANUAL, mv=None)
    loop.set_mv([60.0])
    assert loop.scan(sample(mv=None)).mv.tolist() == [60.0]
    loop = slow_loop(shared, mode=Mode.MANUAL, mv=None)
    loop.set_mv([60.0])
    assert loop.scan(sample(mv=40.0)).mv.tolist() == [45.0]


@given(st.lists(st.tuples(st.floats(0, 100), st.integers(1, 4), st.booleans()), max_size=8))
def test_no_scan_moves_the_mv_by_hand_faster(shared: Controller, moves: list[tuple[float, int, bool]]) -> None:
    loop, last = slow_loop(shared, mode=Mode.MANUAL), 40.0
    for wanted, scans, good in moves:
        loop.set_mv([wanted])
        for _ in range(scans):
            mv = float((loop.scan(sample(mv=last)) if good else loop.miss("nothing is read")).mv[0])
            assert abs(mv - last) <= 5.0 + 1e-7
            last = mv


def test_a_fallback_is_no_faster_than_the_mv_may_move(shared: Controller) -> None:
    loop = slow_loop(shared, fallback=Fallback(0.0, (100.0,), (1e3,)))
    assert [loop.miss("nothing is read").mv[0] for _ in range(3)] == [45.0, 50.0, 55.0]


def test_who_takes_over_is_held_to_its_own_rate(shared: Controller) -> None:
    loop = slow_loop(shared, guards=())
    loop.swap(limited(shared, 4.0), 1)
    assert [loop.scan(sample(level)).mode for level in (-1.0, -1.1)] == [Mode.AUTO, Mode.HOLD]
    loop = slow_loop(shared, guards=())
    loop.swap(limited(shared, 5.0), 1)
    assert [loop.scan(sample(level)).mode for level in (-1.0, -1.1)] == [Mode.AUTO, Mode.AUTO]


def test_a_guard_that_fails_does_not_clear_the_sample(make_loop: Callable[..., ControlLoop]) -> None:
    loop = make_loop(guards=(Rate((), (0.1,)),))
    assert loop.scan(sample()).mode is Mode.AUTO
    assert "Rate failed" in loop.scan(sample()).fault


def test_manual_survives_faults(make_loop: Callable[..., ControlLoop]) -> None:
    loop = make_loop(mode=Mode.MANUAL)
    command = loop.scan(sample(math.nan))
    assert (command.mode, command.mv.tolist()) == (Mode.MANUAL, [40.0])
    assert "nan" in command.fault
    assert loop.scan(sample()).fault == ""


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(width=64),
            st.none() | st.floats(width=64),
            st.floats(0, 2),
            st.sampled_from([None, Mode.AUTO, Mode.MANUAL, Mode.HOLD]),
        ),
        max_size=30,
    )
)
def test_whatever_the_samples_hold_every_scan_gives_an_mv(
    shared: Controller, events: list[tuple[float, float | None, float, Mode | None]]
) -> None:
    loop = ControlLoop(shared, sp=1.0, mv=40.0, mode=Mode.AUTO, recover_after=2)
    applied = 40.0
    for level, mv, age, mode in events:
        if mode is not None:
            loop.set_mode(mode)
        command = loop.scan(sample(level, mv, age_s=age))
        assert np.isfinite(command.mv).all()
        assert command.mode is not Mode.AUTO or 0 <= command.mv[0] <= 100
        assert command.mode is not Mode.MANUAL or command.mv[0] == applied
        applied = float(command.mv[0])


# ---------------------------------------------------------------------- endpoint
def test_an_unreachable_plant_is_a_fault_and_no_exception(make_loop: Callable[..., ControlLoop]) -> None:
    tank = Tank()
    tank.read_fails, tank.write_fails = {5, 6}, {12}
    commands: list[Command] = []
    report = make_loop(tank, recover_after=2).run(20, observe=lambda _, c: commands.append(c))
    assert [c.scan for c in commands] == list(range(20))
    assert [bool(c.fault) for c in commands] == [k in (5, 6, 7, 12, 13) for k in range(20)]
    assert "no route" in commands[5].fault
    assert "does not answer" in commands[12].fault
    assert np.array_equal(commands[12].mv, commands[11].mv)  # what was decided never arrived
    assert report.faults == 5
    assert commands[-1].mode is Mode.AUTO


def test_simulated_endpoint_steps_the_plant_at_each_write() -> None:
    endpoint = SimulatedEndpoint(lambda mv: np.array([mv[0] / 2]), pv=1.0, mv=10.0)
    first = endpoint.read()
    assert (first.pv.tolist(), first.mv_applied.tolist()) == ([1.0], [10.0])  # type: ignore[union-attr]
    endpoint.write(np.array([30.0]))
    assert endpoint.read().pv.tolist() == [15.0]


# ---------------------------------------------------------------------- the range, whatever comes


@functools.cache
def shipped(path: Path) -> Controller:
    return Controller(path)


def middle(signals: tuple[Signal, ...]) -> np.ndarray:
    return np.array([s.middle for s in signals])


def legal(mv: np.ndarray, signals: tuple[Signal, ...]) -> bool:
    return mv.shape == (len(signals),) and all(
        s.low <= value <= s.high and (s.values is None or value in s.values)
        for s, value in zip(signals, mv.tolist(), strict=True)
    )


def refuse(**_: Any) -> None:
    raise OutputError("the law gave nothing")


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_no_shipped_law_commands_an_implausible_read_back(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    controller = shipped(path)
    m = controller.manifest
    good = {"pv": middle(m.pv), "dv": middle(m.dv)}
    rest = np.array([s.low if s.values is None else s.values[0] for s in m.mv])
    for guards in (None, ()):
        for value in (1.7e308, -1.7e308, 1e6, -1e6, math.nan, math.inf):
            for fails in (False, True):
                loop = ControlLoop(controller, sp=middle(m.sp), mv=rest, mode=Mode.AUTO, guards=guards)
                with monkeypatch.context() as patch:
                    if fails:
                        patch.setattr(controller, "step", refuse)
                    command = loop.scan(Sample(mv_applied=np.full(len(m.mv), value), **good))
                assert command.mode is Mode.HOLD
                assert command.mv.tolist() == rest.tolist()
                assert f"applied MV {m.mv[0].name} is " in command.fault
                loop.set_mode(Mode.MANUAL)
                command = loop.scan(Sample(mv_applied=np.full(len(m.mv), value), **good))
                assert (command.mode, command.mv.tolist()) == (Mode.MANUAL, rest.tolist())
                assert f"applied MV {m.mv[0].name} is " in command.fault


@pytest.mark.parametrize("guards", [None, ()])
@pytest.mark.parametrize(
    ("read_back", "held"), [(100.9, 100.0), (-0.9, 0.0), (37.0, 37.0), (102.1, 40.0), (-2.1, 40.0)]
)
def test_hold_clips_a_read_back_that_its_scaling_carries_out_of_range(
    make_loop: Callable[..., ControlLoop], monkeypatch: Any, guards: Any, read_back: float, held: float
) -> None:
    """Within 2 % of the range the read-back is the end of the range; beyond, the last command stays."""
    loop = make_loop(guards=guards)
    monkeypatch.setattr(loop.controller, "step", refuse)
    command = loop.scan(sample(0.8, read_back))
    assert (command.mode, command.mv.tolist()) == (Mode.HOLD, [held])
    assert ("outside its range [0, 100] %" in command.fault) is (held == 40.0)


def test_the_law_gets_the_end_of_the_range_for_a_read_back_beyond_it(
    make_loop: Callable[..., ControlLoop], shared: Controller
) -> None:
    expected = shared.step(sp=1.0, pv=[0.8, 300.0], mv_applied=100.0, state=shared.cold_state())
    command = make_loop().scan(sample(0.8, 101.5))
    assert (command.fault, command.mv.tolist()) == ("", expected.mv.tolist())


def test_a_host_that_writes_into_a_command_moves_nothing(make_loop: Callable[..., ControlLoop]) -> None:
    loop = make_loop()
    command = loop.scan(sample())
    held = command.mv.copy()
    assert command.law_mv is not None
    for array in (command.law_mv, command.mv, command.sp):
        array[:] = 1e9
    assert loop.scan(sample(math.nan)).mv.tolist() == held.tolist()


JUNK = [
    None,
    7,
    "sample",
    [0.8, 300.0],
    Sample(pv=[0.8, 300.0], dv=np.zeros(1)),  # type: ignore[arg-type]
    Sample(pv=None, dv=np.zeros(1)),  # type: ignore[arg-type]
    Sample(pv=1, dv=np.zeros(1)),  # type: ignore[arg-type]
    Sample(pv=np.array([0.8, None]), dv=np.zeros(1)),
    Sample(pv=np.array(["0.8", "300"]), dv=np.zeros(1)),
    Sample(pv=np.array([0.8, 300.0 + 1j]), dv=np.zeros(1)),
    Sample(pv=np.array([0.8, 300.0]), dv=np.zeros(1), mv_applied=[40.0]),  # type: ignore[arg-type]
    Sample(pv=np.array([0.8, 300.0]), dv=np.zeros(1), mv_applied=np.zeros((1, 1))),
    Sample(pv=np.array([0.8, 300.0]), dv=np.zeros(1), age_s=None),  # type: ignore[arg-type]
    Sample(pv=np.array([0.8, 300.0]), dv=np.zeros(1), age_s=-1e-9),
]


@pytest.mark.parametrize("junk", JUNK, ids=range(len(JUNK)))
def test_what_is_no_sample_is_a_fault_with_its_reason(make_loop: Callable[..., ControlLoop], junk: Any) -> None:
    tank, seen = Tank(), []
    tank.read = lambda: junk  # type: ignore[method-assign]
    report = make_loop(tank).run(1, observe=lambda s, c: seen.append((s, c)))
    ((given, command),) = seen
    assert given is (junk if isinstance(junk, Sample) else None)
    assert (report.faults, report.errors, command.mode, tank.written) == (1, 0, Mode.HOLD, [40.0, 40.0])
    assert "failed" not in command.fault  # a guard that says why, not one that broke
    assert any(word in command.fault for word in ("must be", "needs", "instead of"))


# ---------------------------------------------------------------------- whatever raises
class UnspeakableError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text either")


RAISED = [
    ValueError("bad\nnews"),
    MemoryError(),
    RecursionError("deep"),
    StopIteration(),
    UnspeakableError(),
    OSError(5),
]


@pytest.mark.parametrize("error", RAISED, ids=lambda e: type(e).__name__)
@pytest.mark.parametrize("where", ["read", "write", "before"])
def test_whatever_raises_ahead_of_the_write_is_a_fault_that_names_its_type(
    make_loop: Callable[..., ControlLoop], where: str, error: Exception
) -> None:
    tank, commands = Tank(), []

    def raised(*_: Any) -> Any:
        raise error

    before = None
    if where == "before":
        before = raised
    else:
        setattr(tank, where, raised)
    loop = make_loop(tank)
    report = loop.run(3, before=before, observe=lambda _, c: commands.append(c))
    assert (report.scans, report.faults, report.errors) == (3, 3, 0)
    assert loop.mode is Mode.HOLD
    for command in commands:
        assert type(error).__name__ in command.fault
        assert "\n" not in command.fault
        assert command.mv.tolist() == [40.0]
    assert tank.written == [40.0] * (1 if where == "write" else 4)


@pytest.mark.parametrize("error", RAISED, ids=lambda e: type(e).__name__)
def test_a_law_or_guard_that_raises_without_a_text_is_still_a_fault(
    make_loop: Callable[..., ControlLoop], monkeypatch: Any, error: Exception
) -> None:
    def raised(*_: Any, **__: Any) -> Any:
        raise error

    class Broken(Complete):
        check = raised

    loop = make_loop(guards=(Broken(make_loop().controller.manifest),))
    assert loop.scan(sample()).fault.startswith("Broken failed: ")
    loop = make_loop()
    monkeypatch.setattr(loop.controller, "step", raised)
    assert loop.scan(sample()).fault
    assert (loop.mode, bool(loop.fault)) == (Mode.HOLD, True)


@pytest.mark.parametrize("error", RAISED, ids=lambda e: type(e).__name__)
@pytest.mark.parametrize("where", ["observe", "until", "stop", "warm"])
def test_whatever_raises_beside_the_plant_moves_nothing_and_is_reported(
    make_loop: Callable[..., ControlLoop], monkeypatch: Any, caplog: Any, where: str, error: Exception
) -> None:
    def raised(*_: Any) -> Any:
        raise error

    undisturbed, tank = Tank(), Tank()
    make_loop(undisturbed).run(5)
    loop = make_loop(tank, warm_lead_s=1e-3)
    if where == "warm":
        monkeypatch.setattr(loop.controller, "warm", raised)
        report = loop.run(5)
    else:
        report = loop.run(5, **{where: raised})
    assert (report.scans, report.faults, report.errors) == (5, 0, 5)
    (first,) = report.first_errors
    assert first.startswith(f"{where} failed: {type(error).__name__}")
    assert [record.getMessage() for record in caplog.records] == [first]
    assert loop.mode is Mode.AUTO
    assert tank.written == undisturbed.written


@pytest.mark.parametrize("where", ["sleep_until", "now", "not a time"])
def test_a_clock_that_fails_holds_and_the_machines_own_measures_the_period(
    make_loop: Callable[..., ControlLoop], monkeypatch: Any, where: str
) -> None:
    spare = VirtualClock()
    monkeypatch.setattr(loopwright.serving.scan_grid, "MonotonicClock", lambda: spare)
    clock, tank, commands = VirtualClock(100.0), Tank(), []

    def raised(*_: Any) -> Any:
        if where == "not a time":
            return math.nan
        raise OSError("no time")

    def before(k: int) -> None:
        if k == 1:
            setattr(clock, "now" if where == "not a time" else where, raised)
        if k == 3:
            vars(clock).clear()
            clock.time_s = 100.0

    report = make_loop(tank, clock=clock, recover_after=1).run(
        6, before=before, observe=lambda _, c: commands.append(c)
    )
    assert (report.scans, report.faults) == (6, 2)
    assert [c.fault.startswith("the clock failed: ") for c in commands] == [False, False, True, True, False, False]
    assert spare.now() == 2 * PERIOD
    assert commands[3].mv.tolist() == commands[1].mv.tolist()
    assert commands[5].mode is Mode.AUTO


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("where", ["read", "write", "before", "observe", "until", "stop"])
def test_a_person_can_still_end_the_run(make_loop: Callable[..., ControlLoop], where: str, stop: Any) -> None:
    def raised(*_: Any) -> Any:
        raise stop

    tank = Tank()
    options = {}
    if where in ("read", "write"):
        setattr(tank, where, raised)
    else:
        options[where] = raised
    with pytest.raises(stop):
        make_loop(tank).run(3, **options)


NUMBERS = st.floats(width=64) | st.sampled_from([math.nan, math.inf, -math.inf, 1.7e308, -1.7e308, 1e6])
PLACES = ("read", "write", "before", "observe", "until", "warm", "step", "guard", "clock", "hand_back")


class Chaos:
    """Endpoint, guard, clock and callbacks of a plant where anything goes wrong, as ``data`` draws it."""

    memory = 2

    def __init__(self, data: st.DataObject, controller: Controller) -> None:
        self.data, self.m = data, controller.manifest
        self.raises: dict[str, Exception] = {}
        self.written: list[np.ndarray] = []
        self.handed_back = self.shadowed = self.left = 0
        self.outside = False  # whether an MV was found out of range after a write that failed: it is left there
        self.clock = VirtualClock()
        self.loop: ControlLoop | None = None
        self.inner_step, self.inner_warm = controller.step, controller.warm

    def at(self, place: str) -> None:
        if place in self.raises:
            raise self.raises[place]

    def vector(self, signals: tuple[Signal, ...]) -> Any:
        size = st.sampled_from([len(signals)] * 4 + [0, 5]).flatmap(lambda n: st.lists(NUMBERS, min_size=n, max_size=n))
        near = [
            st.floats(s.low - 0.03 * (s.high - s.low), s.high) | st.sampled_from(s.values or (s.high,)) for s in signals
        ]
        odd = st.sampled_from([None, 3, [1.0], np.array([None]), np.array(["a"]), np.array([1j])])
        return self.data.draw(
            st.tuples(*near).map(np.array) | st.tuples(*near).map(np.array) | size.map(np.array) | odd
        )

    def before(self, k: int) -> None:
        assert self.loop is not None
        draw = self.data.draw
        self.raises = draw(st.dictionaries(st.sampled_from(PLACES), st.sampled_from(RAISED), max_size=2))
        mode = draw(st.sampled_from([None, None, *Mode]))
        if mode is not None:
            self.loop.set_mode(mode)
        if draw(st.sampled_from([False, False, True])):
            self.loop.swap(self.loop.controller, draw(st.sampled_from([1, 2])))
        if mode is Mode.MANUAL:
            self.loop.set_mv([draw(st.sampled_from(s.values or (s.low, s.middle, s.high))) for s in self.m.mv])
        self.at("before")

    def read(self) -> Any:
        self.at("read")
        s = Sample(self.vector(self.m.pv), self.vector(self.m.mv), self.vector(self.m.dv), self.data.draw(NUMBERS))
        good = Sample(middle(self.m.pv), s.mv_applied, middle(self.m.dv))
        return self.data.draw(st.sampled_from([s, good, good, None, 5]))

    def write(self, mv: np.ndarray) -> None:
        self.written.append(mv.copy())
        mv[:] = 1e9
        self.at("write")

    def hand_back(self) -> None:
        self.handed_back += 1
        self.at("hand_back")

    def check(self, *_: Any) -> str | None:
        self.at("guard")
        return None

    def now(self) -> float:
        return self.clock.now()

    def sleep_until(self, time_s: float) -> None:
        self.at("clock")
        self.clock.sleep_until(time_s)

    def step(self, **inputs: Any) -> Any:
        self.at("step")
        return self.inner_step(**inputs)

    def warm(self) -> None:
        self.at("warm")
        self.inner_warm()

    def observe(self, _: Sample | None, command: Command) -> None:
        self.shadowed += command.mode is Mode.SHADOW
        self.outside = self.outside or "nothing is written before it is back" in command.fault
        if not (command.mode is Mode.SHADOW or command.writes or command.hand_back):
            assert self.outside or "nothing is written before a good read-back tells" in command.fault
            assert np.isnan(command.mv).all()
            self.left += not command.fault.startswith("the plant cannot be written")
        assert command.law_mv is None or legal(command.law_mv, self.m.mv)
        assert command.successor_mv is None or legal(command.successor_mv, self.m.mv)
        for array in (command.law_mv, command.info, command.sp, command.successor_mv):
            if array is not None:
                array[:] = -1e9
        self.at("observe")

    def until(self, _: Command) -> bool:
        self.at("until")
        return False


CHAOS_FILES = [p for p in SHIPPED if p.stem in ("inverse_dob", "minimum_variance", "local_pid_network", "pi_reference")]
CHAOS_FILES += [p for p in SHIPPED if p.parent.name == "jacketed_batch_reactor"]


@settings(deadline=None, max_examples=30)
@given(
    st.data(),
    st.sampled_from(CHAOS_FILES),
    st.sampled_from(["default", "none", "one"]),
    st.sampled_from([None, 1, 2]),
    st.sampled_from([0.0, 0.5, 3.0, 1e3]),
    st.sampled_from(["stay", "safe", "hand back"]),
)
def test_every_written_mv_lies_in_range_and_the_run_never_raises(
    data: st.DataObject, path: Path, guards: str, recover_after: int | None, periods: float, fallback: str
) -> None:
    controller = shipped(path)
    m, chaos = controller.manifest, Chaos(data, controller)
    safe = tuple(data.draw(st.sampled_from(s.values or (s.low, s.middle, s.high))) for s in m.mv)
    rate = tuple(data.draw(st.floats(1e-9, 1e9)) for _ in m.mv)
    n = 8
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loopwright.serving.scan_grid, "MonotonicClock", VirtualClock)
        patch.setattr(controller, "step", chaos.step)
        patch.setattr(controller, "warm", chaos.warm)
        chaos.loop = ControlLoop(
            controller,
            chaos,
            sp=middle(m.sp),
            mv=middle(m.mv),
            mode=Mode.AUTO,
            guards={"default": (*default_guards(m), chaos), "none": (), "one": (chaos,)}[guards],
            recover_after=recover_after,
            clock=chaos,
            transfer_s=periods * m.period_s,
            fallback={
                "stay": None,
                "safe": Fallback(m.period_s, safe, rate),
                "hand back": Fallback(m.period_s, hand_back=True),
            }[fallback],
        )
        report = chaos.loop.run(n, before=chaos.before, observe=chaos.observe, until=chaos.until)
    assert report.scans + report.missed == n
    assert len(chaos.written) == report.scans - chaos.shadowed - chaos.handed_back - chaos.left
    assert [mv.tolist() for mv in chaos.written if not legal(mv, m.mv)] == []
    assert legal(chaos.loop.mv, m.mv) or (chaos.outside and np.isnan(chaos.loop.mv).all())
    assert not any("AssertionError" in text for text in report.first_errors)


# ---------------------------------------------------------------------- time
class SlowTank(Tank):
    """A tank whose reading takes time."""

    def __init__(self, clock: VirtualClock, delays: dict[int, float]) -> None:
        super().__init__()
        self.clock, self.delays, self.times = clock, delays, []

    def read(self) -> Sample:
        self.times.append(round((self.clock.now() - 100.0) / PERIOD, 9))
        self.clock.advance(self.delays.get(self.reads, 0.01))
        return super().read()


def test_lateness_is_no_drift_and_missed_periods_are_counted(make_loop: Callable[..., ControlLoop]) -> None:
    clock = VirtualClock(100.0)
    tank = SlowTank(clock, {2: 0.7, 5: 1.3})
    report = make_loop(tank, clock=clock).run(12)
    # scan 2 takes 1.4 periods: the next is late by 0.4 and the one after on time again; scan 5 takes 2.6
    assert tank.times == [0, 1, 2, 3.4, 4, 5, 7.6, 8, 9, 10, 11]
    assert (report.scans, report.missed) == (11, 1)
    assert report.latest_s == pytest.approx(0.3)


def test_the_grid_has_no_drift_over_many_periods(make_loop: Callable[..., ControlLoop]) -> None:
    clock = VirtualClock(100.0)
    tank = SlowTank(clock, {k: 0.1 * (k % 4) for k in range(2000)})
    make_loop(tank, clock=clock).run(2000)
    assert tank.times == list(range(2000))


@pytest.mark.parametrize(("delay", "cold"), [(1.2, False), (3.1, True)])
def test_a_long_gap_starts_the_law_cold(
    shared: Controller, make_loop: Callable[..., ControlLoop], delay: float, cold: bool
) -> None:
    clock = VirtualClock(100.0)
    tank = SlowTank(clock, {3: delay})
    seen: list[tuple[Any, Command]] = []
    make_loop(tank, clock=clock, max_gap=3).run(12, observe=lambda s, c: seen.append((s, c)))
    s, command = seen[4]
    fresh = shared.step(sp=1.0, pv=s.pv, mv_applied=s.mv_applied, state=shared.cold_state())
    assert np.array_equal(command.mv, fresh.mv) is cold


def test_run_ends_when_told(make_loop: Callable[..., ControlLoop]) -> None:
    places: list[int] = []
    report = make_loop(Tank()).run(until=lambda c: c.scan == 7, before=places.append)
    assert report.scans == 8
    assert places == list(range(8))


def test_a_run_that_is_stopped_between_two_scans_makes_no_other_one(make_loop: Callable[..., ControlLoop]) -> None:
    tank, clock, places = Tank(), VirtualClock(), list[int]()
    loop, before = make_loop(tank, clock=clock), len(tank.written)
    report = loop.run(before=places.append, stop=lambda: clock.now() > 2.5 * PERIOD)
    assert (report.scans, places, len(tank.written) - before) == (3, [0, 1, 2], 3)
    assert loop.run(stop=lambda: True).scans == 0


def test_the_law_is_warmed_just_before_each_deadline(make_loop: Callable[..., ControlLoop], monkeypatch: Any) -> None:
    clock = VirtualClock(100.0)
    loop = make_loop(Tank(), clock=clock, warm_lead_s=1e-3)
    warmed: list[float] = []
    monkeypatch.setattr(loop.controller, "warm", lambda: warmed.append(clock.now() - 100.0))
    loop.run(3)
    assert warmed == pytest.approx([0.0, PERIOD - 1e-3, 2 * PERIOD - 1e-3])


def test_the_machines_clock_keeps_its_word() -> None:
    for speed in (1.0, 50.0):
        clock = MonotonicClock(speed)
        until = clock.now() + 2e-3 * speed
        clock.sleep_until(until)
        assert clock.now() >= until
        clock.sleep_until(until - 10)  # long ago: at once


def test_a_sleep_of_an_hour_ends_when_the_clock_is_ended() -> None:
    clock = MonotonicClock()
    asleep = threading.Thread(target=lambda: clock.sleep_until(clock.now() + 3600), daemon=True)
    asleep.start()
    clock.end()
    asleep.join(60)
    assert not asleep.is_alive()
