"""After commands that did not reach the plant the loop goes on from where the MV stands, and writes nothing over it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.serving import (
    Command,
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
from loopwright.serving.mv_readback import EQUAL_COMMANDS, SAME_READ_BACK, StandingMv

pytest_plugins = ["small_laws"]
RANGE = 100.0
TOLERANCE = SAME_READ_BACK * RANGE


class Line:
    """A plant with an MV that others may move; a read-back that lags, or differs by an offset; a way that is cut."""

    def __init__(self, mv: float = 40.0, lag: int = 0, offset: float = 0.0) -> None:
        self.mv, self.lag, self.offset = mv, lag, offset
        self.away = self.deaf = self.pv_bad = self.rb_bad = self.rb_gone = False
        self.written: list[float] = []
        self._past = [mv]
        self.owner = 0

    def read(self) -> Sample:
        self._past.append(self.mv)
        if self.away:
            raise EndpointError("no answer")
        read_back = self._past[-1 - min(self.lag, len(self._past) - 1)] + self.offset
        applied = None if self.rb_gone else np.array([np.nan if self.rb_bad else read_back])
        return Sample(np.array([0.9, 300.0]), applied, np.zeros(1), fault="PV level: Bad" if self.pv_bad else "")

    def write(self, mv: np.ndarray) -> None:
        if self.away or self.deaf:
            raise EndpointError("not written")
        self.mv = float(mv[0])
        self.written.append(self.mv)

    def hand_back(self) -> None:
        if self.away or self.deaf:
            raise EndpointError("not written")
        self.owner += 1


@pytest.fixture(scope="module")
def law(pi_file: Path) -> Controller:
    return Controller(pi_file)


@pytest.fixture
def make_loop(law: Controller) -> Callable[..., ControlLoop]:
    def make(line: Line, **options: Any) -> ControlLoop:
        values = {"sp": 1.0, "mv": 40.0, "mode": Mode.AUTO, "clock": VirtualClock(), "warm_lead_s": 0, **options}
        return ControlLoop(law, line, **values)

    return make


def outage(loop: ControlLoop, line: Line, scans: int, moved_to: float | None = None) -> None:
    line.away = True
    loop.run(scans)
    if moved_to is not None:
        line.mv = moved_to
    line.away = False
    line.written.clear()


@pytest.mark.parametrize("mode", [Mode.AUTO, Mode.MANUAL, Mode.HOLD])
@pytest.mark.parametrize("pv_bad", [False, True])
def test_what_others_set_meanwhile_is_held(make_loop: Callable[..., ControlLoop], mode: Mode, pv_bad: bool) -> None:
    """Also while a PV is bad: a read-back that is good says where the MV stands."""
    line = Line()
    loop = make_loop(line, mode=mode)
    loop.run(3)
    outage(loop, line, 50, 71.0)
    line.pv_bad = pv_bad
    loop.run(5)
    assert line.written == [71.0] * 5
    assert loop.mode is (Mode.MANUAL if mode is Mode.MANUAL else Mode.HOLD)


def test_a_read_back_that_is_bad_waits_for_a_good_one(make_loop: Callable[..., ControlLoop]) -> None:
    """Refused writes, as by a plant that somebody else controls: each good read-back counts, and a bad one does not."""
    line = Line()
    loop = make_loop(line, mode=Mode.MANUAL)
    loop.run(3)
    line.deaf = True
    loop.run(4)
    line.mv = 71.0
    loop.run(1)
    line.rb_bad = True
    loop.run(3)
    line.deaf = False
    line.written.clear()
    loop.run(1)
    assert line.written == []
    assert loop.mv.tolist() == [71.0]  # found while nothing could be written, and not forgotten by the next refusal
    line.rb_bad = False
    loop.run(2)
    assert line.written[-2:] == [71.0, 71.0]


@pytest.mark.parametrize("mode", [Mode.AUTO, Mode.MANUAL, Mode.HOLD])
@pytest.mark.parametrize("pv_bad", [False, True])
@pytest.mark.parametrize("gone", [False, True])
def test_nothing_is_written_while_the_read_back_stays_bad(
    make_loop: Callable[..., ControlLoop], mode: Mode, pv_bad: bool, gone: bool
) -> None:
    """Also on the way to a safe MV: it would begin where the MV no longer is."""
    line = Line()
    commands: list[Command] = []
    loop = make_loop(line, mode=mode, fallback=Fallback(1.0, (20.0,), (6.0,)))
    loop.run(3)
    outage(loop, line, 50, 71.0)
    line.rb_bad, line.rb_gone, line.pv_bad = not gone, gone, pv_bad or gone
    loop.run(20, observe=lambda _, command: commands.append(command))
    assert line.written == []
    assert loop.mode is (Mode.MANUAL if mode is Mode.MANUAL else Mode.HOLD)
    assert not any(command.writes for command in commands)
    assert all("nothing is written before a good read-back tells where the MV stands" in c.fault for c in commands)
    assert all(("PV level: Bad" in c.fault) is line.pv_bad for c in commands)
    line.rb_bad = line.rb_gone = False
    loop.run(1)
    assert line.written == [68.0 if mode is Mode.AUTO else 71.0]  # on the way to the safe MV from where the MV stands


@pytest.mark.parametrize("pv_bad", [False, True])
def test_a_plant_that_never_reads_back_gets_the_old_mv(make_loop: Callable[..., ControlLoop], pv_bad: bool) -> None:
    """Nothing would ever tell more; a safe MV is reached, too."""
    line = Line()
    line.rb_gone = True
    loop = make_loop(line, mode=Mode.AUTO, fallback=Fallback(30.0, (20.0,), (6.0,)))
    loop.run(3)
    left = line.mv
    outage(loop, line, 50)
    line.pv_bad = pv_bad
    loop.run(1)
    assert line.written == [left]
    loop.run(80)
    assert line.written[-1] == 20.0


def test_a_plant_whose_read_back_stays_bad_is_handed_back(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, fallback=Fallback(1.0, hand_back=True))
    loop.run(3)
    line.away = True
    loop.run(1)
    line.away, line.rb_bad = False, True
    line.written.clear()
    loop.run(10)
    assert (line.written, line.owner, loop.mode) == ([], 1, Mode.SHADOW)


def test_an_mv_is_not_set_by_hand_while_nobody_knows_where_it_stands(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, mode=Mode.MANUAL)
    loop.run(1)
    line.away = True
    loop.run(2)
    with pytest.raises(LoopError, match="the last MV did not reach the plant, so where the MV stands is not known"):
        loop.set_mv(63.0)
    line.away = False
    loop.run(1)
    loop.set_mv(63.0)
    loop.run(1)
    assert line.written[-1] == 63.0


def test_a_loop_without_read_back_keeps_what_it_has(law: Controller) -> None:
    loop = ControlLoop(law, sp=1.0, mv=40.0, mode=Mode.MANUAL)
    sample = Sample(np.array([0.9, 300.0]), None, np.zeros(1))
    loop.scan(sample)
    loop.unwritten(loop.mv, "not written")
    assert loop.scan(sample).mv.tolist() == [40.0]
    loop.set_mv(63.0)
    assert loop.scan(sample).mv.tolist() == [63.0]


def test_a_safe_mv_is_reached_from_where_the_mv_stands(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, fallback=Fallback(1.0, (20.0,), (6.0,)))
    loop.run(3)
    outage(loop, line, 50, 71.0)
    line.pv_bad = True
    loop.run(20)
    assert line.written == [*np.arange(68.0, 20.0, -3.0), 20.0, 20.0, 20.0, 20.0]


def test_a_plant_that_is_handed_back_is_not_moved(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, fallback=Fallback(1.0, hand_back=True))
    loop.run(3)
    outage(loop, line, 50, 71.0)
    loop.run(5)
    assert (line.written, line.owner, loop.mode) == ([], 1, Mode.SHADOW)
    loop.set_mode(Mode.HOLD)
    loop.run(2)
    assert line.written == [71.0, 71.0]


def test_a_loop_that_has_asked_the_plants_own_controller_to_take_over_does_not_recover(
    make_loop: Callable[..., ControlLoop],
) -> None:
    """The plant's controller may have taken over already, though it is not confirmed yet."""
    line = Line()
    asked: list[bool] = []
    loop = make_loop(line, recover_after=1, fallback=Fallback(1.0, hand_back=True))
    loop.run(3)
    line.pv_bad = True
    while not (asked and asked[-1]):
        line.deaf = len(asked) > 1  # it is not confirmed
        loop.run(1, observe=lambda _, command: asked.append(command.hand_back))
    line.pv_bad = line.deaf = False
    line.written.clear()
    loop.run(5, observe=lambda _, command: asked.append(command.hand_back))
    assert (line.written, line.owner, loop.mode) == ([], 1, Mode.SHADOW)


def test_auto_takes_over_from_where_the_mv_stands(make_loop: Callable[..., ControlLoop]) -> None:
    line = Line()
    loop = make_loop(line, sp=0.9, recover_after=3, transfer_s=50.0)
    loop.run(3)
    outage(loop, line, 50, 71.0)
    loop.run(20)
    assert loop.mode is Mode.AUTO
    assert np.abs(np.diff([71.0, *line.written])).max() <= 1.0 + 1e-9  # 1 % of the range a scan


@pytest.mark.parametrize(("lag", "offset"), [(1, 0.0), (2, 0.0), (0, 0.7), (1, -1.3)])
@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.HOLD])
def test_a_read_back_that_lags_or_differs_does_not_make_the_mv_creep(
    make_loop: Callable[..., ControlLoop], mode: Mode, lag: int, offset: float
) -> None:
    """A thousand outages in which nobody moves anything."""
    line = Line(lag=lag, offset=offset)
    loop = make_loop(line, mode=mode)
    loop.run(EQUAL_COMMANDS + lag + 2)
    for k in range(1_000):
        outage(loop, line, 1 + k % 4)
        loop.run(1 + k % 3)
    assert line.mv == 40.0


@pytest.mark.parametrize("mode", [Mode.AUTO, Mode.MANUAL, Mode.HOLD])
@pytest.mark.parametrize("pv_bad", [False, True])
def test_an_mv_that_was_set_outside_the_range_meanwhile_is_left_there(
    make_loop: Callable[..., ControlLoop], mode: Mode, pv_bad: bool
) -> None:
    line = Line()
    reasons: list[str] = []
    loop = make_loop(line, mode=mode, fallback=Fallback(1.0, (20.0,), (6.0,)))
    loop.run(3)
    outage(loop, line, 50, 130.0)
    line.pv_bad = pv_bad
    loop.run(10, observe=lambda _, command: reasons.append(command.fault))
    assert line.written == []
    assert all("applied MV valve is 130 %, outside its range" in reason for reason in reasons)
    assert all("nothing is written before it is back" in reason for reason in reasons)
    assert all(("PV level: Bad" in reason) is pv_bad for reason in reasons)
    line.rb_bad = True  # what was read before still holds
    loop.run(3)
    assert line.written == []
    line.rb_bad = line.pv_bad = False
    line.mv = 71.0
    loop.run(1)
    assert line.written[0] == (71.0 if mode is not Mode.AUTO else 68.0)  # on the way to the safe MV


BACK = 60.0
MOVES = st.none() | st.floats(0.0, RANGE - 1.0) | st.floats(RANGE + 3.0, 200.0) | st.floats(-200.0, -3.0)


@settings(deadline=None, max_examples=120)
@given(st.data(), st.sampled_from([0, 1, 2]), st.sampled_from([0.0, 0.5]), st.sampled_from([Mode.MANUAL, Mode.HOLD]))
def test_no_outage_moves_an_mv_that_nobody_moved_and_none_writes_over_one_that_was_moved(
    law: Controller, data: st.DataObject, lag: int, offset: float, mode: Mode
) -> None:
    """The bound on every MV that is written after an outage of any length, whenever somebody moves the MV.

    - It is where the MV stood ``lag`` periods before the first good read-back, within ``SAME_READ_BACK`` of the range.
    So a move
      that is older than the lag is never written over. A younger one is: no read-back shows it yet.
    - There is none as long as each read-back since is bad, nor where the first good one lies outside the range by more
      than ``READ_BACK_MARGIN``.

    Within that margin of an end a read-back is clipped, and the bound is the margin: no such move is drawn here.
    """
    line = Line(lag=lag, offset=offset)
    loop = ControlLoop(law, line, sp=1.0, mv=40.0, mode=mode, clock=VirtualClock(), warm_lead_s=0)
    loop.run(EQUAL_COMMANDS + lag + 2)
    for _ in range(data.draw(st.integers(1, 6))):
        stands = line.mv  # as far as a loop can know
        moved, scans = data.draw(MOVES), data.draw(st.integers(1, lag + 20))
        blind = data.draw(st.sampled_from([0, 0, 1, 3]))  # scans with a bad read-back after the outage
        at = data.draw(st.integers(0, scans + blind + lag))
        away, line.pv_bad = data.draw(st.booleans()), data.draw(st.booleans())
        told = False
        for k in range(scans + blind + 2 * lag + 5):
            line.away, line.deaf = k < scans and away, k < scans and not away
            line.rb_bad = scans <= k < scans + blind
            line.mv = moved if moved is not None and k == at else line.mv
            shown = [*line._past, line.mv][-1 - lag]
            if not (told or k == 0 or line.away or line.rb_bad):
                stands, told = shown, k >= scans and 0 <= shown <= RANGE
            line.written.clear()
            loop.run(1)
            if k < scans or not told:
                assert line.written == []
            elif moved is None:
                assert line.written == [stands]
            else:
                assert np.abs(np.array(line.written) - stands).max() <= TOLERANCE + 1e-9
            assert len(line.written) <= 1
        if not told:  # somebody brings it back into the range
            line.mv = BACK
            loop.run(2 * lag + 5)
            assert np.abs(np.array(line.written) - BACK).max() <= TOLERANCE + 1e-9
        line.pv_bad = False


def test_a_move_that_no_read_back_shows_yet_is_written_over(make_loop: Callable[..., ControlLoop]) -> None:
    """What the bound above does not promise, so that nobody takes it for more than it is."""
    line = Line(lag=2)
    loop = make_loop(line, mode=Mode.MANUAL)
    loop.run(EQUAL_COMMANDS + 4)
    outage(loop, line, 10, 71.0)  # moved last of all, so that the first read-back is older
    loop.run(3)
    assert line.written == [40.0] * 3


def test_a_difference_of_rounding_is_no_offset() -> None:
    """Else the MV that a loop holds after a loss would differ from the plant's own in its last bits."""
    standing = StandingMv((Signal("u", "%", 0.0, 100.0),), np.array([50.0]))
    for _ in range(10):
        standing.commanded(np.array([50.0]), written=True)
        standing.seen(np.array([50.0 + 1e-13]))
    standing.commanded(np.array([50.0]), written=True)
    standing.lost = True
    found = standing.seen(np.array([70.0 + 1e-13]))
    assert found is not None
    assert found.tolist() == [70.0 + 1e-13]


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.AUTO])
def test_what_others_moved_while_the_loop_was_a_shadow_is_no_offset(
    make_loop: Callable[..., ControlLoop], mode: Mode
) -> None:
    """The normal way in: the operator moves the MV a little, then presses AUTO. An outage then moves it by nothing."""
    line = Line()
    loop = make_loop(line, mode=Mode.SHADOW)
    loop.run(2 * EQUAL_COMMANDS)
    line.mv += 0.016 * RANGE
    loop.run(2)
    loop.set_mode(mode)
    loop.run(3 * EQUAL_COMMANDS)
    for _ in range(3):
        line.pv_bad = True
        outage(loop, line, 4, line.mv)
        line.written.clear()
        stands = line.mv
        loop.run(3)
        assert line.written == pytest.approx([stands] * len(line.written), abs=1e-9)
        assert line.mv == pytest.approx(stands, abs=1e-9)
        line.pv_bad = False
        loop.run(2 * EQUAL_COMMANDS)
