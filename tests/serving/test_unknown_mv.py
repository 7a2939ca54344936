"""A loop that is not told where the MV stands: it writes nothing until the plant says so, and begins from there."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.export.gate import export
from loopwright.serving import Controller, ControlLoop, EndpointError, Fallback, Mode, Sample, VirtualClock

pytest_plugins = ["small_laws"]
STANDS = 63.0


def sample(level: float = 0.8, mv: float | None = STANDS) -> Sample:
    read_back = None if mv is None else np.array([mv])
    return Sample(pv=np.array([level, 300.0]), mv_applied=read_back, dv=np.zeros(1))


def loop_on(pi_file: Path, endpoint: Any = None, **options: Any) -> ControlLoop:
    """At rest on its set point, so that the law of AUTO leaves the MV where it is."""
    wanted = {"sp": 0.8, "mode": Mode.AUTO, "recover_after": 2, "clock": VirtualClock(), "warm_lead_s": 0, **options}
    return ControlLoop(Controller(pi_file), endpoint, **wanted)


@pytest.mark.parametrize("mode", [Mode.AUTO, Mode.MANUAL, Mode.HOLD])
def test_nothing_is_written_before_a_good_sample_with_a_read_back(mode: Mode, pi_file: Path) -> None:
    loop = loop_on(pi_file, mode=mode)
    for blind in (None, sample(math.nan), sample(mv=math.nan), sample(mv=200.0), sample(mv=None)):
        command = loop.miss("no route") if blind is None else loop.scan(blind)
        assert not command.writes
        assert np.isnan(command.mv).all()
        assert command.fault
    command = loop.scan(sample())
    assert command.writes
    assert command.mv.tolist() == [STANDS]
    after = loop.miss("no route")
    assert after.writes
    assert after.mv.tolist() == [STANDS]


def test_a_good_first_sample_begins_at_once_from_the_read_back(pi_file: Path) -> None:
    command = loop_on(pi_file).scan(sample())
    assert (command.mode, command.writes, command.mv.tolist()) == (Mode.AUTO, True, [STANDS])
    moved = loop_on(pi_file, sp=0.9).scan(sample())
    told = loop_on(pi_file, sp=0.9, mv=[STANDS]).scan(sample())
    assert moved.mv.tolist() == told.mv.tolist() != [STANDS]


def test_a_missing_read_back_is_named_until_there_is_one(pi_file: Path) -> None:
    loop = loop_on(pi_file)
    assert "there is no read-back" in loop.scan(sample(mv=None)).fault
    assert loop.scan(sample()).mv.tolist() == [STANDS]
    assert loop.scan(sample(mv=None)).writes  # from now on the last command counts as applied


def test_what_the_operator_sets_by_hand_is_written(pi_file: Path) -> None:
    loop = loop_on(pi_file, mode=Mode.MANUAL)
    loop.set_mv([20.0])
    command = loop.miss("no route")
    assert (command.writes, command.mv.tolist()) == (True, [20.0])


def test_a_lasting_fault_moves_no_mv_that_is_not_known(pi_file: Path) -> None:
    loop = loop_on(pi_file, fallback=Fallback(after_s=0.0, mv=(10.0,), rate=(1.0,)))
    assert not any(loop.miss("no route").writes for _ in range(5))
    assert loop.scan(sample()).mv[0] < STANDS  # known now, the fault still there: towards the safe MV


class Plant:
    """Cannot be read at some scans, and written at others; ``written`` is what reaches it."""

    def __init__(self, unread: set[int], unwritten: set[int]) -> None:
        self.unread, self.unwritten, self.reads, self.tried = unread, unwritten, 0, 0
        self.written: list[float] = []

    def read(self) -> Sample:
        self.reads += 1
        if self.reads - 1 in self.unread:
            raise EndpointError("no route")
        return sample()

    def write(self, mv: np.ndarray) -> None:
        self.tried += 1
        if self.tried - 1 in self.unwritten:
            raise EndpointError("no way")
        self.written.append(float(mv[0]))


def test_a_run_writes_from_the_first_good_sample_on(pi_file: Path) -> None:
    plant = Plant({0, 1}, set())
    report = loop_on(pi_file, plant).run(6)
    assert (report.scans, report.faults) == (6, 3)
    assert plant.written == [STANDS] * 4


def test_after_a_first_command_that_did_not_arrive_nothing_is_known(pi_file: Path) -> None:
    plant = Plant({1}, {0})
    seen: list[bool] = []
    loop_on(pi_file, plant).run(4, observe=lambda _, command: seen.append(command.writes))
    assert seen == [False, False, True, True]
    assert plant.written == [STANDS] * 2


@pytest.mark.parametrize("given", [np.array(["1"]), np.array([b"1"]), np.array([True]), [True], ["1"], [None]])
def test_a_read_back_that_is_no_number_is_believed_by_no_loop(given: Any, pi_file: Path) -> None:
    """Not by one without guards either: 400 became 1 within a scan."""
    loop = loop_on(pi_file, guards=(), mv=[STANDS])
    command = loop.scan(Sample(np.array([0.8, 300.0]), given, np.zeros(1)))
    assert (command.mode, command.mv.tolist()) == (Mode.HOLD, [STANDS])
    unknown = loop_on(pi_file, guards=(), mode=Mode.MANUAL)
    assert not unknown.scan(Sample(np.array([0.8, 300.0]), given, np.zeros(1))).writes


# ------------------------------------------------------------------------------------------- a shadow that takes over
@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.HOLD])
def test_a_shadow_that_takes_over_writes_the_mv_that_is_read_back_now(mode: Mode, pi_file: Path) -> None:
    """The plant's own side moved it since the last scan; the old one would bump it back, and faster than its rate."""
    loop = loop_on(pi_file, mode=Mode.SHADOW)
    loop.scan(sample())
    loop.set_mode(mode)
    assert loop.scan(sample(mv=STANDS + 8)).mv.tolist() == [STANDS + 8]
    assert loop.scan(sample(mv=STANDS + 9)).mv.tolist() == [STANDS + 8]  # from then on it is the loop's


def test_a_shadow_that_ends_by_way_of_another_mode_writes_no_old_mv(pi_file: Path) -> None:
    loop = loop_on(pi_file, mode=Mode.SHADOW)
    loop.scan(sample())
    loop.set_mode(Mode.AUTO)
    loop.set_mode(Mode.MANUAL)
    assert loop.scan(sample(mv=STANDS + 8)).mv.tolist() == [STANDS + 8]


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.HOLD, Mode.AUTO])
def test_as_a_shadow_ends_nothing_is_written_before_a_sample_tells_where_the_mv_stands(
    mode: Mode, pi_file: Path
) -> None:
    loop = loop_on(pi_file, mode=Mode.SHADOW)
    loop.scan(sample())
    loop.set_mode(mode)
    assert not loop.miss("no route").writes
    assert not loop.scan(sample(math.nan, mv=None)).writes
    assert not loop.scan(sample(mv=200.0)).writes
    assert loop.scan(sample(math.nan, mv=STANDS + 8)).mv.tolist() == [STANDS + 8]
    loop = loop_on(pi_file, mode=Mode.SHADOW)
    loop.scan(sample())
    loop.set_mode(mode)
    command = loop.scan(sample(mv=None))  # a plant that reads nothing back any more
    assert command.writes
    assert command.mv.tolist() == [STANDS]


def test_a_command_that_did_not_arrive_as_a_shadow_ends_leaves_the_mv_where_others_moved_it(pi_file: Path) -> None:
    loop = loop_on(pi_file, mode=Mode.SHADOW)
    loop.scan(sample())
    loop.set_mode(Mode.HOLD)
    before = loop.mv
    loop.scan(sample(mv=STANDS + 8))
    loop.unwritten(before, "no way")
    assert loop.scan(sample(mv=None)).mv.tolist() == [STANDS + 8]


def test_after_a_lost_command_an_unreadable_plant_gets_no_old_mv(pi_file: Path) -> None:
    """Others may have moved it: a read that fails tells as little as a refused sample without a read-back."""
    loop = loop_on(pi_file, mode=Mode.MANUAL)
    loop.scan(sample())
    loop.unwritten(loop.mv, "no way")
    assert not loop.miss("no route").writes
    assert loop.scan(sample(mv=STANDS + 8)).mv.tolist() == [STANDS + 8]


def test_what_the_operator_sets_by_hand_as_a_shadow_ends_is_written(pi_file: Path) -> None:
    loop = loop_on(pi_file, mode=Mode.SHADOW)
    loop.scan(sample())
    loop.set_mode(Mode.MANUAL)
    loop.set_mv([20.0])
    assert loop.scan(sample(mv=STANDS + 8)).mv.tolist() == [20.0]


def test_a_way_by_hand_ends_where_the_mv_is_read_back_outside_its_range(pi_file: Path) -> None:
    """A good sample without a read-back then tells nothing of where it stands."""
    loop = loop_on(pi_file, mode=Mode.SHADOW)
    loop.scan(sample())
    loop.set_mode(Mode.MANUAL)
    loop.set_mv([20.0])
    assert not loop.scan(sample(mv=200.0)).writes
    assert not loop.scan(sample(mv=None)).writes
    assert loop.scan(sample(mv=STANDS + 8)).mv.tolist() == [STANDS + 8]


# ------------------------------------------------------------------------------------- by hand, and what did not arrive
def rated_loop(make_formula: Any, pi_law: Any, tmp_path: Path, **options: Any) -> ControlLoop:
    """Of a law that leaves its MV where it is; the MV moves by 4 a period."""
    signals = replace(pi_law.signals, mv=(replace(pi_law.signals.mv[0], max_move=4.0),))
    path = tmp_path / "rated.onnx"
    export(
        make_formula(lambda law, sp, pv, dv, mv, state: (mv, state, pv), 1, ("a", "b"), signals),
        path,
        case="x",
        provenance={},
    )
    return ControlLoop(Controller(path), **{"sp": 0.8, "mode": Mode.MANUAL, "recover_after": 2, **options})


@pytest.mark.parametrize("rated", [False, True])
@pytest.mark.parametrize("bad", [200.0, math.nan])
def test_by_hand_from_nowhere_known_a_bad_read_back_ends_the_way(
    rated: bool, bad: float, pi_file: Path, make_formula: Any, pi_law: Any, tmp_path: Path
) -> None:
    loop = rated_loop(make_formula, pi_law, tmp_path) if rated else loop_on(pi_file, mode=Mode.MANUAL)
    loop.set_mv([20.0])
    assert not loop.scan(sample(mv=bad)).writes
    assert not loop.scan(sample(mv=None)).writes
    loop.set_mv([20.0])
    assert loop.scan(sample(mv=None)).mv.tolist() == [20.0]  # nobody but the operator says where it is


@pytest.mark.parametrize("refused", [None, sample(math.nan, mv=None)])
def test_by_hand_from_nowhere_known_a_plant_that_reads_back_is_waited_for(
    refused: Sample | None, pi_file: Path
) -> None:
    loop = loop_on(pi_file, mode=Mode.MANUAL)
    loop.scan(sample(mv=200.0))  # it has a read-back, which tells nothing now
    loop.set_mv([20.0])
    command = loop.miss("no route") if refused is None else loop.scan(refused)
    assert not command.writes
    assert loop.mv_wanted.tolist() == [20.0]
    assert loop.scan(sample()).mv.tolist() == [20.0]


@pytest.mark.parametrize("refused", [None, sample(math.nan, mv=None)])
def test_by_hand_from_nowhere_known_a_plant_that_never_read_back_is_moved(
    refused: Sample | None, pi_file: Path
) -> None:
    loop = loop_on(pi_file, mode=Mode.MANUAL)
    loop.set_mv([20.0])
    command = loop.miss("no route") if refused is None else loop.scan(refused)
    assert command.mv.tolist() == [20.0]


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.HOLD, Mode.AUTO])
def test_after_a_bad_read_back_a_lost_command_leaves_no_mv_to_go_back_to(mode: Mode, pi_file: Path) -> None:
    loop = loop_on(pi_file, mode=mode)
    before = loop.scan(sample()).mv
    loop.scan(sample())
    loop.unwritten(before, "no way")
    assert not loop.scan(sample(mv=math.nan)).writes
    assert not loop.scan(sample(mv=None)).writes
    assert loop.scan(sample(mv=STANDS + 8)).mv.tolist() == [STANDS + 8]


def test_a_plant_that_was_never_read_back_gets_the_old_mv_at_once(pi_file: Path) -> None:
    loop = loop_on(pi_file, mv=[STANDS], mode=Mode.HOLD)
    loop.scan(sample(mv=None))
    loop.unwritten(loop.mv, "no way")
    assert loop.miss("no route").mv.tolist() == [STANDS]
    loop.unwritten(loop.mv, "no way")
    assert loop.scan(sample(math.nan, mv=None)).mv.tolist() == [STANDS]


def test_a_command_of_the_law_that_did_not_arrive_is_none_of_an_operator(pi_file: Path) -> None:
    """Though MANUAL is set before the loop hears of it."""
    loop = loop_on(pi_file, sp=0.9)
    loop.scan(sample())
    before = loop.mv
    assert loop.scan(sample(0.7)).mv.tolist() != before.tolist()
    loop.set_mode(Mode.MANUAL)
    loop.unwritten(before, "no way")
    assert loop.scan(sample(mv=None)).mv.tolist() == before.tolist()


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.AUTO])
def test_a_way_by_hand_that_did_not_arrive_ends_with_the_mode(
    mode: Mode, make_formula: Any, pi_law: Any, tmp_path: Path
) -> None:
    loop = rated_loop(make_formula, pi_law, tmp_path)
    loop.scan(sample())
    before = loop.mv
    loop.set_mv([STANDS + 3])
    assert loop.scan(sample()).mv.tolist() == [STANDS + 3]
    loop.unwritten(before, "no way")
    assert loop.mv_wanted.tolist() == [STANDS + 3]
    loop.set_mode(mode)
    assert loop.scan(sample(mv=None)).mv.tolist() == [STANDS]
