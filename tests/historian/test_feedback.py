"""Whether an MV follows a PV: loops that are closed, moves by hand, and plants that answer within their row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from closed_loop_records import LOOPS, OperatedLoop
from dirty_plant import START_S, screen, write

from loopwright.pipeline.historian.cleaning.row_grid import resampled
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.feedback import fed_back, follows
from loopwright.pipeline.historian.files.export import Series

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


@pytest.mark.parametrize("held", [30, 80])
def test_a_step_test_after_the_record_does_not_hide_its_controller(held: int) -> None:
    """In more than half of the rows the MV stands then; the controller of the others was taken for a hand."""
    y, u, _ = OperatedLoop(2.0, dead=3, kc=0.5, ti=10.0).rows(2_000, 1)
    by_hand = OperatedLoop(2.0, dead=3, kc=0.0, ti=10.0, dither=20.0, dither_rows=held)
    y_test, u_test, _ = by_hand.rows(2_600, 2)
    run = np.repeat([0, 1], [len(u), len(u_test)])
    both, seen = np.r_[u, u_test], np.r_[y, y_test]
    assert fed_back(both[:, None], seen[:, None], run)
    assert not fed_back(u_test[:, None], y_test[:, None], run[len(u) :])


@pytest.mark.parametrize("lost", [(0, 40), (700, 300), (2_300, 100), (0, 2_400)])
def test_rows_without_a_reading_end_a_run(lost: tuple[int, int]) -> None:
    """As in a file before it is cleaned: the command then ended in a solver's words."""
    y, u, _ = OperatedLoop(2.0, dead=3, kc=0.5, ti=10.0).rows(2_400, 1)
    for of in (y, u):
        spoilt = of.copy()
        spoilt[lost[0] : sum(lost)] = np.nan
        share, back = in_one_run(*((u, spoilt) if of is y else (spoilt, y)))
        assert (share > 0.95, back) == (lost[1] < 2_400, lost[1] < 2_400)


NOISY = OperatedLoop(1.0, lags=(60.0,), noise=1.0, kc=0.5, ti=60.0, hold=400)
"""Its controller answers the noise of single readings."""

TAGS = (Tag("TIC.PV", "pv", "degC"), Tag("TIC.OP", "mv", "%"))


def first_answers(y: Array, u: Array, rows: int) -> Array:
    """The step response (rows,) of a high-order ARX by least squares: y(k) from eight rows of y and twelve of u."""
    k = np.arange(12, len(y))
    own = [y[k - i] for i in range(1, 9)]
    a = np.linalg.lstsq(np.column_stack([*own, *(u[k - i] for i in range(1, 13)), np.ones(len(k))]), y[k])[0]
    step = np.zeros(rows)
    for t in range(1, rows):
        step[t] = sum(a[i - 1] * step[t - i] for i in range(1, min(t, 8) + 1)) + a[8 : 8 + min(t, 12)].sum()
    return step


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("readings", [4, 8])
def test_samples_show_how_the_plant_starts_where_means_turn_it_round(readings: int, seed: int) -> None:
    """A mean MV holds what the controller did because of the PV's noise within the row."""
    y, u, _ = NOISY.rows(30_000, seed)
    time_s, good = START_S + np.arange(30_000.0), np.zeros(30_000, np.uint8)
    series = [Series(tag, time_s, v, good) for tag, v in (("y", y), ("u", u))]
    truth = NOISY.answer(np.ones(10 * readings))[::readings]
    starts = {}
    for sampled in (False, True):
        grid, _ = resampled(series[:1], series[1:], float(readings), sampled=sampled)
        starts[sampled] = first_answers(grid.value["y"][2:-2], grid.value["u"][2:-2], 10) - truth
    assert starts[False][1] < -0.25
    assert np.abs(starts[True]).max() < 0.2


def test_the_readings_decide_what_means_of_them_hide(tmp_path: Path) -> None:
    """A user who followed the advice on --period was judged by free runs, and got a model that starts the wrong way."""
    y, u, _ = NOISY.rows(12_000, 0)
    rows = [[f"{START_S + k:.0f}", f"{y[k]:.6f}", f"{u[k]:.6f}"] for k in range(len(y))]
    path = write(tmp_path / "export.csv", rows, ("timestamp", *(t.tag for t in TAGS)))
    for period_s in (1.0, 4.0):
        record = screen(path, TAGS, period_s=period_s).record
        assert record.fed_back
        assert np.isin(record.pv[:, 0], np.round(y, 6)).all()
    means = [np.mean(v[: 11_996 + of].reshape(-1, 4), axis=1) for v, of in ((y[1:], 0), (u, 0))]
    assert not fed_back(means[1][1:, None], means[0][:-1, None], np.zeros(len(means[0]) - 1, dtype=np.int64))


def test_means_stay_means_where_nothing_acts_back(tmp_path: Path) -> None:
    loop = OperatedLoop(2.0, dead=3, kc=0.0, dither=20.0, dither_rows=30)
    y, u, _ = loop.rows(4_000, 0)
    rows = [[f"{START_S + k:.0f}", f"{y[k]:.6f}", f"{u[k]:.6f}"] for k in range(len(y))]
    path = write(tmp_path / "export.csv", rows, ("timestamp", *(t.tag for t in TAGS)))
    record = screen(path, TAGS, period_s=4.0).record
    assert not record.fed_back
    assert not np.isin(record.pv[:, 0], np.round(y, 6)).all()
