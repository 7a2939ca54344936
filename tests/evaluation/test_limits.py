"""A law whose loops lock up, leave their limits, or that refuses a step, is found out on every model of a plant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from own_cases import filled_level

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.evaluation.closed_loop import LEFT, left_limits, lock_ups
from loopwright.pipeline.evaluation.stuck_loops import seized
from loopwright.pipeline.evaluation.trials import close_loop, repeated
from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopwrightError

Law = Callable[[np.ndarray, np.ndarray, int], np.ndarray]


class Told:
    """A controller whose MV is a function of set point, PV and sample."""

    manifest = SimpleNamespace(info=(), operate=(), inputs=())

    def __init__(self, law: Law) -> None:
        self.law, self.k = law, -1

    def cold_state(self) -> np.ndarray:
        return np.zeros(0)

    def step(self, *, sp: np.ndarray, pv: np.ndarray, dv: Any, mv_applied: Any, state: np.ndarray) -> Any:
        self.k += 1
        return self.law(sp, pv, self.k), state, np.zeros(0)


def held(sp: np.ndarray, pv: np.ndarray, k: int) -> np.ndarray:
    """A proportional controller of the level."""
    return np.clip(0.2 + 1.5 * (sp - pv), -1, 1)


def swinging(sp: np.ndarray, pv: np.ndarray, k: int) -> np.ndarray:
    """It pumps the level upwards, now and then the other way: the valve never stays at an end."""
    return np.array([-0.9 if k % 10 == 0 else 0.95])


def refused(sp: np.ndarray, pv: np.ndarray, k: int) -> np.ndarray:
    """What a file says whose law gives an MV beyond its range."""
    raise LoopwrightError("MV u0 is 1.2; its range is -1 to 1")


@pytest.fixture
def level(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnCase:
    monkeypatch.chdir(tmp_path)
    return filled_level()


@pytest.mark.parametrize(("law", "out"), [(held, False), (swinging, True), (refused, True)])
def test_a_loop_that_leaves_its_limits_counts_on_every_model(level: OwnCase, law: Law, out: bool) -> None:
    tests = [test for name in ("held_out", "spoilt") for test in level.tests()[name]]
    assert {id(test.plant) for test in tests} == {id(plant) for plant in level.members}
    for test in [*tests, *level.development()]:
        assert repeated(cast(Controller, Told(law)), level, test, False, 0).lock_ups == int(out)


def test_the_swinging_loop_is_no_lock_up(level: OwnCase) -> None:
    """Without the check of the limits it would be shipped."""
    test = level.tests()["held_out"][0]
    loop = close_loop(cast(Controller, Told(swinging)), level.plant, test, None, 0)
    assert not lock_ups(loop.sp, loop.pv, loop.mv, test.hold, low=[-1.0], high=[1.0], span=[6.0])
    assert np.abs(loop.pv).max() > 3 + LEFT * 6
    assert seized(level, test, loop)[0]


def test_the_range_may_be_overshot_a_little() -> None:
    def left(*pv: float) -> bool:
        return left_limits(np.array([[v, 5.0] for v in pv]), 0, low=[0.0, 0.0], high=[2.0, 10.0])

    assert not left(0.0, 2.0, 2.0 + 2 * LEFT)
    assert left(0.0, 2.01 + 2 * LEFT)
    assert left(1.0, -0.01 - 2 * LEFT)
    assert left(1.0, float("nan"))


def test_a_loop_may_overshoot_its_range_early_in_a_hold_and_must_come_back() -> None:
    """A plant of twice the gain overshoots by half a step; a loop that swings or drifts is there in the second half."""
    pv = np.full(40, 1.0)
    pv[22:28] = 3.0
    assert not left_limits(pv, 20, low=[0.0], high=[2.0])
    pv[22:31] = 3.0
    assert left_limits(pv, 20, low=[0.0], high=[2.0])
    pv = np.full(40, 1.0)
    pv[2:6] = 9.0
    assert left_limits(pv, 0, low=[0.0], high=[2.0])  # without holds there is no step to overshoot from
    assert left_limits(np.where(np.arange(40) % 4 < 2, 3.0, -1.0), 20, low=[0.0], high=[2.0])


def test_plants_in_equations_are_judged_by_lock_ups_alone() -> None:
    assert not any(case.on_models for case in CASES.values())
