"""What the metrics of a part say over several data seeds."""

from __future__ import annotations

from loopwright.pipeline.stages.fit import _median


def test_a_number_counts_in_the_seeds_that_have_it() -> None:
    seeds = {
        "0": {"rmse": 1.0, "structure": {"order": 3, "network": None}, "verdict": "linear"},
        "1": {"rmse": 3.0, "structure": {"order": 5, "network": 0.4}, "verdict": "linear"},
        "2": {"rmse": 2.0, "structure": {"order": 5, "network": 0.2}, "verdict": "nonlinear", "late": 7},
    }
    found = _median(seeds)
    assert found["rmse"] == 2.0
    assert found["structure"]["order"] == 5
    assert abs(found["structure"]["network"] - 0.3) < 1e-12
    assert found["late"] == 7
    assert "verdict" not in found


def test_a_number_that_no_seed_has_is_left_out() -> None:
    assert _median({"0": {"a": None}, "1": {"a": None}}) == {}
