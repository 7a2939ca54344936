"""One-step predictions: they find how a PV answers in a closed loop, and say where the record cannot tell."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from closed_loop_records import OperatedLoop

from loopwright.pipeline.historian.answers import DirectModel, blocks_to

MOVED = {
    "positive": OperatedLoop(gain=2.0, dead=3, kc=0.5, ti=10.0, hold=100),
    "negative": OperatedLoop(gain=-2.0, dead=3, kc=0.5, ti=10.0, hold=100),
    "oscillating": OperatedLoop(gain=2.0, dead=3, kc=1.6, ti=10.0, hold=200),
    "two lags": OperatedLoop(gain=-1.0, lags=(30.0, 15.0), dead=2, kc=1.5, ti=30.0, hold=300),
    "a level": OperatedLoop(gain=-0.1, lags=(3.0,), dead=2, level=True, kc=1.0, ti=40.0, hold=200),
    "dither": OperatedLoop(gain=2.0, dead=3, kc=0.5, ti=10.0, dither=4.0),
}


def found(loop: OperatedLoop, seed: int = 5) -> tuple[float, float]:
    """Answer 15 to 25 rows after a step of 1 %, and its standard deviation."""
    record = loop.record(2_400, seed)
    model = DirectModel.of(record.pv[:, 0], record.mv, record.run)
    assert model is not None
    return model.answer(0, 15, 25)


def true_answer(loop: OperatedLoop) -> float:
    """The same of the plant alone."""
    step = np.where(np.arange(60) >= 30, 1.0, 0.0)
    return float(loop.answer(step)[30 + 15 : 30 + 26].mean())


@pytest.mark.parametrize("loop", MOVED.values(), ids=MOVED.keys())
def test_the_answer_is_found_in_a_loop_whose_mv_moves_of_its_own(loop: OperatedLoop) -> None:
    value, sd = found(loop)
    true = true_answer(loop)
    assert value * true > 0
    assert abs(value) > 3 * sd
    assert abs(value - true) < 4 * sd


@pytest.mark.parametrize("gain", [2.0, -2.0])
@pytest.mark.parametrize("kc", [0.5, 2.0], ids=["calm", "oscillating"])
def test_nothing_is_found_where_the_mv_only_follows_the_pv(gain: float, kc: float) -> None:
    value, sd = found(OperatedLoop(gain=gain, dead=3, kc=kc, ti=10.0))
    assert abs(value) < sd


def test_a_record_without_feedback_gives_a_sharp_answer() -> None:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0, 1, 100), 20)[:, None]
    y = np.zeros(2_000)
    for k in range(1_999):
        y[k + 1] = 0.8 * y[k] + 0.2 * 3.0 * u[k, 0] + rng.normal(0, 0.01)
    model = DirectModel.of(y, u, np.zeros(2_000, dtype=np.int64))
    assert model is not None
    value, sd = model.answer(0, 1, 1)
    assert value == pytest.approx(0.6, abs=4 * sd)
    assert sd < 0.02
    assert model.sd == pytest.approx(0.01, rel=0.1)


def test_too_few_rows_give_no_model() -> None:
    record = MOVED["positive"].record(80)
    assert DirectModel.of(record.pv[:, 0], record.mv, record.run) is None
    assert DirectModel.of(record.pv[:, 0], record.mv, np.arange(80)) is None  # no two rows of a run


def test_blocks_follow_each_other_without_a_gap() -> None:
    for longest in (10, 40, 97, 160):
        blocks = blocks_to(longest)
        assert blocks[0] == (0, 1)
        assert blocks[-1][1] == longest
        assert all(a[1] == b[0] for a, b in pairwise(blocks))
