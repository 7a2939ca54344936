"""A loop follows courses: set points at their times, forecasts for the law, and who ends them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.serving import Controller, ControlLoop, LoopError, Mode, Sample, VirtualClock
from loopwright.serving.preview import course
from loopwright.serving.preview.ahead import AheadInput
from loopwright.serving.preview.course import MOST_COURSE_POINTS, Courses
from loopwright.serving.preview.differences import Differences

pytest_plugins = ["small_laws", "operated_files", "course_files"]
N, PERIOD = 12, 1.0


def loop_of(controller: Controller, mode: Mode = Mode.AUTO, **options: Any) -> ControlLoop:
    return ControlLoop(controller, sp=[0.0, 0.0], mv=[0.0, 0.0], mode=mode, **options)


def sample(loop: ControlLoop, dv: float = 0.0) -> Sample:
    return Sample(pv=np.zeros(2), dv=np.array([dv]), mv_applied=loop.mv)


def sps(loop: ControlLoop, n: int) -> list[float]:
    """The first set point over so many scans."""
    return [float(loop.scan(sample(loop)).sp[0]) for _ in range(n)]


# ------------------------------------------------------------------------------------------------------- set points
def test_a_set_point_holds_each_value_until_the_next_one(previewing: Controller) -> None:
    loop = loop_of(previewing)
    loop.set_course({"y0": [(2, 1.0), (5, -0.5)]})
    assert sps(loop, 8) == [0, 0, 1, 1, 1, -0.5, -0.5, -0.5]
    assert loop.courses.left == {}


def test_a_set_point_may_run_straight_from_where_it_is(previewing: Controller) -> None:
    loop = loop_of(previewing)
    loop.set_course({"y0": [(4, 1.0), (6, 1.0)]}, straight=("y0",))
    np.testing.assert_allclose(sps(loop, 8), [0, 0.25, 0.5, 0.75, 1, 1, 1, 1])


def test_periods_without_a_scan_pass_for_a_course_too(previewing: Controller) -> None:
    loop = loop_of(previewing)
    loop.set_course({"y0": [(5, 1.0)]})
    loop.scan(sample(loop))
    loop.gap(2)
    loop.miss("the plant cannot be read")
    assert sps(loop, 2) == [0, 1]


def test_a_command_that_did_not_arrive_takes_no_second_period(previewing: Controller) -> None:
    loop = loop_of(previewing)
    loop.set_course({"y0": [(3, 1.0)]})
    before = loop.mv
    loop.scan(sample(loop))
    loop.unwritten(before, "the plant cannot be written")
    assert sps(loop, 3) == [0, 0, 1]


def test_a_course_goes_on_in_every_mode(previewing: Controller) -> None:
    loop = loop_of(previewing, Mode.MANUAL)
    loop.set_course({"y0": [(2, 1.0)]})
    assert sps(loop, 3) == [0, 0, 1]


def test_an_operators_set_point_ends_its_course_alone(previewing: Controller) -> None:
    loop = loop_of(previewing)
    loop.set_course({"y0": [(2, 1.0)], "y1": [(2, 1.0)], "d0": [(0, 0), (5, 0.5)]})
    assert loop.set_sp(loop.sp) == ()
    assert loop.set_sp([0.3, 0.0]) == ("y0",)
    assert sorted(loop.courses.left) == ["d0", "y1"]
    command = [loop.scan(sample(loop)) for _ in range(3)][-1]
    assert command.sp.tolist() == [0.3, 1.0]


def test_a_new_course_takes_the_place_of_the_old_one(previewing: Controller) -> None:
    loop = loop_of(previewing)
    loop.set_course({"y0": [(2, 1.0), (9, 2.0)]})
    loop.scan(sample(loop))
    loop.set_course({"y0": [(1, 0.5)]})
    assert sps(loop, 12) == [0] + [0.5] * 11


def test_the_end_of_a_course_is_told_once(previewing: Controller) -> None:
    loop, told = loop_of(previewing), []
    loop.set_course({"y0": [(2, 1.0)], "d0": [(0, 0), (3, 0.2)]})
    for _ in range(6):
        loop.scan(sample(loop))
        told.append(loop.courses.finished)
    assert told == [(), (), ("y0",), ("d0",), (), ()]


# ---------------------------------------------------------------------------------------------- what the law is given
def test_the_law_gets_what_is_to_come_by_its_input(previewing: Controller) -> None:
    """The loop's steps are those of the controller with the differences written down by hand."""
    loop, state, applied = loop_of(previewing), previewing.cold_state(), np.zeros(2)
    loop.set_course({"y1": [(4, 0.5)], "d0": [(0, 0.0), (3, 0.0), (7, 0.4)]})
    sp_at = lambda t: np.where(t >= 4, 0.5, 0.0)  # noqa: E731
    dv_at = lambda t: np.interp(t, [3, 7], [0.0, 0.4])  # noqa: E731
    for k in range(10):
        times = k + np.arange(1, N + 1)
        known = np.stack([np.zeros(N), sp_at(times) - sp_at(k), dv_at(times) - dv_at(k)], axis=1)
        measured = 0.1 * np.sin(k)  # off the forecast: the differences are those of the forecast
        sp = np.array([0.0, float(sp_at(k))])
        step = previewing.step(
            sp=sp, pv=np.zeros(2), dv=[measured], mv_applied=applied, state=state, ahead=known.ravel()
        )
        command = loop.scan(sample(loop, measured))
        np.testing.assert_allclose(command.mv, step.mv, atol=1e-12)
        state, applied = step.state, command.mv


def test_nothing_is_given_where_nothing_is_to_come(previewing: Controller) -> None:
    plain, ended = loop_of(previewing), loop_of(previewing)
    ended.set_course({"y0": [(9, 1.0)]})
    ended.courses.end(["y0"])
    for k in range(4):
        one, other = (loop.scan(sample(loop, 0.1 * k)) for loop in (plain, ended))
        assert one.mv.tobytes() == other.mv.tobytes()


def test_a_forecast_beyond_the_range_of_a_reading_that_is_off_is_cut_there(previewing: Controller) -> None:
    loop = loop_of(previewing)
    loop.set_course({"d0": [(0, 0.0), (3, 1.0)]})
    command = loop.scan(sample(loop, 0.5))  # by the forecast it would be 1.5
    assert not command.fault
    found = loop.courses.ahead(previewing.manifest, np.zeros(2), np.array([0.5]))
    assert found is not None
    assert found.reshape(N, 3)[:, 2].max() == 0.5


def test_a_forecast_begins_at_what_is_measured(previewing: Controller) -> None:
    courses = Courses(previewing.manifest)
    courses.give({"d0": [(4, 0.8), (9, 0.8)]})
    found = courses.ahead(previewing.manifest, np.zeros(2), np.array([0.4]))
    assert found is not None
    np.testing.assert_allclose(found.reshape(N, 3)[:5, 2], [0.1, 0.2, 0.3, 0.4, 0.4])


def test_another_controller_gets_its_own_horizon(previewing: Controller, operated_previewing: Controller) -> None:
    loop = loop_of(previewing)
    loop.set_course({"y0": [(14, 1.0)], "d0": [(0, 0.0), (40, 0.9)]})
    loop.swap(operated_previewing, 2)
    commands = [loop.scan(sample(loop)) for _ in range(6)]
    assert loop.controller is operated_previewing
    assert not any(c.fault for c in commands)
    known = loop.courses.ahead(operated_previewing.manifest, np.zeros(2), np.zeros(1))
    assert known is not None
    assert known.shape == (45,)
    assert known[-3] == 1.0


def test_the_ranges_of_a_laws_input_are_looked_up_once_and_not_at_each_scan(
    previewing: Controller, operated_previewing: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[AheadInput] = []

    class Counted(Differences):
        def __init__(self, ahead: AheadInput) -> None:
            made.append(ahead)
            super().__init__(ahead)

    monkeypatch.setattr(course, "Differences", Counted)
    loop = loop_of(previewing)
    loop.set_course({"y1": [(90, 1.0)]})
    sps(loop, 5)
    assert [of.horizon for of in made] == [12]
    loop.swap(operated_previewing, 3)  # both laws are stepped
    sps(loop, 9)
    assert loop.controller is operated_previewing
    assert [of.horizon for of in made] == [12, 15]


# --------------------------------------------------------------------------------------------------------- refusals
@pytest.mark.parametrize(
    "wrong",
    [
        {},
        [("y0", 1)],
        {"y7": [(0, 1.0)]},
        {"u0": [(0, 0.1)]},
        {"y0": []},
        {"y0": "12"},
        {"y0": 5},
        {"y0": [(0, 1.0, 2.0)]},
        {"y0": [0, 1]},
        {"y0": [(0, "1")]},
        {"y0": [(0, True)]},
        {"y0": [(0, float("nan"))]},
        {"y0": [(float("inf"), 0.0)]},
        {"y0": [(5, 0.0), (4, 0.0)]},
        {"y0": [(0, 3.1)]},
        {"d0": [(0, 0.0), (5, -1.1)]},
        {"y0": [(-5, 0.0), (-1, 1.0)]},
        {"y0": [(k, 0.0) for k in range(MOST_COURSE_POINTS + 1)]},
    ],
)
def test_a_course_that_cannot_be_is_refused_and_changes_nothing(previewing: Controller, wrong: Any) -> None:
    loop = loop_of(previewing)
    loop.set_course({"y1": [(3, 1.0)]})
    with pytest.raises(LoopError) as error:
        loop.set_course({**wrong, "y1": [(1, 0.0)]} if isinstance(wrong, dict) and wrong else wrong)
    assert "\n" not in str(error.value)
    assert loop.courses.left == {"y1": [(3.0, 1.0)]}


def test_only_a_signal_with_a_course_can_run_straight(previewing: Controller) -> None:
    with pytest.raises(LoopError, match="y1"):
        loop_of(previewing).set_course({"y0": [(0, 1.0)]}, straight=("y1",))


def test_a_law_that_does_not_read_it_takes_no_course(operated: Controller) -> None:
    loop = ControlLoop(operated, sp=[300.0, 5.0], mv=[50.0, 0.0])
    with pytest.raises(LoopError, match="ahead"):
        loop.set_course({"T": [(0, 310.0)]})


def test_a_run_follows_it_on_its_clock(previewing: Controller) -> None:
    class Plant:
        mv = np.zeros(2)

        def read(self) -> Sample:
            return Sample(pv=np.zeros(2), dv=np.zeros(1), mv_applied=self.mv)

        def write(self, mv: np.ndarray) -> None:
            self.mv = mv

    loop, seen = ControlLoop(previewing, Plant(), sp=[0, 0], mv=[0, 0], mode=Mode.AUTO, clock=VirtualClock()), []
    loop.set_course({"y0": [(3, 1.0)]})
    loop.run(6, observe=lambda _, command: seen.append(float(command.sp[0])))
    assert seen == [0, 0, 0, 1, 1, 1]
