"""Gains that turn their sign or fade inside the range: told by region, and still refused where the record is none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import made_plants
import numpy as np
import pytest
from closed_loop_records import OperatedLoop

from loopwright.pipeline.evaluation.proof import sign_doubts, statements
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord
from loopwright.pipeline.models.identified.structure import Cells, alike, pieces
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.records.record import Record

PART = IdentifiedPart(orders=(2, 2), units=(6,), minutes=0.05)
ROWS = 2_000


def turning(u: float) -> float:
    """Highest at 55 %."""
    return 60 - 0.015 * (u - 55) ** 2


def fading(u: float) -> float:
    """The gain falls to a twentieth from 10 to 90 %."""
    return float(60 * (1 - np.exp(-0.0375 * u)))


def straight(u: float) -> float:
    return 0.6 * u


def test_cells_of_one_sign_are_put_together() -> None:
    assert alike(np.array([2.0, 1.0, 0.1, -1.0, -2.0])) == [slice(0, 2), slice(2, 3), slice(3, 5)]
    assert alike(np.array([3.0, 2.0, 0.5])) == [slice(0, 2), slice(2, 3)]
    assert alike(np.array([3.0, 2.0, 1.0])) == []


def test_pieces_sum_up_to_the_input() -> None:
    values = np.linspace(-2, 2, 9)
    found = pieces(values, [-1.0, 0.5])
    assert found.sum(axis=1) - values == pytest.approx(-0.5)
    assert np.ptp(found, axis=0) == pytest.approx([1.0, 1.5, 1.5])
    assert pieces(values, [])[:, 0] == pytest.approx(values)


def test_cells_show_the_answers_of_a_curve_over_them() -> None:
    """x+ = x/2 + tanh(v)/2 settles at tanh(v)."""
    model = Dynamics(
        np.array([[0.5]]), np.zeros((1, 1)), np.zeros(1), np.array([[0.0, 1.0]]), np.zeros(1), np.array([[0.5]])
    )
    v = np.random.default_rng(0).uniform(-3, 3, (400, 1))
    data = ScaledRecord(np.tanh(v), v, np.zeros(400, dtype=np.int64))
    cells = Cells.of([model], data, 1, 30)
    edges = cells.edges[0]
    assert edges == pytest.approx(np.quantile(v, [0.05, 0.2, 0.4, 0.6, 0.8, 0.95]))
    assert cells.curves[0].shape == (1, 5, 30, 1)
    assert cells.curves[0][0, :, -1, 0] == pytest.approx(np.diff(np.tanh(edges)) / np.diff(edges), abs=1e-6)
    assert cells.curves[0][0, :, 0, 0] == pytest.approx(0.5 * cells.curves[0][0, :, -1, 0], abs=1e-6)


def test_an_mv_of_two_values_has_one_cell() -> None:
    v = np.repeat([-1.0, 1.0], 50)[:, None]
    still = ScaledRecord(v, v, np.zeros(100, dtype=np.int64))
    assert [len(of) for of in Cells.of([Dynamics.linear(np.eye(1) / 2, np.eye(1))], still, 1, 5).edges] == [2]
    rare = np.zeros((100, 1))
    rare[7] = 1.0
    assert Cells.of([Dynamics.linear(np.eye(1) / 2, np.eye(1))], replace(still, v=rare), 1, 5).edges[0].tolist() == [
        0,
        1,
    ]


def proof_of(record: Record, part: IdentifiedPart = PART) -> tuple[dict[str, Any], list[bool | None], str]:
    """(answer of y0 to u0, whether the rows of the proof hold, why no controller may be shipped)."""
    learnt = part.learn(Source(record, made_plants.signals_of(1, 1)))
    sets = {"": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": learnt.metrics}}}}}
    held = [row.holds for row in statements(sets)]
    return learnt.metrics["proof"]["answers"]["y0"]["u0"], held, sign_doubts(sets)


def test_a_gain_that_turns_is_told_with_its_regions() -> None:
    found, held, doubts = proof_of(made_plants.hammerstein(ROWS, 0.5, steady=turning))
    assert (found["verdict"], held, doubts) == ("turns", [True, True], "")
    assert found["turns"]
    told = [of for of in found["regions"] if not of["small"]]
    assert [np.sign(of["model"]) for of in told] == [1, -1]
    assert told[0]["from"] < 30 < told[0]["to"] < 60
    assert 50 < told[1]["from"] < told[1]["to"] < 90
    for of in told:
        secant = (turning(of["to"]) - turning(of["from"])) / (of["to"] - of["from"])
        assert of["direct"] == pytest.approx(secant, rel=0.35)
        assert of["model"] == pytest.approx(of["direct"], rel=0.2)


def test_a_gain_that_fades_ships() -> None:
    found, held, doubts = proof_of(made_plants.hammerstein(ROWS, 0.5, steady=fading))
    assert (held, doubts) == ([True, True], "")
    assert [of["small"] for of in found["regions"]] == [False, True]
    assert not found["turns"]
    assert found["regions"][0]["model"] > 4 * abs(found["regions"][1]["model"])


def test_an_ordinary_plant_has_no_regions() -> None:
    found, held, doubts = proof_of(made_plants.hammerstein(ROWS, 0.5, steady=straight))
    assert (found["verdict"], held, doubts) == ("proven", [True, True], "")
    assert "regions" not in found


def shuffled(steady: Callable[[float], float]) -> Record:
    """Every row somewhere else in time: what is left is the curve between MV and PV of one row."""
    record = made_plants.hammerstein(ROWS, 0.5, steady=steady)
    order = np.random.default_rng(1).permutation(ROWS)
    return replace(record, pv=record.pv[order], mv=record.mv[order])


def wrong_tags(steady: Callable[[float], float]) -> Record:
    """The PV under the moves of another day."""
    record = made_plants.hammerstein(ROWS, 0.5, steady=steady)
    return replace(record, pv=made_plants.hammerstein(ROWS, 0.5, 7, steady=steady).pv)


@pytest.mark.parametrize(("garbage", "steady"), [(shuffled, turning), (shuffled, straight), (wrong_tags, turning)])
def test_garbage_is_refused_all_the_same(
    garbage: Callable[[Callable[[float], float]], Record], steady: Callable[[float], float]
) -> None:
    _, _, doubts = proof_of(garbage(steady))
    assert doubts


def test_an_mv_that_only_follows_the_pv_is_refused() -> None:
    """The valve is shut by hand: the plant's gain is nought, and the record bends where the MV is at an end."""
    y, u, _ = OperatedLoop(gain=1e-9, kc=8.0, ti=10.0, noise=1.0, load=4e9).rows(ROWS, 3)
    record = replace(made_plants.hammerstein(ROWS), pv=y[:, None], mv=u[:, None])
    _, _, doubts = proof_of(record)
    assert doubts
