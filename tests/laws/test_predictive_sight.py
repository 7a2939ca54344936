"""A predictive law says where its horizon ends too early for its model, and is refused where it sees no answer."""

from __future__ import annotations

import numpy as np
import pytest
from identified_models import first_order, made_signals

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.predictive.horizon_check import STEP_SAMPLES, AnswerTimes
from loopwright.pipeline.laws.predictive.predictive import Predictive


def designed(pole: float, dead: int, horizon: int | None = None) -> Predictive:
    params = Predictive.Params(horizon=horizon, moves=3)
    return Predictive.design(params, {"identified": first_order(pole, dead=dead)}, made_signals(), None)


@pytest.mark.parametrize(("pole", "dead"), [(0.8, 0), (0.9, 5), (0.95, 0), (0.97, 0)])
def test_nothing_is_said_where_the_horizon_covers_the_answer(pole: float, dead: int) -> None:
    assert designed(pole, dead).analysis(None).notes == ()


@pytest.mark.parametrize(("pole", "dead", "horizon"), [(0.9, 0, 8), (0.97, 40, None), (0.985, 0, None)])
def test_a_short_horizon_is_said_in_the_report(pole: float, dead: int, horizon: int | None) -> None:
    law = designed(pole, dead, horizon)
    (note,) = law.analysis(None).notes
    assert f"looks {law.moves.horizon} samples ahead" in note
    assert f"answer after {dead + 1} " in note


def test_a_horizon_that_ends_before_the_first_answer_is_refused() -> None:
    with pytest.raises(LawError, match="looks 20 samples ahead, and a controlled variable answers only 31 samples"):
        designed(0.9, 30, 20)
    with pytest.raises(LawError, match="looks 50 samples ahead, and a controlled variable answers only 71 samples"):
        designed(0.9, 70)
    assert designed(0.9, 30, 31).analysis(None).notes


def test_the_first_answer_and_the_settling_are_those_of_the_model() -> None:
    sight = AnswerTimes.of(first_order(0.9, dead=7), lambda z: z, 1)
    assert sight.first == 8
    assert sight.settles == 7 + int(np.ceil(np.log(0.1) / np.log(0.9)))
    with pytest.raises(LawError, match=f"more than {STEP_SAMPLES} samples"):
        AnswerTimes(STEP_SAMPLES + 1, 0).require(50)
