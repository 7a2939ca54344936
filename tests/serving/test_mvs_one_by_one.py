"""MVs in an operator's hand, and MVs that the plant has itself, while the law goes on with the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from actuators_of_plants import ActuatedPlant
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from operated_law import FASTEST, Given

from loopwright.serving import Controller, ControlLoop, LoopError, Mode, Sample
from loopwright.serving.modes import Command, Fallback

pytest_plugins = ["small_laws", "operated_files"]
NAN = float("nan")
MOST = 0.1  # V a period, of the law ``slow_mvs``
MARGIN = 0.04  # V, 2 % of an MV's range


def sample(t: float = 300.0, p: float = 5.0, valve: float = 40.0, local: str = "") -> Sample:
    return Sample(np.array([t, p, 0.5]), np.array([valve, 0.5]), local=(local, "") if local else ())


def loop_of(controller: Controller, **options: Any) -> ControlLoop:
    return ControlLoop(controller, **{"sp": [300.0, 5.0], "mv": [40.0, 0.5], "mode": Mode.AUTO, **options})


def steered(controller: Controller, **options: Any) -> ControlLoop:
    return ControlLoop(controller, **{"sp": [0.2, -0.1], "mv": [0.0, 0.0], "mode": Mode.AUTO, **options})


def run(loop: ControlLoop, plant: ActuatedPlant, scans: int) -> list[Command]:
    found = []
    for _ in range(scans):
        command = loop.scan(plant.sample())
        plant.write(command.mv)
        found.append(command)
    return found


# ---------------------------------------------------------------------------------------------------- in hand, in AUTO
def test_an_mv_out_of_use_goes_where_its_operator_sends_it_and_the_law_knows(operated: Controller) -> None:
    loop = loop_of(operated, operate={"valve.use": 0.0})
    valve = 40.0
    loop.scan(sample(t=290.0))
    loop.set_mv([44.0, 0.5])
    for _ in range(3):
        command = loop.scan(sample(t=290.0, valve=valve))
        valve = float(command.mv[0])
        assert (valve, command.mode) == (44.0, Mode.AUTO)  # this valve has no largest move
        assert command.law_mv is not None
        assert command.law_mv[0] == 44.0  # the law has learnt it
    assert Given.of(operated.manifest, command.info).operate["valve.use"] == 0.0


def test_it_goes_there_no_faster_than_it_may(slow_mvs: Controller, predictive_model: Any) -> None:
    plant, loop = ActuatedPlant(predictive_model), steered(slow_mvs, operate={"u1.use": 0.0})
    run(loop, plant, 3)
    begun = float(loop.mv[1])
    loop.set_mv([loop.mv_wanted[0], begun + 0.25])
    moves = [float(c.mv[1]) - begun for c in run(loop, plant, 4)]
    assert moves == pytest.approx([0.1, 0.2, 0.25, 0.25])
    assert loop.mv_wanted[1] == begun + 0.25
    assert loop.mv_wanted[0] == loop.mv[0]


@pytest.mark.parametrize(
    ("mv", "names"), [([60.0, 0.5], "valve"), ([40.0, 0.9], "heat"), ([140.0, 0.5], "valve")], ids=str
)
def test_an_mv_of_the_law_is_not_moved_by_hand(operated: Controller, mv: list[float], names: str) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    with pytest.raises(LoopError, match=names) as error:
        loop.set_mv(mv)
    assert "\n" not in str(error.value)
    assert loop.mv.tolist() == [40.0, 0.5]


def test_a_law_without_operate_is_moved_by_hand_in_manual_alone(not_operated: Controller) -> None:
    loop = loop_of(not_operated)
    with pytest.raises(LoopError, match="MANUAL"):
        loop.set_mv([40.0, 0.5])
    command = loop.scan(sample(local="in local"))
    assert (command.mode, dict(command.local)) == (Mode.AUTO, {})
    assert loop.scan(sample(valve=NAN)).mode is Mode.HOLD


def test_its_way_by_hand_ends_where_the_law_takes_it_again(slow_mvs: Controller, predictive_model: Any) -> None:
    plant, loop = ActuatedPlant(predictive_model), steered(slow_mvs, operate={"u1.use": 0.0})
    run(loop, plant, 3)
    loop.set_mv([loop.mv_wanted[0], 0.9])
    assert run(loop, plant, 2)[-1].mv[1] == pytest.approx(0.2)
    loop.set_operate({"u1.use": 1.0})
    run(loop, plant, 1)
    assert loop.mv_wanted[1] == loop.mv[1]


@pytest.mark.parametrize("stands", [40.0, 55.0], ids=["as commanded", "elsewhere"])
def test_an_mv_is_taken_in_hand_and_sent_to_a_value_at_once(operated: Controller, stands: float) -> None:
    """Also one that is read back far off its command, which stays there when it is taken in hand alone."""
    loop = loop_of(operated)
    loop.scan(sample(t=290.0, valve=float(loop.mv[0])))
    others = loop.operate
    loop.set_mv([62.0, loop.mv[1]], take=["valve"])
    assert np.count_nonzero(loop.operate != others) == 1
    command = loop.scan(sample(t=290.0, valve=stands))
    assert (command.mv[0], command.mode) == (62.0, Mode.AUTO)
    later = loop.scan(sample(t=290.0, valve=62.0))
    assert later.mv[0] == 62.0
    assert later.law_mv is not None
    assert later.law_mv[0] == 62.0  # the law has learnt it
    loop.set_operate({"valve.use": 1.0})
    assert loop.scan(sample(t=300.0, valve=62.0)).mode is Mode.AUTO


def test_an_mv_that_is_taken_in_hand_goes_no_faster_and_comes_back_without_a_bump(
    slow_mvs: Controller, predictive_model: Any
) -> None:
    loose = {"y0.track": 0.0, "y1.track": 0.0}
    plant, loop = ActuatedPlant(predictive_model), steered(slow_mvs, operate=loose)
    run(loop, plant, 20)
    begun = float(loop.mv[1])
    loop.set_mv([loop.mv[0], begun + 0.25], take=["u1"])
    moves = [float(c.mv[1]) - begun for c in run(loop, plant, 4)]
    assert moves == pytest.approx([0.1, 0.2, 0.25, 0.25])
    loop.set_operate({"u1.use": 1.0})
    assert [float(c.mv[1]) - begun for c in run(loop, plant, 3)] == pytest.approx([0.25] * 3)


def test_what_cannot_be_taken_in_hand_is_refused_and_nothing_is_changed(operated: Controller) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    before = loop.operate.tolist(), loop.mv.tolist()
    for values, take in (([140.0, 0.5], "valve"), ([40.0, 0.6], "heat")):  # out of range; one that this law needs
        with pytest.raises(LoopError, match=take):
            loop.set_mv(values, take=[take])
    loop.set_mode(Mode.SHADOW)
    with pytest.raises(LoopError, match="SHADOW"):
        loop.set_mv([41.0, 0.5], take=["valve"])
    assert (loop.operate.tolist(), loop.mv.tolist()) == before


@pytest.mark.parametrize("moved", [0.0, 0.013, -0.031, 0.3], ids=str)
def test_in_hand_and_back_at_rest_is_no_bump(slow_mvs: Controller, predictive_model: Any, moved: float) -> None:
    """Nothing is tracked, so that no optimum asks for a move; an actuator is read back a little off its command."""
    loose = {"y0.track": 0.0, "y1.track": 0.0}
    plant, loop = ActuatedPlant(predictive_model), steered(slow_mvs, operate=loose)
    plant.offset[:] = 0.011, -0.007
    run(loop, plant, 40)
    loop.set_operate({"u1.use": 0.0})
    before = loop.mv
    taken = run(loop, plant, 5)
    assert max(float(np.abs(c.mv - before).max()) for c in taken) < 1e-9
    loop.set_mv(loop.mv_wanted + np.array([0.0, moved]))
    run(loop, plant, 40)
    assert loop.mv[1] == pytest.approx(before[1] + moved, abs=1e-12)
    before = loop.mv
    loop.set_operate({"u1.use": 1.0})
    assert max(float(np.abs(c.mv - before).max()) for c in run(loop, plant, 20)) < 1e-9


def test_a_valve_on_its_way_stops_where_it_is_when_it_is_taken_in_hand(operated: Controller) -> None:
    loop = loop_of(operated, sp=[400.0, 5.0])
    assert loop.scan(sample(valve=40.0)).mv[0] == 45.0
    loop.set_operate({"valve.use": 0.0})
    assert loop.scan(sample(valve=41.0)).mv[0] == 41.0  # four percent short of its command
    assert loop.scan(sample(valve=41.5)).mv[0] == 41.0


def test_a_fault_and_its_fallback_leave_an_mv_in_hand_alone(slow_mvs: Controller, predictive_model: Any) -> None:
    plant = ActuatedPlant(predictive_model)
    fallback = Fallback(0.0, (0.5, 0.5), (1.0, 1.0))
    loop = steered(slow_mvs, operate={"u1.use": 0.0}, fallback=fallback, recover_after=2)
    run(loop, plant, 3)
    loop.set_mv([loop.mv_wanted[0], -0.25])
    for _ in range(8):
        plant.write(loop.miss("nothing is read").mv)
    assert loop.mode is Mode.HOLD
    assert loop.mv.tolist() == pytest.approx([0.5, -0.25], abs=0.2)
    assert loop.mv[1] == -0.25
    assert run(loop, plant, 3)[-1].mode is Mode.AUTO
    assert loop.mv[1] == -0.25


# ------------------------------------------------------------------------------------------------ the plant has it
def test_a_local_mv_is_out_by_itself_and_back_when_the_plant_gives_it_back(operated: Controller) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    command = loop.scan(sample(t=290.0, local="LOCAL"))
    assert dict(command.local) == {"valve": "LOCAL"}
    assert loop.local == {"valve": "LOCAL"}
    assert Given.of(operated.manifest, command.info).operate["valve.use"] == 0.0
    assert command.mv[0] == 40.0
    command = loop.scan(sample(t=290.0, valve=70.0, local="LOCAL"))  # its operator there moves it
    assert command.mv[0] == 70.0
    with pytest.raises(LoopError, match="valve"):
        loop.require_in_hand(["valve"])
    command = loop.scan(sample(t=290.0, valve=70.0))
    assert dict(command.local) == {}
    assert command.mv[0] == 70.0 + FASTEST
    assert dict(zip([e.name for e in operated.manifest.operate], loop.operate, strict=True))["valve.use"] == 1.0


def test_one_that_an_operator_has_in_hand_stays_there_when_the_plant_gives_it_back(operated: Controller) -> None:
    loop = loop_of(operated, operate={"valve.use": 0.0})
    for local in ("", "LOCAL", "LOCAL", "", ""):
        command = loop.scan(sample(t=290.0, valve=44.0 if local else loop.mv[0], local=local))
    assert command.mv[0] == 44.0
    assert Given.of(operated.manifest, command.info).operate["valve.use"] == 0.0


@pytest.mark.parametrize("valve", [NAN, 120.0, -30.0], ids=str)
def test_a_bad_read_back_takes_its_mv_out_and_leaves_its_command(operated: Controller, valve: float) -> None:
    loop = loop_of(operated)
    loop.scan(sample(valve=39.0))
    last = float(loop.scan(sample(valve=39.0)).mv[0])
    command = loop.scan(sample(t=290.0, valve=valve))
    assert (command.mode, list(command.local)) == (Mode.AUTO, ["valve"])
    assert command.mv[0] == last
    assert command.law_mv is not None
    assert not loop.scan(sample(valve=39.0)).local


def test_hold_once_the_plant_has_every_mv(slow_mvs: Controller, predictive_model: Any) -> None:
    plant, loop = ActuatedPlant(predictive_model), steered(slow_mvs, recover_after=2)
    run(loop, plant, 3)
    plant.local[:] = True, False
    assert run(loop, plant, 2)[-1].mode is Mode.AUTO
    plant.local[:] = True
    command = run(loop, plant, 1)[-1]
    assert command.mode is Mode.HOLD
    assert "u0" in command.fault or "in local" in command.fault
    plant.by_plant(1, -0.4)
    assert run(loop, plant, 1)[-1].mv[1] == -0.4
    plant.local[:] = False, True
    assert [c.mode for c in run(loop, plant, 2)] == [Mode.HOLD, Mode.AUTO]
    loop.set_operate({"u0.use": 0.0})
    assert run(loop, plant, 1)[-1].mode is Mode.HOLD  # the one in use is the plant's
    loop.set_mode(Mode.AUTO)
    plant.local[:] = False
    assert run(loop, plant, 1)[-1].mode is Mode.AUTO
    loop.set_operate({"u1.use": 0.0})
    assert run(loop, plant, 1)[-1].mode is Mode.AUTO  # both are in hand: that is the operator's word


@pytest.mark.parametrize("moved", [0.0, 0.02, -0.35], ids=str)
def test_local_and_back_at_rest_is_no_bump(slow_mvs: Controller, predictive_model: Any, moved: float) -> None:
    loose = {"y0.track": 0.0, "y1.track": 0.0}
    plant, loop = ActuatedPlant(predictive_model), steered(slow_mvs, operate=loose)
    plant.offset[:] = 0.011, -0.007
    run(loop, plant, 40)
    before = loop.mv
    plant.local[1] = True
    assert max(float(np.abs(c.mv - before).max()) for c in run(loop, plant, 3)) < 1e-9
    plant.by_plant(1, float(before[1]) + moved)
    run(loop, plant, 40)
    assert loop.mv[1] == pytest.approx(before[1] + moved, abs=1e-9)  # its offset is known
    before = loop.mv
    plant.local[1] = False
    assert max(float(np.abs(c.mv - before).max()) for c in run(loop, plant, 20)) < 1e-9


def test_the_others_make_up_for_what_the_plant_does(slow_mvs: Controller, predictive_model: Any) -> None:
    """The second output is left alone, so that one MV is enough for the first."""
    plant, loop = ActuatedPlant(predictive_model), steered(slow_mvs, operate={"y1.track": 0.0})
    run(loop, plant, 60)
    plant.local[1] = True
    plant.by_plant(1, float(plant.mv[1]) + 0.1)
    last = run(loop, plant, 150)[-1]
    assert last.mode is Mode.AUTO
    assert abs(plant.sample().pv[0] - 0.2) < 0.02


# ------------------------------------------------------------------------------------------------ as a shadow ends
@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.HOLD, Mode.AUTO])
@pytest.mark.parametrize("bad", [np.nan, 5.0])
def test_one_bad_read_back_as_a_shadow_ends_writes_no_old_mv(slow_mvs: Controller, mode: Mode, bad: float) -> None:
    """Others moved both MVs since the last scan; the last good read-back of the second is old."""
    loop = ControlLoop(slow_mvs, sp=[0.2, -0.1], mode=Mode.SHADOW)
    loop.scan(Sample(np.zeros(2), np.array([0.1, 0.1])))
    loop.set_mode(mode)
    assert not loop.scan(Sample(np.zeros(2), np.array([0.3, bad]))).writes
    after = loop.scan(Sample(np.zeros(2), np.array([0.3, 0.3])))
    assert after.writes
    assert np.abs(after.mv - 0.3).max() <= MOST + 1e-12


def test_one_mv_sent_by_hand_as_a_shadow_ends_leaves_the_other_where_it_is_read_back(slow_mvs: Controller) -> None:
    loop = ControlLoop(slow_mvs, sp=[0.2, -0.1], mode=Mode.SHADOW, operate={"u0.use": 0.0})
    loop.scan(Sample(np.zeros(2), np.array([0.1, 0.1])))
    loop.set_mode(Mode.HOLD)
    loop.set_mv([0.15, 0.1])
    command = loop.scan(Sample(np.zeros(2), np.array([0.3, 0.4])))  # others have moved both
    np.testing.assert_allclose(command.mv, [0.2, 0.4])  # the first goes on from there, by its largest move


# --------------------------------------------------------------------------------------------------- elsewhere too long
def test_a_stuck_actuator_is_out_after_a_while_until_an_operator_trusts_it(operated: Controller) -> None:
    loop = loop_of(operated, local_s=6.0)
    counts = []
    for k in range(40):
        command = loop.scan(sample(t=290.0))  # ten below its set point, and the valve stays at 40
        counts.append(bool(command.local))
        assert command.mode is Mode.AUTO
        if k == 20:
            assert list(command.local) == ["valve"]
            assert command.mv[0] == 40.0
            loop.set_operate({"valve.use": 1.0})
            counts.clear()
    assert counts.index(True) in range(5, 9)  # and again
    assert all(counts[counts.index(True) :])
    loop.set_mode(Mode.MANUAL)
    loop.set_mv([40.0, 0.5])
    assert not loop.scan(sample()).local


def test_a_small_step_of_the_law_finds_a_stuck_actuator_too(slow_mvs: Controller, predictive_model: Any) -> None:
    """Its moves are below the margin of read-backs, and it begins anew from the read-back once they are above it."""
    plant = ActuatedPlant(predictive_model)
    loop = steered(slow_mvs, sp=[1.0, -1.0], operate={"u1.max_move": 0.015, "u0.max_move": 0.015})
    plant.stuck[1] = True
    found = [bool(c.local) for c in run(loop, plant, 300)]
    assert found.index(True) in range(30, 250)


@pytest.mark.parametrize("most", [0.004, 0.02], ids=str)
def test_an_actuator_that_is_slow_or_noisy_is_the_loops(
    slow_mvs: Controller, predictive_model: Any, most: float
) -> None:
    plant, loop = ActuatedPlant(predictive_model, 0.02), steered(slow_mvs)
    rng = np.random.default_rng(3)
    for k in range(400):
        if k % 50 == 0:
            loop.set_sp(rng.uniform(-0.8, 0.8, 2))
        plant.offset = rng.normal(0.0, 0.001, 2)
        command = loop.scan(plant.sample())
        assert not command.local
        plant.write(plant.mv + np.clip(command.mv - plant.mv, -most, most))


def test_a_plant_that_reads_nothing_back_is_never_elsewhere(operated: Controller) -> None:
    loop = loop_of(operated, operate={"valve.use": 0.0})
    loop.set_mv([47.0, 0.5])
    course = [
        float(loop.scan(Sample(np.array([290.0, 5.0, 0.5]), None, local=("LOCAL" if 3 < k < 6 else "", ""))).mv[0])
        for k in range(8)
    ]
    assert course == [47.0] * 8


def test_texts_that_are_none_are_a_fault(operated: Controller) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    bad: Any = ("LOCAL",)
    assert loop.scan(Sample(np.array([300.0, 5.0, 0.5]), np.array([40.0, 0.5]), local=bad)).mode is Mode.HOLD


@pytest.mark.parametrize("local_s", [-1.0, float("inf"), NAN], ids=str)
def test_a_time_that_is_none_is_refused(operated: Controller, local_s: float) -> None:
    with pytest.raises(LoopError, match="local_s"):
        loop_of(operated, local_s=local_s)


# ---------------------------------------------------------------------------------------------------- whatever happens
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_no_mv_leaves_its_range_or_is_faster_and_none_in_hand_moves_but_by_its_operator(
    slow_mvs: Controller, predictive_model: Any, data: st.DataObject
) -> None:
    plant = ActuatedPlant(predictive_model, 0.01, data.draw(st.integers(0, 99)))
    plant.offset = np.array(data.draw(st.lists(st.sampled_from([0.0, 0.02, -0.03]), min_size=2, max_size=2)))
    loop = steered(slow_mvs, bridge_s=3.0, local_s=8.0, recover_after=2, fallback=Fallback(4.0, (0.3, 0.3), (1.0, 1.0)))
    last, goals = loop.mv, loop.mv
    events = ["use", "hand", "local", "plant", "blind", "stuck", "mode", "sp", "lost", "miss", "pv", "none", "none"]
    for _ in range(data.draw(st.integers(5, 25))):
        event, i = data.draw(st.sampled_from(events)), data.draw(st.integers(0, 1))
        value = data.draw(st.floats(-1.0, 1.0))
        name = f"u{i}"
        if event == "use":
            loop.set_operate({f"{name}.use": float(value > 0)})
        elif event == "hand":
            try:
                loop.set_mv([value if k == i else w for k, w in enumerate(loop.mv_wanted)])
            except LoopError:
                assert loop.mode is Mode.SHADOW or name in loop.local or named(loop)[f"{name}.use"] or lost(loop)
        elif event in {"local", "blind", "stuck"}:
            getattr(plant, event)[i] = value > 0
        elif event == "plant" and plant.local[i]:
            plant.by_plant(i, value)
        elif event == "mode":
            mode = data.draw(st.sampled_from([Mode.AUTO, Mode.AUTO, Mode.MANUAL]))
            loop.set_mode(mode)
        elif event == "sp":
            loop.set_sp([value, -value])
        for _ in range(data.draw(st.integers(1, 6))):
            stood, hands = plant.mv.copy(), [not named(loop)[f"u{k}.use"] for k in range(2)]
            mode, goals, was = loop.mode, loop.mv_wanted, loop.mv
            seen = plant.sample()
            if event == "pv":
                seen.pv[i] = NAN
            command = loop.miss("nothing is read") if event == "miss" else loop.scan(seen)
            if event == "lost":
                command = loop.unwritten(was, "the write failed")
            last = command.mv
            if np.isnan(last).any():
                continue  # nothing is written
            for k in range(2):
                assert -1.0 <= last[k] <= 1.0
                read = stood[k] + plant.offset[k]
                moved = min(abs(last[k] - was[k]), abs(last[k] - read), abs(last[k] - stood[k]))
                assert moved <= MOST + 1e-9
                if hands[k] and mode is not Mode.SHADOW and loop.found is None and f"u{k}" not in command.local:
                    nearer = abs(last[k] - goals[k]) <= abs(was[k] - goals[k]) + 1e-12
                    taken = abs(last[k] - read) <= 1e-9 or event == "lost"
                    assert nearer or taken
            if event != "lost":
                plant.write(last)


def named(loop: ControlLoop) -> dict[str, float]:
    return dict(zip([e.name for e in loop.controller.manifest.operate], loop.operate.tolist(), strict=True))


def lost(loop: ControlLoop) -> bool:
    return loop._mv.lost
