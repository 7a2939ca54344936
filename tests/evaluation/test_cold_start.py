"""Laws started cold at rests of a record: how far from the record's MVs they ask for, and which rests count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.evaluation.law_evidence import ColdStart
from loopwright.pipeline.evaluation.open_loop import COLD_STEPS, cold_start
from loopwright.pipeline.evaluation.poor_laws import far_at_a_rest
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.recorded_rests import RecordedRest
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import Signal

Y, Z = Signal("y", "m", 0.0, 10.0), Signal("z", "m", 0.0, 10.0)
U, V, D = Signal("u", "V", -1.0, 1.0), Signal("v", "%", 0.0, 100.0), Signal("d", "l/s", 0.0, 5.0)
ONE, TWO = Signals(1.0, (Y,), (Y,), (), (U,)), Signals(1.0, (Y, Z), (Y, Z), (D,), (U, V))


def rest(pv: list[float], mv: list[float], dv: tuple[float, ...] = ()) -> RecordedRest:
    return RecordedRest(0, 10, np.array(pv), np.array(mv), np.array(dv))


@dataclass
class Law:
    """A law in a function of its inputs and of the steps since it began."""

    asks: Callable[[int, dict[str, Any]], Any]

    def cold_state(self) -> np.ndarray:
        return np.zeros(1)

    def step(self, **inputs: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        k = int(inputs["state"][0])
        return np.asarray(self.asks(k, inputs)), inputs["state"] + 1, np.zeros(0)


def keeps(_: int, of: dict[str, Any]) -> Any:
    return of["mv_applied"] + 0.5 * (of["sp"] - of["pv"][: len(of["sp"])])


RESTS = (rest([2.0], [-0.5]), rest([4.0], [0.0]), rest([6.0], [0.5]))


def test_a_law_in_velocity_form_keeps_the_mv_of_each_rest() -> None:
    assert cold_start([Law(keeps)], RESTS, ONE) == ColdStart(3, 0.0, 0.0, 0.0, "u", {"y": 2.0, "u": -0.5})


def test_a_law_of_a_model_that_rests_elsewhere_is_as_far_off_as_its_constant() -> None:
    """y = 4 u + 4 in the record, y = 4 u + 2.4 in the model."""
    found = cold_start([Law(lambda _, of: (of["sp"] - 2.4) / 4)], RESTS, ONE)
    assert (found.first, found.later, found.quarter) == (pytest.approx(20.0),) * 3
    assert far_at_a_rest(found)
    assert not far_at_a_rest(cold_start([Law(lambda _, of: (of["sp"] - 3.8) / 4)], RESTS, ONE))


def test_a_law_that_is_off_where_its_record_ends_alone_is_told_and_not_withheld() -> None:
    """Its first rest of eight is 50 % of the range off."""
    rests = tuple(rest([2.0 + 0.5 * i], [-0.5 + 0.125 * i]) for i in range(8))
    bent = Law(lambda _, of: of["mv_applied"] + (of["sp"] <= 2.0))
    found = cold_start([bent], rests, ONE)
    assert found.farthest == pytest.approx(50.0)
    assert found.quarter == 0.0
    assert not far_at_a_rest(found)


def test_a_law_whose_mv_moves_by_little_a_period_shows_later_where_it_goes() -> None:
    found = cold_start([Law(lambda k, of: of["mv_applied"] + 0.04 * (k + 1))], RESTS, ONE)
    assert found.first == pytest.approx(2.0)
    assert found.later == pytest.approx(2.0 * COLD_STEPS)
    assert found.quarter == pytest.approx(found.later)
    assert far_at_a_rest(found)


def test_the_farthest_mv_and_its_rest_are_named_in_shares_of_its_range() -> None:
    rests = (rest([2.0, 3.0], [0.1, 40.0], (1.0,)), rest([5.0, 6.0], [0.2, 60.0], (2.0,)))
    more = {0: [0.02, 3.0], 1: [0.02, 1.0]}
    found = cold_start([Law(lambda k, of: of["mv_applied"] + more[min(k, 1)] * (of["dv"] - 1))], rests, TWO)
    assert found == ColdStart(
        2,
        pytest.approx(3.0),
        pytest.approx(1.0),
        pytest.approx(0.75),
        "v",
        {"y": 5.0, "z": 6.0, "u": 0.2, "v": 60.0, "d": 2.0},
    )


def test_the_worst_of_several_files_counts() -> None:
    off = Law(lambda _, of: of["mv_applied"] + 0.1)
    assert cold_start([Law(keeps), off], RESTS, ONE).first == pytest.approx(5.0)


def test_a_rest_outside_of_the_ranges_of_the_law_asks_nothing_of_it() -> None:
    narrow = replace(ONE, sp=(replace(Y, high=5.0),), mv=(replace(U, low=-0.2),))
    assert cold_start([Law(keeps)], RESTS, narrow).rests == 1


def test_an_mv_of_few_values_has_no_rest() -> None:
    valve = replace(ONE, mv=(replace(U, values=(-1.0, 0.0, 1.0)),))
    assert cold_start([Law(keeps)], RESTS, valve) == ColdStart(0)


def test_without_rests_nothing_is_said_against_a_law() -> None:
    found = cold_start([Law(keeps)], (), ONE)
    assert found == ColdStart(0)
    assert found.farthest is None
    assert not far_at_a_rest(found)
    assert not far_at_a_rest(None)


def test_a_law_that_refuses_a_rest_is_told() -> None:
    def refuses(_: int, of: dict[str, Any]) -> Any:
        if of["pv"][0] == 4.0:
            raise LoopwrightError("no")
        return of["mv_applied"]

    found = cold_start([Law(refuses)], RESTS, ONE)
    assert (found.rests, found.refused, found.first) == (3, 1, 0.0)
    assert far_at_a_rest(found)
    assert cold_start([Law(refuses)], RESTS[1:2], ONE) == ColdStart(1, refused=1)
