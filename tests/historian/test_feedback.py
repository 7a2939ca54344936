"""Whether an MV follows a PV: loops that are closed, moves by hand, and plants that answer within their row."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_records import LOOPS, OperatedLoop

from pipeline.historian.feedback import fed_back, follows

Array = np.ndarray


def in_one_run(u: Array, y: Array) -> tuple[float, bool]:
    run = np.zeros(len(u), dtype=np.int64)
    return follows(u, y, run), fed_back(u[:, None], y[:, None], run)


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("late", [False, True])
def test_every_closed_loop_is_seen(name: str, late: bool) -> None:
    record = LOOPS[name].record(2_400, 5, late=late)
    assert fed_back(record.mv, record.pv, record.run)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rows", [1, 30])
def test_moves_by_hand_are_no_feedback(rows: int, seed: int) -> None:
    loop = OperatedLoop(2.0, dead=3, kc=0.0, ti=10.0, dither=20.0, dither_rows=rows)
    y, u, _ = loop.rows(2_400, seed)
    assert in_one_run(u, y) == (0.0, False)


@pytest.mark.parametrize("goes_on", [0.0, 0.9])
def test_an_answer_within_the_row_is_no_feedback(goes_on: float) -> None:
    rng = np.random.default_rng(0)
    u, y = np.zeros(3_000), np.zeros(3_000)
    for k in range(1, 3_000):
        u[k] = goes_on * u[k - 1] + rng.normal()
        y[k] = 0.8 * y[k - 1] - 2.0 * u[k] + 0.1 * rng.normal()
    share, back = in_one_run(u, y)
    assert share < 0.02
    assert not back


def test_a_controller_alone_explains_all_its_moves() -> None:
    y, u, _ = OperatedLoop(2.0, dead=3, kc=0.5, ti=10.0).rows(2_400, 1)
    share, back = in_one_run(u, y)
    assert share > 0.95
    assert back


@pytest.mark.parametrize("lost", [(0, 40), (700, 300), (2_300, 100), (0, 2_400)])
def test_rows_without_a_reading_end_a_run(lost: tuple[int, int]) -> None:
    """As in a file before it is cleaned: the command then ended in a solver's words."""
    y, u, _ = OperatedLoop(2.0, dead=3, kc=0.5, ti=10.0).rows(2_400, 1)
    for of in (y, u):
        spoilt = of.copy()
        spoilt[lost[0] : sum(lost)] = np.nan
        share, back = in_one_run(*((u, spoilt) if of is y else (spoilt, y)))
        assert (share > 0.95, back) == (lost[1] < 2_400, lost[1] < 2_400)
