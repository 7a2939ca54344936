"""Who has the plant: a shadow, a law that takes over without a bump, a successor, a fallback when a fault lasts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shipped_files import SHIPPED

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import LAWS
from loopwright.serving import (
    Controller,
    ControlLoop,
    EndpointError,
    Fallback,
    LoopError,
    Mode,
    Sample,
    Signal,
    VirtualClock,
)
from loopwright.serving.modes import Transfer

pytest_plugins = ["small_laws"]
PERIOD = 0.5
by_name = pytest.mark.parametrize("path", SHIPPED, ids=lambda p: f"{p.parent.name}-{p.stem}")


@pytest.fixture
def make_loop(pi_file: Path) -> Callable[..., ControlLoop]:
    def make(endpoint: Any = None, **options: Any) -> ControlLoop:
        values = {"sp": 1.0, "mv": 40.0, "mode": Mode.AUTO, "clock": VirtualClock(100.0), "warm_lead_s": 0, **options}
        return ControlLoop(Controller(pi_file), endpoint, **values)

    return make


def sample(level: float = 0.8, mv: float | None = 40.0, fault: str = "") -> Sample:
    applied = None if mv is None else np.array([mv])
    return Sample(np.array([level, 300.0]), applied, np.zeros(1), fault=fault)


class Line:
    """A plant whose reading can fail; it writes down what it gets."""

    def __init__(self) -> None:
        self.mv, self.written, self.handed_back, self.away, self.deaf = 40.0, list[float](), 0, False, False

    def read(self) -> Sample:
        if self.away:
            raise EndpointError("no answer")
        return sample(0.9, self.mv)

    def write(self, mv: np.ndarray) -> None:
        if self.deaf:
            raise EndpointError("not written")
        self.mv = float(mv[0])
        self.written.append(self.mv)

    def hand_back(self) -> None:
        if self.deaf:
            raise EndpointError("not written")
        self.handed_back += 1


# ---------------------------------------------------------------------- shadow
def test_a_shadow_steps_the_law_and_writes_nothing(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, mode=Mode.SHADOW)
    commands: list[Any] = []
    loop.run(5, observe=lambda s, c: commands.append(c))
    assert line.written == []
    assert all(c.mode is Mode.SHADOW and not c.writes and c.law_mv[0] != 40.0 for c in commands)
    assert [c.mv.tolist() for c in commands] == [[40.0]] * 5  # what the plant has: whoever writes it changes nothing


def test_a_shadow_sees_faults_and_stays_a_shadow(make_loop: Callable[..., ControlLoop]) -> None:
    loop = make_loop(mode=Mode.SHADOW, recover_after=1)
    command = loop.scan(sample(fault="PV level: Bad (sensor failure)"))
    assert (command.mode, command.fault, command.law_mv) == (Mode.SHADOW, "PV level: Bad (sensor failure)", None)
    assert loop.fault == ""
    assert loop.scan(sample()).mode is Mode.SHADOW


@pytest.mark.parametrize("mode", [Mode.AUTO, Mode.MANUAL, Mode.HOLD])
def test_a_shadow_that_does_not_know_where_the_mv_stands_moves_nothing(
    make_loop: Callable[..., ControlLoop], mode: Mode
) -> None:
    loop = make_loop(mode=Mode.SHADOW)
    loop.scan(sample(fault="PV level: Bad"))
    with pytest.raises(LoopError, match=r"the last sample was refused \(PV level: Bad\): where the MV stands"):
        loop.set_mode(mode)
    loop.miss("no answer")
    with pytest.raises(LoopError, match="no answer"):
        loop.set_mode(mode)
    loop.scan(sample(mv=55.0))
    loop.set_mode(mode)
    assert loop.scan(sample(mv=55.0, fault="PV level: Bad")).mv.tolist() == [55.0]


def test_an_endpoint_that_does_not_trust_its_sample_is_a_fault(make_loop: Callable[..., ControlLoop]) -> None:
    loop = make_loop(guards=())
    command = loop.scan(sample(mv=55.0, fault="DV inflow: Uncertain"))
    assert (command.mode, command.fault, command.mv.tolist()) == (Mode.HOLD, "DV inflow: Uncertain", [40.0])


# ---------------------------------------------------------------------- transfer
@by_name
@pytest.mark.parametrize("before", [Mode.SHADOW, Mode.MANUAL, Mode.HOLD])
def test_a_shipped_law_takes_over_without_a_bump(path: Path, before: Mode) -> None:
    """At rest on set point: a law that adds stays, another one goes where its model says, over ``transfer_s``."""
    controller, periods = Controller(path), 20
    m, test = controller.manifest, next(iter(CASES[path.parent.name].scenarios().values()))[0]
    plant = CASES[path.parent.name].plant
    pv = plant.measure(test.x0)
    rest = Sample(pv, test.mv0, plant.dv_nominal)
    loop = ControlLoop(
        controller, sp=pv[: len(m.sp)], mv=test.mv0, mode=before, transfer_s=periods * m.period_s, guards=()
    )
    for _ in range(60):
        loop.scan(rest)
    loop.set_mode(Mode.AUTO)
    span = np.array([s.high - s.low for s in m.mv])
    continuous = np.array([s.values is None for s in m.mv])
    move = (np.abs(loop.scan(rest).mv - test.mv0) / span)[continuous]
    if LAWS[m.law].velocity_form:
        assert np.all(move < 1e-6)
    else:
        assert np.all(move <= 1 / periods * (1 + 1e-12))


@by_name
def test_after_a_gap_a_shipped_law_that_starts_cold_moves_over_the_transfer_too(path: Path) -> None:
    """A load that its model lacks: what the law has learnt of it is gone after more than ``max_gap`` periods."""
    controller, periods = Controller(path), 20
    m, test = controller.manifest, next(iter(CASES[path.parent.name].scenarios().values()))[0]
    plant = CASES[path.parent.name].plant
    pv, span = plant.measure(test.x0), np.array([s.high - s.low for s in m.mv])
    continuous = np.array([s.values is None for s in m.mv])
    low, high = np.array([s.low for s in m.mv]), np.array([s.high for s in m.mv])
    applied = np.where(continuous, np.clip(test.mv0 + 0.15 * span, low, high), test.mv0)
    loaded = Sample(pv, applied, plant.dv_nominal)
    loop = ControlLoop(
        controller, sp=pv[: len(m.sp)], mv=test.mv0, mode=Mode.AUTO, transfer_s=periods * m.period_s, guards=()
    )
    for _ in range(80):
        loop.scan(loaded)
    loop.gap(loop.max_gap + 1)
    move = (np.abs(loop.scan(loaded).mv - applied) / span)[continuous]
    assert np.all(move <= 1 / periods * (1 + 1e-9))


OTHERS = [(a, b) for a in Mode for b in Mode if a is not b and b is not Mode.AUTO]


@by_name
def test_no_other_change_of_mode_moves_the_mv_of_a_shipped_law(path: Path) -> None:
    """MANUAL and HOLD begin with the MV that the plant has, and a shadow writes none."""
    controller = Controller(path)
    m, case = controller.manifest, CASES[path.parent.name]
    test = next(iter(case.scenarios().values()))[0]
    pv = case.plant.measure(test.x0)
    for before, after in OTHERS:
        loop = ControlLoop(controller, sp=pv[: len(m.sp)], mv=test.mv0, mode=before, guards=(), transfer_s=m.period_s)
        mv = test.mv0
        for _ in range(5):
            mv = loop.scan(Sample(pv, mv, case.plant.dv_nominal)).mv
        loop.set_mode(after)
        for _ in range(3):
            command = loop.scan(Sample(pv, mv, case.plant.dv_nominal))
            assert command.mode is after
            assert command.writes is (after is not Mode.SHADOW)
            assert command.mv.tolist() == mv.tolist(), (before, after)


def test_a_transfer_ends_where_the_law_wants_the_mv(make_loop: Callable[..., ControlLoop]) -> None:
    transfer = Transfer((Signal("valve", "%", 0.0, 100.0), Signal("drain", "-", 0.0, 1.0, (0.0, 1.0))), 0.5, 5.0)
    transfer.begin()
    applied, law = np.array([40.0, 0.0]), np.array([75.5, 1.0])
    way = []
    for _ in range(6):
        applied = transfer.limited(law, applied)
        way.append(applied.tolist())
    assert way == [[50.0, 1.0], [60.0, 1.0], [70.0, 1.0], [75.5, 1.0], [75.5, 1.0], [75.5, 1.0]]
    assert transfer.limited(np.array([0.0, 1.0]), applied).tolist() == [0.0, 1.0]  # over: the law moves as it likes


def test_a_transfer_is_over_in_time_whatever_the_law_does() -> None:
    transfer = Transfer((Signal("valve", "%", 0.0, 100.0),), 0.5, 2.0)
    transfer.begin()
    applied = np.array([50.0])
    for k in range(4):
        wanted = applied + (-40.0 if k % 2 else 40.0)
        assert abs(transfer.limited(wanted, applied) - applied) == 25.0
    assert transfer.limited(np.array([100.0]), applied)[0] == 100.0


def test_the_transfer_begins_at_each_change_to_auto(make_loop: Callable[..., ControlLoop]) -> None:
    """By hand, and by itself after a fault; the set point is far away, and the law wants 6 % in one scan."""
    loop = make_loop(sp=2.0, transfer_s=50.0, recover_after=2, guards=())
    assert loop.scan(sample(0.5)).mv[0] == 41.0
    loop.miss("gone")
    loop.scan(sample(0.5, 41.0))
    command = loop.scan(sample(0.5, 41.0))
    assert (command.mode, command.mv[0]) == (Mode.AUTO, 42.0)
    loop.set_mode(Mode.MANUAL)
    loop.scan(sample(0.5, 90.0))
    loop.set_mode(Mode.AUTO)
    assert loop.scan(sample(0.5, 90.0)).mv[0] == 91.0


# ---------------------------------------------------------------------- a fault that lasts
def test_a_safe_mv_is_reached_at_its_rate(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, fallback=Fallback(1.0, (20.0,), (6.0,)), recover_after=2)
    line.away = True
    loop.run(12)
    assert line.written == [40.0, 40.0, 37.0, 34.0, 31.0, 28.0, 25.0, 22.0, 20.0, 20.0, 20.0, 20.0]
    line.away = False
    reasons: list[Any] = []
    loop.run(2, observe=lambda s, c: reasons.append((c.mode, c.fault)))
    assert reasons == [(Mode.HOLD, "the plant cannot be read: no answer"), (Mode.AUTO, "")]


def test_the_way_to_the_safe_mv_waits_where_nothing_arrives(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, fallback=Fallback(0.0, (20.0,), (6.0,)))
    line.away = line.deaf = True
    loop.run(5)
    line.deaf = False
    loop.run(2)
    assert line.written == [37.0, 34.0]  # from where the plant was left, not from where it would have been


def test_a_plant_is_handed_back_once(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, fallback=Fallback(1.0, hand_back=True), recover_after=1)
    line.away = line.deaf = True
    modes: list[Any] = []
    loop.run(4, observe=lambda s, c: modes.append((c.mode, c.fault.partition(":")[0])))
    assert modes[-1] == (Mode.HOLD, "the plant cannot be handed back")
    line.deaf = False
    loop.run(1)
    assert (loop.mode, line.handed_back) == (Mode.SHADOW, 1)
    line.away = False
    loop.run(5)
    assert (loop.mode, line.handed_back, line.written) == (Mode.SHADOW, 1, [])


def test_a_fault_that_passes_in_time_moves_nothing(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, fallback=Fallback(1.5, (20.0,), (6.0,)), recover_after=1, sp=0.9)
    for _ in range(4):
        line.away = True
        loop.run(2)
        line.away = False
        loop.run(2)
    assert min(line.written) >= 39.9


def test_an_operator_s_hold_is_no_fault(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    make_loop(line, fallback=Fallback(0.0, (20.0,), (6.0,)), mode=Mode.HOLD).run(5)
    assert line.written == [40.0] * 5


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"after_s": -1.0, "hand_back": True}, "after_s is -1.0; it must be a finite number"),
        ({"after_s": 1.0}, "either goes to a safe MV or hands back"),
        ({"after_s": 1.0, "mv": (1.0,), "rate": (1.0,), "hand_back": True}, "either goes to a safe MV or hands back"),
        ({"after_s": 1.0, "mv": (1.0,)}, "a safe MV needs the rate"),
        ({"after_s": 1.0, "mv": (1.0,), "rate": (0.0,)}, "each must be above zero"),
        ({"after_s": 1.0, "mv": (float("nan"),), "rate": (1.0,)}, "it needs finite numbers"),
    ],
)
def test_wrong_fallbacks_are_named(values: dict[str, Any], words: str) -> None:
    with pytest.raises(LoopError, match=words):
        Fallback(**values)


def test_a_fallback_fits_its_loop(make_loop: Callable[..., ControlLoop]) -> None:
    with pytest.raises(LoopError, match=r"the safe MV valve = 120.0 % is outside \[0, 100\] %"):
        make_loop(fallback=Fallback(1.0, (120.0,), (1.0,)))
    with pytest.raises(LoopError, match="the fallback has 2 rates; it needs 1, one an MV"):
        make_loop(fallback=Fallback(1.0, (20.0,), (1.0, 2.0)))
    with pytest.raises(LoopError, match="object cannot hand the plant back: it has no method hand_back"):
        make_loop(object(), fallback=Fallback(1.0, hand_back=True))
    with pytest.raises(LoopError, match="transfer_s is -1; it must be a finite number of seconds, 0 or more"):
        make_loop(transfer_s=-1)


# ---------------------------------------------------------------------- a successor
def fast(law: Any, sp: Any, pv: Any, dv: Any, mv_applied: Any, state: Any) -> Any:
    """A proportional law that computes its MV afresh."""
    mv = law.limited(50.0 + 100.0 * (sp - pv[..., :1]), mv_applied)
    return mv, state, pv[..., :0]


@pytest.fixture(scope="session")
def fast_file(make_formula: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    from loopwright.pipeline.export.gate import export

    path = tmp_path_factory.mktemp("controller") / "fast.onnx"
    export(make_formula(fast), path, case="tank", provenance={})
    return path


def test_a_successor_is_shown_and_then_takes_over(make_loop: Callable[..., ControlLoop], fast_file: Path) -> None:
    loop, new = make_loop(transfer_s=50.0), Controller(fast_file)
    old = loop.controller
    loop.swap(new, trial=3)
    for k in range(3):
        applied = float(loop.mv[0])
        command = loop.scan(sample(0.8, applied))
        assert command.successor_mv is not None
        assert command.successor_mv.tolist() == pytest.approx([70.0])
        assert loop.controller is (new if k == 2 else old)  # the scan is the old one's
        assert command.law_mv is not None
        assert command.law_mv[0] != 70.0
    applied = float(loop.mv[0])
    command = loop.scan(sample(0.8, applied))
    assert command.successor_mv is None
    assert command.law_mv is not None
    assert command.law_mv.tolist() == pytest.approx([70.0])
    assert command.mv.tolist() == pytest.approx([applied + 1.0])  # 1 % of the range a scan, and no bump
    assert loop.replaced is old
    loop.swap(old, trial=1)
    loop.scan(sample())
    assert loop.controller is old


def test_a_successor_counts_good_scans_in_a_row(
    make_loop: Callable[..., ControlLoop], fast_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, new = make_loop(recover_after=1), Controller(fast_file)
    step, broken = new.step, {3}

    def sometimes(**inputs: Any) -> Any:
        if loop._scan in broken:
            raise ValueError("not today")
        return step(**inputs)

    monkeypatch.setattr(new, "step", sometimes)
    loop.swap(new, trial=2)
    loop.scan(sample())
    loop.miss("no sample")  # 1
    loop.scan(sample())
    command = loop.scan(sample())  # 3
    assert (command.mode, command.successor_mv) == (Mode.AUTO, None)  # the controller in charge goes on
    assert loop.successor is not None
    assert loop.successor.reason == "ValueError: not today"
    loop.scan(sample())
    loop.gap(10)
    loop.scan(sample())
    assert loop.controller is not new
    loop.scan(sample())
    assert loop.controller is new


def test_a_trial_may_be_ended(make_loop: Callable[..., ControlLoop], fast_file: Path) -> None:
    loop = make_loop()
    loop.swap(Controller(fast_file), trial=1)
    loop.keep()
    old = loop.controller
    assert loop.scan(sample()).successor_mv is None
    assert loop.controller is old


def test_a_successor_for_other_set_points_waits_until_they_suit(
    make_loop: Callable[..., ControlLoop], make_formula: Callable[..., Any], tmp_path: Path
) -> None:
    from small_laws import SIGNALS

    (level,) = SIGNALS.sp
    narrow = replace(SIGNALS, sp=(replace(level, high=0.5),))
    export(make_formula(fast, signals=narrow), tmp_path / "narrow.onnx", case="tank", provenance={})
    loop, new = make_loop(), Controller(tmp_path / "narrow.onnx")
    loop.swap(new, trial=1)
    loop.scan(sample())
    assert loop.successor is not None
    assert "the set point level = 1 is outside its range [0, 0.5]" in loop.successor.reason
    loop.set_sp(0.4)
    loop.scan(sample())
    assert loop.controller is new


@by_name
def test_a_controller_of_another_plant_is_refused(path: Path, make_loop: Callable[..., ControlLoop]) -> None:
    with pytest.raises(LoopError, match=r"the new controller \(made for .*\) does not fit this loop \(made for tank\)"):
        make_loop().swap(Controller(path), trial=1)


def test_others_that_do_not_fit_are_named(
    make_loop: Callable[..., ControlLoop], make_formula: Callable[..., Any], tmp_path: Path
) -> None:
    from small_laws import SIGNALS

    from loopwright.pipeline.plants.simulator import Signals

    others = {
        "its period is 1 s, the loop's is 0.5 s": replace(SIGNALS, period_s=1.0),
        r"MVs are valve \[%\] 0..110, the loop's are valve \[%\] 0..100": replace(
            SIGNALS, mv=(Signal("valve", "%", 0.0, 110.0),)
        ),
        r"measured disturbances are heat \[kW\] 0..3, the loop's are inflow": replace(
            SIGNALS, dv=(Signal("heat", "kW", 0.0, 3.0),)
        ),
        r"PVs are T .* have no others, and must begin with those that are controlled": replace(
            SIGNALS, pv=SIGNALS.pv[1:]
        ),
        r"its period is 2 s, .*; its set points are T .*; its MVs are valve .* 0..110, .*; its PVs are T": Signals(
            2.0, SIGNALS.pv[1:], SIGNALS.pv[1:], SIGNALS.dv, (Signal("valve", "%", 0.0, 110.0),)
        ),
        r"PVs are level .*, T \[degC\]": replace(SIGNALS, pv=(SIGNALS.pv[0], replace(SIGNALS.pv[1], unit="degC"))),
    }
    for words, signals in others.items():
        export(make_formula(fast, signals=signals), tmp_path / "other.onnx", case="tank", provenance={})
        with pytest.raises(LoopError, match=words):
            make_loop().swap(Controller(tmp_path / "other.onnx"), trial=1)
    with pytest.raises(LoopError, match="trial is 0; a controller is tried for at least one scan"):
        make_loop().swap(make_loop().controller, trial=0)
