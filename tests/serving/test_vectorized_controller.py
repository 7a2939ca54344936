"""Rows of a law that reads ``operate`` and ``fresh`` are steps of ``Controller``, with own values or defaults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loopwright.serving import Controller
from loopwright.serving.errors import ContractError
from loopwright.serving.operating import Operate
from loopwright.serving.vectorized_controller import VectorizedController

pytest_plugins = ["operated_laws"]
ROWS = 5


def given(k: int) -> dict[str, np.ndarray]:
    """Inputs (ROWS, n) of a step."""
    rng = np.random.default_rng(k)
    return {name: rng.uniform(-0.15, 0.15, (ROWS, n)) for name, n in (("sp", 2), ("pv", 2), ("dv", 1))}


@pytest.mark.parametrize("steered", [False, True])
def test_each_row_is_a_step_of_its_own_operate_and_fresh(operated_file: Path, steered: bool) -> None:
    controller = Controller(operated_file)
    operate = Operate(controller.manifest.operate)
    changes = [{}, {"u0.high": 0.1}, {"y0.track": 0, "y0.low": -0.1, "y0.high": 0.1}, {"u1.use": 0}, {"speed": 3}]
    rows = np.array([operate.with_values(change) for change in changes])
    fresh = np.array([[1, 1], [0, 1], [1, 0], [0, 0], [1, 1]], dtype=np.float64)
    many, mv = VectorizedController(controller, ROWS), np.zeros((ROWS, 2))
    state = many.cold_state()
    for k in range(6):
        # What is not given in one step is the default again, not that of the step before.
        extra = {"operate": rows, "fresh": fresh} if steered and k % 3 < 2 else {}
        inputs = {**given(k), "mv_applied": mv, "state": state, **extra}
        step = many.step(**inputs)
        assert not step.refused.any()
        for i in range(ROWS):
            alone = controller.step(**{name: values[i] for name, values in inputs.items()})
            assert bytes(step.mv[i]) == bytes(alone.mv)
            assert bytes(step.state[i]) == bytes(alone.state)
        mv, state = step.mv, step.state
    assert len(np.unique(mv[:, 0])) == ROWS


def test_a_row_that_is_not_allowed_is_named(operated_file: Path) -> None:
    controller = Controller(operated_file)
    many, operate = VectorizedController(controller, ROWS), Operate(controller.manifest.operate)
    rows, fresh = np.tile(operate.default, (ROWS, 1)), np.ones((ROWS, 2))
    rows[3, operate.places["u0.use"]] = 0.5
    fresh[2, 1] = np.nan
    begin = {**given(0), "mv_applied": np.zeros((ROWS, 2)), "state": many.cold_state()}
    for extra, words in (
        ({"operate": rows}, r"row 3: operate: u0\.use is 0\.5"),
        ({"fresh": fresh}, "row 2: fresh is"),
        ({"operate": rows[:, :-1]}, "operate has the shape"),
        ({"fresh": fresh[:1]}, "fresh has the shape"),
    ):
        with pytest.raises(ContractError, match=words):
            many.step(**begin, **extra)
