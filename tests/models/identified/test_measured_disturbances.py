"""Noise of measured disturbances is told from their own quick motion, and a fit takes their levels."""

from __future__ import annotations

from dataclasses import replace

import made_plants
import numpy as np
import pytest

from loopwright.pipeline.config.known import Known
from loopwright.pipeline.historian.stated_answers import beside_record
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.measured_disturbances import Disturbances, with_levels
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.records.record import Record

NOISE = 0.5


def disturbed(
    kind: str, rows: int = 3000, seed: int = 0, late: int = 0, pole: float = 0.78, answer: float = 1.0, run: int = 0
) -> Record:
    """A plant of one lag with a measured disturbance that walks, read with noise, or that moves quickly itself."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, rows // 40 + 1), 40)[:rows]
    quick, slow = rng.normal(size=rows), np.cumsum(0.1 * rng.normal(size=rows))
    switched = np.where(np.cumsum(rng.random(rows) < 0.3) % 2, 1.0, -1.0)
    felt, read = {
        "noisy": (slow, slow + NOISE * quick),
        "quick": (quick, quick),
        "both": (slow + quick, slow + quick),
        "switched": (switched, switched),
    }[kind]
    y, x = np.zeros(rows), np.zeros(2)
    for k in range(1, rows):
        x = x + (1 - pole) * (np.array([u[k - 1], answer * felt[max(k - 1 - late, 0)]]) - x)
        y[k] = x.sum() + 0.05 * rng.normal()
    runs = np.arange(rows) // run if run else None
    return Record.of(made_plants.signals_of(1, 1, 1), y[:, None], u[:, None], dv=read[:, None], run=runs)


def found(record: Record) -> Disturbances:
    data = ScaledRecord(record.pv / record.pv.std(), np.hstack([record.mv, record.dv]), record.run)
    return Disturbances.of(data, data, 1)


@pytest.mark.parametrize("late", [0, 25])
@pytest.mark.parametrize("rows", [600, 3000])
@pytest.mark.parametrize("kind", ["noisy", "quick", "both", "switched"])
@pytest.mark.parametrize("pole", [0.4, 0.78, 0.95])
def test_the_plant_tells_noise_from_quick_motion(kind: str, rows: int, late: int, pole: float) -> None:
    """Where a slow plant hides quick motion, fits take readings for what they are, or levels that do no harm."""
    record = disturbed(kind, rows, late=late, pole=pole)
    told = found(record)
    moves = np.sqrt(np.mean(np.diff(record.dv[:, 0]) ** 2))
    if kind == "noisy":
        assert told.noise == pytest.approx([NOISE], rel=0.2)
        assert told.sure[0] or rows == 600
    elif rows == 3000 or pole < 0.9:
        assert (told.noise[0], bool(told.sure[0])) == (0, False)
        assert told.change == pytest.approx([moves], rel=0.01)


@pytest.mark.parametrize("run", [40, 60, 75])
def test_short_runs_tell_too(run: int) -> None:
    """What they do not tell is left as it is read."""
    assert not found(disturbed("quick", 1500, run=run)).sure[0]
    assert found(disturbed("noisy", 1500, run=run)).noise == pytest.approx([NOISE], rel=0.2)


def test_what_the_plant_does_not_feel_keeps_its_noise_and_its_readings() -> None:
    told = found(disturbed("noisy", answer=0.0))
    assert told.noise == pytest.approx([NOISE], rel=0.2)
    late = found(disturbed("quick", late=70))
    assert not late.sure[0]


def test_a_reading_that_follows_the_output_foresees_nothing_of_it() -> None:
    """A fit may take a level of it, which knows later readings; what inputs foresee is told by earlier ones alone."""
    rng, rows = np.random.default_rng(0), 3000
    y, u, d = np.zeros(rows), np.zeros(rows), np.zeros(rows)
    x = load = integral = 0.0
    for k in range(rows - 1):
        integral -= 0.03 * y[k]
        u[k] = integral - 0.8 * y[k]
        load = 0.99 * load + 0.1 * rng.normal()
        x += 0.15 * (u[k] + load - x)
        y[k + 1] = x + 0.05 * rng.normal()
        d[k + 1] = d[k] + 0.4 * (x - d[k]) + 0.02 * rng.normal()
    signals, read = made_plants.signals_of(1, 1, 1), d + 0.15 * rng.normal(size=rows)
    record = Record.of(signals, y[:, None], u[:, None] / 10, dv=read[:, None])
    learnt = IdentifiedPart(units=(), orders=(2, 2), minutes=0.1).learn(Source(record, signals))
    assert learnt.metrics["proof"]["one_step"]["y0"]["nats"] < 5


def test_levels_stay_in_their_runs_and_leave_mvs_alone() -> None:
    record = disturbed("noisy", 200, run=100)
    data = ScaledRecord(record.pv, np.hstack([record.mv, record.dv]), record.run)
    sure = Disturbances(np.ones(1), np.ones(1), np.ones(1, dtype=bool))
    for way in (sure.smoothed, sure.followed):
        apart = [way(data.rows(slice(i, i + 100))).v for i in (0, 100)]
        assert np.array_equal(way(data).v, np.vstack(apart))
        assert np.array_equal(way(data).v[:, 0], data.v[:, 0])
        assert replace(sure, sure=np.zeros(1, dtype=bool)).smoothed(data) is data


def test_a_running_loop_knows_no_later_reading() -> None:
    record = disturbed("noisy", 300)
    data = ScaledRecord(record.pv, np.hstack([record.mv, record.dv]), record.run)
    sure = Disturbances(np.ones(1), np.ones(1), np.ones(1, dtype=bool))
    later = data.v.copy()
    later[200:, 1] += 5.0
    other = replace(data, v=later)
    assert np.array_equal(sure.followed(data).v[:200], sure.followed(other).v[:200])
    assert not np.array_equal(sure.smoothed(data).v[:200], sure.smoothed(other).v[:200])


@pytest.mark.parametrize(("kind", "noise"), [("noisy", NOISE), ("quick", 0.0)])
def test_the_model_takes_what_the_plant_tells(kind: str, noise: float) -> None:
    record = disturbed(kind, 2000)
    part = IdentifiedPart(units=(), orders=(2, 2), lagged=False, minutes=0.1)
    learnt = part.learn(Source(record, made_plants.signals_of(1, 1, 1)))
    assert learnt.metrics["gains"]["y0"]["d0"]["gain"] == pytest.approx(1.0, rel=0.03)
    assert learnt.metrics["disturbances"]["d0"]["noise_sd"] == pytest.approx(noise, rel=0.2)


def test_noise_makes_no_answer_too_small_that_a_statement_is_held_against() -> None:
    rng, rows = np.random.default_rng(1), 8000
    dv = np.zeros(rows)
    for k in range(1, rows):
        dv[k] = 0.95 * dv[k - 1] + 0.31 * rng.normal()
    u = np.repeat(rng.uniform(-1, 1, rows // 40), 40)
    y, x = np.zeros(rows), 0.0
    for k in range(1, rows):
        x += 0.2 * (u[k - 1] + dv[k - 1] - x)
        y[k] = x + 0.05 * rng.normal()
    signals = made_plants.signals_of(1, 1, 1)
    record = Record.of(signals, y[:, None], u[:, None], dv=(dv + rng.normal(size=rows))[:, None])
    said = [Known(pv="y0", input="d0", sign="+", gain=(0.9, 1.1))]
    (raw,), (levels,) = beside_record(said, record), beside_record(said, with_levels(record, 1))
    assert raw.answer is not None
    assert levels.answer is not None
    assert raw.answer[0] < 0.8 < levels.answer[0] == pytest.approx(1.0, abs=0.1)


def test_a_reading_that_goes_to_and_fro_has_a_change() -> None:
    record = disturbed("noisy", 300)
    alternating = replace(record, dv=(np.arange(300) % 2.0)[:, None])
    assert np.isfinite(with_levels(alternating, 1).dv).all()
