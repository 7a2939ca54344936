"""Models drawn about a fit: their spread is that of fits to other records of the same plant."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.output_error import OutputErrorFit, fit_starts
from loopwright.pipeline.models.identified.parameter_uncertainty import drawn

TRUE = Dynamics.linear(np.array([[0.9]]), np.array([[0.2]]))
ROWS = 3000


def record(seed: int, colour: float) -> Stretch:
    """Noise of sd .2 with the pole ``colour``; inputs are the same for all seeds."""
    v = np.repeat(np.random.default_rng(0).uniform(-1, 1, ROWS // 20), 20)[:, None]
    run = TRUE.free_run(np.zeros(1), Stretch(np.zeros((ROWS, 1)), v))
    assert run is not None
    white = np.random.default_rng(seed).normal(size=ROWS)
    e = np.empty(ROWS)
    last = 0.0
    for k in range(ROWS):
        last = colour * last + np.sqrt(1 - colour**2) * white[k]
        e[k] = 0.2 * last
    return Stretch(run[0] + e[:, None], v)


def gain(model: Dynamics) -> float:
    return float(model.b[0, 0] / (1 - model.a[0, 0]))


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_the_spread_of_draws_is_that_of_other_records(colour: float) -> None:
    fits = [OutputErrorFit(iterations=8).fit(TRUE, [record(seed, colour)]) for seed in range(1, 26)]
    across = np.std([gain(f.model) for f in fits])
    found = []
    for seed in (1, 2, 3, 4):
        data = [record(seed, colour)]
        starts = fit_starts(fits[seed - 1].model, data)
        found.append(np.std([gain(m) for m in drawn(fits[seed - 1].model, starts, data, 40)]))
    assert np.mean(found) == pytest.approx(across, rel=0.45)


def test_few_rows_give_no_draw() -> None:
    data = record(1, 0.0)
    short = [Stretch(data.y[:300], data.v[:300])]
    assert drawn(TRUE, [np.zeros(1)], short, 5) == []


def test_an_exploding_model_gives_no_draw() -> None:
    wild = Dynamics.linear(np.array([[1.5]]), np.array([[1.0]]))
    assert drawn(wild, [np.ones(1)], [record(1, 0.0)], 5) == []
