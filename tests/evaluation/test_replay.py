"""Replay of a law over a record: what it is given, where it starts afresh, and the figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.evaluation.open_loop import UNSEEN, replay
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import Signal

Y, U = Signal("y", "m", 0.0, 10.0), Signal("u", "V", -1.0, 1.0)
SIGNALS = Signals(2.0, (Y,), (Y,), (), (U,))
N = 100


@dataclass
class Law:
    """Asks for what was applied and more; refuses one row; counts its own steps in its state."""

    refuses: float = np.nan
    more: float = 0.1
    given: list[dict[str, np.ndarray]] = field(default_factory=list)

    def cold_state(self) -> np.ndarray:
        return np.zeros(1)

    def step(self, **inputs: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self.given.append(inputs)
        if inputs["pv"][0] == self.refuses:
            raise LoopwrightError("no")
        return inputs["mv_applied"] + self.more, inputs["state"] + 1, np.zeros(0)


def record(runs: tuple[int, ...] = (N,)) -> Record:
    rng = np.random.default_rng(0)
    run = np.repeat(np.arange(len(runs))[::-1], runs)  # numbers need not grow
    return Record.of(SIGNALS, np.arange(N, dtype=float)[:, None] / 10, rng.uniform(-0.8, 0.8, (N, 1)), run=run)


def test_a_law_meets_the_last_rows_with_what_was_applied_before() -> None:
    law, data = Law(), record()
    found = replay(law, data, SIGNALS, ahead=5)
    assert len(found.time_s) == UNSEEN * N
    np.testing.assert_allclose(np.diff(found.time_s), 2.0)
    applied = np.array([given["mv_applied"] for given in law.given])
    np.testing.assert_allclose(applied[1:], data.mv[N - 20 : N - 1])
    np.testing.assert_allclose(found.asked, applied + 0.1)
    np.testing.assert_allclose(found.done, data.mv[-20:])
    assert [given["state"][0] for given in law.given] == list(range(20))


def test_the_set_point_is_where_the_operation_went() -> None:
    found = replay(Law(), record(), SIGNALS, ahead=5)
    np.testing.assert_allclose(found.sp[:10], found.pv[:10] + 0.2)
    assert found.sp[-1] == found.pv[-1]


def test_a_gap_begins_afresh_and_no_set_point_looks_across_it() -> None:
    law = Law()
    found = replay(law, record((90, 10)), SIGNALS, ahead=5)
    assert [given["state"][0] for given in law.given] == [*range(10), *range(10)]
    assert found.sp[9] == found.pv[9]
    np.testing.assert_allclose(law.given[10]["mv_applied"], found.done[10])


def test_a_refused_row_is_a_gap_and_counts() -> None:
    found = replay(Law(refuses=8.5), record(), SIGNALS, ahead=5)
    assert np.flatnonzero(np.isnan(found.asked[:, 0])).tolist() == [5]
    assert found.figures(record().mv_signals)["u"]["refused"] == pytest.approx(5.0)


def test_the_figures_count_in_shares_of_the_range() -> None:
    data = record()
    found = replay(Law(), data, SIGNALS, ahead=5)
    row = found.figures(data.mv_signals)["u"]
    asked, done = found.asked[:, 0], found.done[:, 0]
    assert row["distance"] == pytest.approx(50 * np.abs(asked - done).mean())
    assert row["more"] == pytest.approx(50 * (asked - done).mean())
    assert row["correlation"] == pytest.approx(np.corrcoef(asked, done)[0, 1])
    assert row["at_end"] == row["refused"] == 0
    assert replay(Law(more=5.0), data, SIGNALS, ahead=5).figures(data.mv_signals)["u"]["at_end"] == 100


@dataclass
class Velocity:
    """Moves the applied MV by the error and by its change."""

    def cold_state(self) -> np.ndarray:
        return np.zeros(2)

    def step(self, **inputs: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        started, last = inputs["state"]
        error = inputs["sp"][0] - inputs["pv"][0]
        move = 0.3 * error + 0.5 * (error - last) * started
        return inputs["mv_applied"] + move, np.array([1.0, error]), np.zeros(0)


def operation(same_row: bool) -> Record:
    """One operation of a lag in two runs; a logger stores the MV of a period with its first row, or with the next."""
    rng = np.random.default_rng(1)
    y, acting = np.zeros(N), rng.uniform(-0.8, 0.8, N)
    for k in range(1, N):
        y[k] = 0.8 * y[k - 1] + 0.5 * acting[k - 1]
    stored = np.roll(acting, 1) if same_row else acting
    return Record.of(SIGNALS, 5 + y[:, None], stored[:, None], run=np.repeat([0, 1], [88, 12]))


def test_an_operation_is_the_same_in_whichever_row_its_moves_stand() -> None:
    usual = replay(Velocity(), operation(False), SIGNALS, ahead=4)
    late = replay(Velocity(), operation(True), SIGNALS, ahead=4, same_row=True)
    kept = np.setdiff1d(np.arange(20), [7, 19])  # the last row of a run has no move in the late record
    np.testing.assert_array_equal(late.done, usual.done[kept])
    np.testing.assert_array_equal(late.sp, usual.sp[kept])
    np.testing.assert_array_equal(late.pv, usual.pv[kept])
    fresh = np.isin(kept, [0, 8])  # what acted before the first row stands in the late record alone
    np.testing.assert_array_equal(late.asked[~fresh], usual.asked[kept][~fresh])
    wrong = replay(Velocity(), operation(True), SIGNALS, ahead=4)
    assert np.abs(wrong.asked - usual.asked)[1:8].min() > 0


def test_a_late_record_knows_what_acted_before_its_first_row() -> None:
    law, data = Law(), operation(True)
    replay(law, data, SIGNALS, ahead=4, same_row=True)
    applied = np.array([given["mv_applied"] for given in law.given])
    np.testing.assert_array_equal(applied, data.mv[[*range(80, 87), *range(88, 99)]])


def test_a_record_that_is_too_short_says_so() -> None:
    short = Record.of(SIGNALS, np.zeros((3, 1)), np.zeros((3, 1)))
    with pytest.raises(RecordError, match="3 rows, too few to replay"):
        replay(Law(), short, SIGNALS, ahead=5)
