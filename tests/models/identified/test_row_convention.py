"""In which row an MV acts: offered where moves go with innovations, refused where feedback looks the same."""

from __future__ import annotations

import made_plants
import numpy as np

from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales, may_act_in_its_row
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.records.record import Record

FAST = 0.6  # share of the way to rest that the output goes in a period


def first_order(n: int = 1500, late: bool = False, seed: int = 0) -> Record:
    """y+ = y + .6 (.5 u - y); with ``late`` the row holds the MV that acted before it."""
    rng = np.random.default_rng(seed)
    u = made_plants.random_holds(rng, n + 1, 12)
    y = np.empty(n + 1)
    x = 0.5 * u[0]
    for k in range(n + 1):
        y[k] = x
        x += FAST * (0.5 * u[k] - x)
    y += 0.3 * rng.normal(size=n + 1)
    y, u = (y[1:], u[:-1]) if late else (y[:-1], u[:-1])
    return Record.of(made_plants.signals_of(1, 1), y[:, None], u[:, None])


def offered(record: Record) -> bool:
    return may_act_in_its_row(ScaledRecord.of(record, Scales.of(record, 1)), 1)


def test_only_a_record_with_late_mvs_offers_it() -> None:
    assert offered(first_order(late=True))
    assert not offered(first_order(late=False))


def test_feedback_is_not_taken_for_it() -> None:
    # u(k) answers y(k) at once: moves go with the innovations of their own row, and of the rows before.
    assert not offered(made_plants.closed_loop(2000))
    assert not offered(made_plants.integrator(2000))


def test_the_held_out_error_chooses_it_and_the_gain_is_right() -> None:
    source = Source(first_order(late=True), made_plants.signals_of(1, 1))
    learnt = IdentifiedPart(orders=(1, 2), units=()).learn(source)
    structure = learnt.metrics["structure"]
    assert structure["same_row"] is True
    assert structure["row_convention"] == "the MVs of a row act on the outputs of the same row"
    assert abs(learnt.metrics["gains"]["y0"]["u0"]["gain"] - 0.5) < 0.01
    assert learnt.metrics["free_run_rmse"] < 1.1 * 0.3


def test_the_usual_convention_is_told_too() -> None:
    learnt = IdentifiedPart(orders=(1, 2), units=()).learn(Source(first_order(), made_plants.signals_of(1, 1)))
    assert learnt.metrics["structure"]["same_row"] is False
    assert learnt.metrics["structure"]["row_convention"].endswith("of the next row")
