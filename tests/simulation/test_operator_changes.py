"""Operators' changes over a test: values hold from their sample on, and what cannot be is refused by its name."""

from __future__ import annotations

import numpy as np
import pytest
from operated_law import ENTRIES

from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.simulation.operator_changes import OperatedCourse, OperatorChange
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.timetable import TimedValue, at_once


def scenario(*changes: OperatorChange) -> Scenario:
    return Scenario("t", "", np.zeros((6, 1)), np.zeros(1), np.zeros(1), operate=changes)


def test_values_hold_from_their_sample_on_and_defaults_before() -> None:
    late, early = OperatorChange(4, {"valve.high": 60.0}), OperatorChange(2, {"valve.high": 80.0, "T.use": 0.0})
    course = scenario(late, early).operated(ENTRIES)
    assert course is not None
    high = course.of_signal("valve", "high")
    assert high is not None
    assert high.tolist() == [100, 100, 80, 80, 60, 60]
    assert course.at("T", "use", 1.0) == 0.0
    assert course.at("T", "use", 1.0, sample=1) == 1.0
    assert course.at("T", "rank", 7.0) == 7.0  # this law has no ranks
    assert course.changed().tolist() == [2, 4]


def test_a_test_that_changes_nothing_has_no_course_and_its_digest_does_not_know_of_operate() -> None:
    assert scenario().operated(ENTRIES) is None
    first, other = (scenario(OperatorChange(1, {"speed": of})).digest() for of in (1.0, 2.0))
    assert len({scenario().digest(), first, other}) == 3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (OperatorChange(6, {"speed": 2.0}), "sample 6"),
        (OperatorChange(0, {"valve.hihg": 2.0}), "valve.high"),
        (OperatorChange(0, {"valve.low": 70.0, "valve.high": 60.0}), "valve.low"),
        (OperatorChange(0, {"T.use": 0.5}), "T.use"),
    ],
)
def test_a_change_that_cannot_be_names_the_test_and_the_entry(change: OperatorChange, said: str) -> None:
    with pytest.raises(ParamsError, match=r"^test 't'") as found:
        OperatedCourse.of(ENTRIES, [change], 6, "test 't'")
    assert said in str(found.value)


def test_one_entry_is_set_once_at_a_time() -> None:
    assert at_once([TimedValue(1.0, name="a"), TimedValue(2.0, name="b")]) == {"a": 1.0, "b": 2.0}
    with pytest.raises(ParamsError, match=r"sets a twice, to 1 and 2"):
        at_once([TimedValue(1.0, name="a"), TimedValue(2.0, name="a")])
