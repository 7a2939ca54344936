"""Set points of an own plant's tests ask for no rest beyond a range that a law keeps from its start."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from identified_models import scaled_model
from own_cases import case_of, controllers_of_a_lag, section

from loopwright.pipeline.cases.own_plant import OwnCase, own_case
from loopwright.pipeline.simulation.rests import settled
from loopwright.pipeline.stages.code import listing

GAINS = np.array([2.0, 1.0])  # of the controlled variable and of a constraint, by one MV
POLES = np.array([0.9, 0.8])


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def constrained(operate: dict[str, Any] | None, level: bool = False) -> OwnCase:
    """One MV moves y0, which is controlled, and y1; with ``level`` a second MV fills a level in place of y0."""
    poles, gains = np.array([1.0 if level else POLES[0], POLES[1]]), np.array([0.0 if level else GAINS[0], GAINS[1]])
    n = 1 + level
    a, b = np.diag(poles), ((1 - poles) * gains)[:, None]
    if level:  # y0 is balanced where both MVs are equal
        b = np.array([[0.05, -0.05], [0.2, 0.0]])
    mv = np.repeat(np.random.default_rng(0).uniform(-0.9, 0.9, (40, 1)), 25, axis=0) @ np.ones((1, n))
    y = np.zeros((len(mv), 2))
    for k in range(len(mv) - 1):
        y[k + 1] = a @ y[k] + b @ mv[k]
    if level:
        y[:, 0] = np.linspace(-1, 1, len(y))
    models = [scaled_model(2, n, 0, 2, a=a, b=s * b, rest=np.eye(2, 3 + n)) for s in (1.0, 0.95, 1.05)]
    case = case_of(section(2, n, controlled=1), models, y, mv)
    tree = yaml.safe_load(Path("params.yaml").read_text())
    entry: dict[str, Any] = {"case": "it", "model": "identified", "name": "predictive", "law": "predictive"}
    tree["controllers"] = {"it-predictive": entry if operate is None else {**entry, "operate": operate}}
    Path("params.yaml").write_text(yaml.safe_dump(tree))
    found = own_case("it")
    assert isinstance(found, OwnCase)
    assert found.signals.pv[1:] == case.signals.pv[1:]
    return found


def asked_of_constraint(case: OwnCase) -> np.ndarray:
    """y1 (n,) where y0 rests at the set points of the tests with them, each on its own plant."""
    found = []
    for name in ("held_out", "spoilt"):
        for test in case.scenarios()[name]:
            assert test.plant is not None
            p = test.parameters(test.plant)[0]
            mvs = np.linspace(-1, 1, 401)[:, None]
            y = test.plant.measured(settled(test.plant, test.x0, mvs, p))
            found += np.interp(np.unique(test.sp), y[:, 0], y[:, 1]).tolist()
    return np.array(found)


@pytest.mark.parametrize("operate", [None, {}, {"y1.use": 0.0, "y1.high": 0.2}, {"y1.rank": 2}, {"y1.high": "much"}])
def test_without_a_range_in_use_set_points_go_over_what_was_visited(operate: dict[str, Any] | None) -> None:
    case = constrained(operate)
    assert case.kept_ranges == {}
    assert np.ptp(asked_of_constraint(case)) > 1.0


@pytest.mark.parametrize(("low", "high"), [(-np.inf, 0.2), (-0.1, 0.3), (0.0, np.inf)])
def test_no_set_point_asks_a_constraint_beyond_its_range(low: float, high: float) -> None:
    ends = {f"y1.{end}": of for end, of in (("low", low), ("high", high)) if np.isfinite(of)}
    case = constrained(ends)
    assert case.kept_ranges == {"y1": (low, high)}
    found = asked_of_constraint(case)
    assert low - 1e-2 <= found.min()
    assert found.max() <= high + 1e-2
    assert np.ptp(found) > 0.2  # they still move


def test_a_range_of_the_controlled_variable_itself_counts() -> None:
    case = constrained({"y0.high": 0.5})
    found = np.concatenate([test.sp for test in case.scenarios()["held_out"]])
    assert found.max() <= 0.5
    assert found.min() < -0.5


@pytest.mark.parametrize("operate", [{"y1.low": 2.5}, {"y1.high": -2.5}])
def test_ranges_within_which_nothing_rests_leave_set_points_as_they_were_and_it_is_told(
    operate: dict[str, float],
) -> None:
    free, kept = constrained({}), constrained(operate)
    assert len(kept.lacking) == len(free.lacking) + 1
    for one, other in zip(kept.scenarios()["held_out"], free.scenarios()["held_out"], strict=True):
        assert np.array_equal(one.sp, other.sp)


def test_ranges_of_two_laws_that_lie_apart_are_none() -> None:
    constrained({"y1.high": 0.2})
    tree = yaml.safe_load(Path("params.yaml").read_text())
    tree["controllers"]["it-other"] = {**tree["controllers"]["it-predictive"], "operate": {"y1.low": 0.5}}
    Path("params.yaml").write_text(yaml.safe_dump(tree))
    assert own_case("it").kept_ranges == {}


@pytest.mark.parametrize(("operate", "rests"), [({}, True), ({"y1.high": 0.4}, True), ({"y1.low": 0.95}, False)])
def test_levels_that_never_settle_are_balanced_within_the_range(operate: dict[str, float], rests: bool) -> None:
    """The level rests where both MVs are equal, and y1 where they are: at .95 only beyond what was drawn."""
    case = constrained(operate, level=True)
    assert case.reach.integrates == (0,)
    levels, found = case.reach.drawn(case.members[0], 9001)
    assert np.ptp(levels) > 0.5
    assert found is rests


def test_an_edited_range_runs_again_whatever_draws_set_points(monkeypatch: pytest.MonkeyPatch) -> None:
    controllers_of_a_lag({"pid": {"law": "pid", "tuning": "manual"}})
    root = Path(__file__).parents[2]

    def digests(operate: dict[str, float]) -> dict[str, str]:
        tree = yaml.safe_load(Path("params.yaml").read_text())
        tree["controllers"]["it-pid"]["operate"] = operate
        Path("params.yaml").write_text(yaml.safe_dump(tree))
        return {stage: listing(root, stage, "it")["params.yaml"] for stage in ("fit", "design", "validate", "report")}

    first, cost, narrower = (
        digests({"y0.high": 1.0}),
        digests({"y0.high": 1.0, "u0.cost": 1}),
        digests({"y0.high": 0.5}),
    )
    assert cost == first
    assert {stage for stage in first if first[stage] != narrower[stage]} == {"design", "validate", "report"}
