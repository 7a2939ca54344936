"""Rests that a record shows: in open loop, in closed loop, of an integrator, and none."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.records.recorded_rests import MOST_RESTS, RecordedRest, rests_of
from loopwright.serving.manifest import Signal

Y, U, D = Signal("y", "m", -3.0, 3.0), Signal("u", "V", -1.0, 1.0), Signal("d", "l/s", 0.0, 10.0)
POLE, GAIN, SETTLING = 0.8, 2.0, 14  # 0.8^14 = 4 %
NOISE = 0.02


def made(mv: np.ndarray, *, dv: np.ndarray | None = None, load: np.ndarray | None = None, noise: float = NOISE,
         run: np.ndarray | None = None) -> Record:  # fmt: skip
    """A lag under MVs (n,), which disturbances (n,) and loads (n,) [V] move too."""
    rng, y = np.random.default_rng(3), np.zeros(len(mv))
    acting = mv + (0 if load is None else load) + (0 if dv is None else 0.1 * dv)
    y[0] = GAIN * acting[0]
    for k in range(len(mv) - 1):
        y[k + 1] = POLE * y[k] + (1 - POLE) * GAIN * acting[k]
    signals = Signals(1.0, (Y,), (Y,), () if dv is None else (D,), (U,))
    pv = (y + noise * rng.standard_normal(len(y)))[:, None]
    return Record.of(signals, pv, mv[:, None], dv=None if dv is None else dv[:, None], run=run)


def held(lengths: list[int], seed: int = 1) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-0.8, 0.8, len(lengths)), lengths)


def errors(found: tuple[RecordedRest, ...]) -> np.ndarray:
    """How far the levels are from a rest of the plant [m]."""
    return np.array([float(r.pv[0] - GAIN * r.mv[0]) for r in found])


def test_each_long_hold_of_an_open_record_ends_at_a_rest() -> None:
    lengths = [10, 40, 12, 40, 15, 40, 8, 40]
    mv = held(lengths)
    found = rests_of(made(mv), SETTLING)
    ends = np.cumsum(lengths)[1::2]
    assert [r.first + r.rows for r in found] == pytest.approx(ends.tolist(), abs=3)  # noise of the last rows
    assert [float(r.mv[0]) for r in found] == pytest.approx(mv[ends - 1])
    assert np.abs(errors(found)).max() < 0.03


def test_short_holds_have_no_rest() -> None:
    mv = np.repeat(np.tile([0.5, -0.5], 30), SETTLING)
    assert rests_of(made(mv), SETTLING) == ()


def test_a_record_shorter_than_a_settling_has_none() -> None:
    assert rests_of(made(held([SETTLING])), SETTLING) == ()


def test_a_loop_at_its_set_point_rests_though_its_mv_moves_in_every_row() -> None:
    """A PI holds the plant at set points in turn, the noise in its MV."""
    rng, n = np.random.default_rng(5), 900
    sp = np.repeat([0.5, -0.6, 1.0], n // 3)
    y, mv, pv, last = 0.0, np.zeros(n), np.zeros(n), 0.0
    for k in range(n):
        pv[k] = y + NOISE * rng.standard_normal()
        error = sp[k] - pv[k]
        mv[k] = np.clip((mv[k - 1] if k else 0.0) + 0.3 * (error - last) + 0.06 * error, -1, 1)
        last, y = error, POLE * y + (1 - POLE) * GAIN * mv[k]
    record = Record.of(Signals(1.0, (Y,), (Y,), (), (U,)), pv[:, None], mv[:, None])
    assert (np.diff(mv) != 0).all()
    found = rests_of(record, SETTLING)
    assert len(found) >= 3
    assert np.abs(errors(found)).max() < 0.05
    for level in (0.5, -0.6, 1.0):
        assert min(abs(float(r.pv[0]) - level) for r in found) < 0.03


def test_where_a_load_wanders_nothing_rests() -> None:
    """The MV follows it all the time."""
    n = 2_000
    load = 0.5 * np.sin(2 * np.pi * np.arange(n) / (4 * SETTLING))
    assert rests_of(made(-load, load=0.5 * load), SETTLING) == ()


def test_a_disturbance_that_moves_is_no_rest() -> None:
    mv, dv = held([60] * 8), np.zeros(480)
    whole = rests_of(made(mv, dv=dv), SETTLING)
    dv[100:] = np.random.default_rng(7).uniform(0, 10, 380)
    left = rests_of(made(mv, dv=dv), SETTLING)
    assert whole
    assert [r.first + r.rows <= 100 for r in left] == [True] * len(left)
    assert len(left) < len(whole)


def test_a_rest_reaches_over_no_gap() -> None:
    mv = np.r_[held([200]), held([200], seed=2)]
    run = np.repeat([0, 1], [210, 190])
    for r in rests_of(made(mv, run=run), SETTLING):
        assert len(set(run[r.first : r.first + r.rows])) == 1


@pytest.mark.parametrize("integrating", [(), (0,)])
def test_an_integrator_rests_where_its_mv_balances_it(integrating: tuple[int, ...]) -> None:
    """A slow rise shows over the whole stretch alone: a plant that settles would have no such one."""
    mv = np.r_[0.5, np.zeros(60), -0.5, np.zeros(60), np.full(120, 0.0005)]
    y = np.cumsum(np.r_[0.0, mv])[: len(mv)]
    record = Record.of(Signals(1.0, (Y,), (Y,), (), (U,)), y[:, None], mv[:, None])
    found = rests_of(record, 24, integrating)
    assert len(found) >= 2
    moving = [r for r in found if r.first > 122]
    assert bool(moving) is not bool(integrating)


def test_many_rests_are_thinned_evenly() -> None:
    record = made(held([40] * 200))
    found = rests_of(record, SETTLING)
    assert len(found) == MOST_RESTS
    firsts = np.array([r.first for r in found])
    assert (np.diff(firsts) > 0).all()
    assert firsts[0] < 400
    assert firsts[-1] > 7_500


def test_noise_alone_hides_no_rest() -> None:
    quiet, noisy = (rests_of(made(held([60] * 30), noise=s), SETTLING) for s in (0.0, 0.3))
    assert len(noisy) > 0.7 * len(quiet)
