"""What a metric says of itself, one rule for several sequences, and one ratio to the bound."""

from __future__ import annotations

import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from whole_bounds import whole_bounds

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.metric import (
    METRICS,
    REDUCE,
    Metric,
    gate_ratio,
    mean_of_draws,
    ratio_to_bound,
    together,
)
from loopwright.pipeline.optimal.bounds import bounded, kinds, read_stored
from loopwright.pipeline.optimal.bounds import bounds_path as path_of

OWN = {metric.name: metric for metric in (Metric("overshoot_max", "largest overshoot", together="max"),)}
POSITIVE = st.floats(1e-6, 1e3)


@pytest.fixture(params=sorted(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


def test_the_worst_of_several_sequences_stays_the_worst() -> None:
    rows = [{"overshoot_max": 0.05, "max_asse": 3.0, "failures": 1.0, "mae": 1.0, "step_ms_p99": 4.0}]
    rows.append({"overshoot_max": 0.25, "max_asse": 1.0, "failures": 2.0, "mae": 2.0, "step_ms_p99": 5.0})
    expected = {"overshoot_max": 0.25, "max_asse": 3.0, "failures": 3.0, "mae": 1.5, "step_ms_p99": 5.0}
    assert together(rows, METRICS | OWN) == expected


def test_a_figure_that_is_no_metric_is_refused() -> None:
    with pytest.raises(ParamsError, match=r"'overshoot_max' is scored, but is no metric; add Metric\('overshoot_max'"):
        together([{"overshoot_max": 0.1}])


def test_draws_of_the_noise_are_averaged_whatever_the_metric() -> None:
    assert mean_of_draws([{"max_asse": 1.0, "sse": 4.0}, {"max_asse": 2.0, "sse": 6.0}]) == {
        "max_asse": 1.5,
        "sse": 5.0,
    }


def test_bounds_are_put_together_as_the_laws_are(case: Case) -> None:
    """Of each stored figure of each bounded test: the sequences' own, by the metric's rule."""
    stored, found = read_stored(path_of(case))["figures"], whole_bounds(case)
    for name, tests in case.scenarios().items():
        if not bounded(case, tests):
            continue
        for kind in set(kinds(case)) - {"nmpc_noise"}:
            rows = [stored[name][test.digest()][kind] for test in tests]
            for key, value in found[name][kind].items():
                own = [row[key] for row in rows]
                assert value == pytest.approx(REDUCE[case.metrics[key].together](own), rel=1e-12)
                if "max" in key.split("_"):
                    assert value == max(own)


def test_every_figure_that_a_case_scores_is_a_metric_of_it(case: Case) -> None:
    test = next(iter(case.scenarios().values()))[0]
    n = test.samples
    pv = np.tile([s.low + 0.4 * (s.high - s.low) for s in case.plant.pv_signals], (n, 1))
    mv = np.tile(test.mv0, (n, 1))
    assert set(case.score(test, pv, mv)) <= set(case.metrics)


def test_a_case_is_compared_by_a_metric_with_a_floor_and_travels_to_workers(case: Case) -> None:
    floor = case.criterion.floor
    assert floor is not None
    assert floor.error(0.1, 200) > 0
    assert floor.text.format(noise=0.1, unit=" K")
    assert pickle.loads(pickle.dumps(case)).criterion == case.criterion


def test_floors_are_what_noise_hides() -> None:
    rng, noise, n = np.random.default_rng(0), 0.3, 400
    draws = noise * rng.standard_normal((4000, n))
    floors = {name: metric.floor.error(noise, n) for name, metric in METRICS.items() if metric.floor is not None}
    assert floors["mae"] == noise
    assert floors["sse"] == pytest.approx(float(np.mean(np.sum(draws**2, axis=1))), rel=0.01)
    # An error e adds e^2 to the mean square of n noisy samples, which itself has this deviation.
    assert floors["tracking"] ** 2 == pytest.approx(float(np.std(np.mean(draws**2, axis=1))), rel=0.05)


def test_units_follow_the_controlled_variable() -> None:
    assert METRICS["mae"].label("K") == "MAE [K]"
    assert METRICS["sse"].label("degC") == "SSE [°C²]"
    assert METRICS["sse"].label("mol/l") == "SSE [(mol/l)²]"
    assert METRICS["sse"].label("-") == "SSE"
    assert METRICS["ise"].label("-") == "ISE [s]"
    assert Metric("mae_T", "MAE T", unit="degC").label("mol/l") == "MAE T [°C]"
    assert Metric("mae_x", "MAE x", unit="-").label("mol/l") == "MAE x"
    assert METRICS["overshoot"].label("K") == "overshoot"
    with pytest.raises(FrozenInstanceError):
        METRICS["mae"].short = "x"  # type: ignore[misc]


@given(own=POSITIVE, bound=POSITIVE, floor=POSITIVE)
def test_a_ratio_is_the_gates_where_the_bound_is_a_yardstick(own: float, bound: float, floor: float) -> None:
    ratio, gate = ratio_to_bound(own, bound, floor), gate_ratio(own, bound, floor)
    assert (ratio is None) == (bound < floor)
    assert gate >= min(1.0, own / bound)
    if ratio is None:
        assert gate == max(own, floor) / floor >= 1.0
    elif own >= floor:
        assert gate == ratio == own / bound


def test_a_perfect_bound_is_no_yardstick() -> None:
    assert ratio_to_bound(0.1, 0.0, 0.0) is None
