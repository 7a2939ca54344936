"""When a variable first answers to an input, by the step response in the report."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.report.identified_model import answers_after

EVERY = [1, 2, 16]  # periods between two points of a response


def curve(answer: np.ndarray, every: int, band: float = 0.0) -> dict[str, Any]:
    """Of a response (n,), whose first value stands one period after the step."""
    periods = np.arange(1, len(answer) + 1, every)
    middle = answer[periods - 1]
    bands = {"low": (middle - band / 2).tolist(), "high": (middle + band / 2).tolist()} if band else {}
    return {"periods": periods.tolist(), "middle": middle.tolist(), **bands}


def after(dead: int, n: int = 960) -> np.ndarray:
    return np.maximum(np.arange(1, n + 1) - dead, 0)


@pytest.mark.parametrize("dead", [0, 3, 10])
@pytest.mark.parametrize("sign", [1.0, -2.0])
def test_a_lag_answers_one_sample_after_its_dead_time(dead: int, sign: float) -> None:
    found = answers_after(curve(sign * (1 - 0.9 ** after(dead)), 1))
    assert found == pytest.approx(dead + 1, abs=1e-9)


@pytest.mark.parametrize("dead", [0, 3, 10])
@pytest.mark.parametrize("every", EVERY)
@pytest.mark.parametrize("n", [200, 960, 4000])
def test_a_ramp_answers_one_sample_after_its_dead_time(dead: int, every: int, n: int) -> None:
    """However long the response: nothing of it is its largest value."""
    assert answers_after(curve(-0.02 * after(dead, n), every)) == pytest.approx(dead + 1, abs=1e-9)


@pytest.mark.parametrize("dead", [0, 3, 4, 30])
@pytest.mark.parametrize("every", EVERY)
def test_a_slow_lag_is_found_between_the_points_that_are_known(dead: int, every: int) -> None:
    assert answers_after(curve(1 - 0.99 ** after(dead), every)) == pytest.approx(dead + 1, abs=max(0.1 * every, 0.2))


@pytest.mark.parametrize("every", [1, 2])
def test_two_slow_lags_are_not_found_later_for_their_length(every: int) -> None:
    """Five per cent of the end come 45 samples after the dead time of 31."""
    k = after(31, 2000)
    answer = 1 - (300 * np.exp(-k / 300) - 60 * np.exp(-k / 60)) / 240
    assert 32 <= answers_after(curve(answer, every)) <= 42


@pytest.mark.parametrize("every", [1, 2])
def test_an_inverse_response_answers_when_it_goes_the_other_way(every: int) -> None:
    k = after(5)
    answer = 2 * (1 - 0.97**k) - 1.5 * (1 - 0.8**k)
    assert answer.min() < -0.2
    assert answers_after(curve(answer, every)) == pytest.approx(6, abs=0.5 * every)


def test_what_lies_within_the_band_of_the_fits_is_no_answer() -> None:
    answer = 1 - 0.9 ** after(6)
    answer[:6] = 0.06
    assert answers_after(curve(answer, 1)) == 1
    assert answers_after(curve(answer, 1, band=0.13)) == pytest.approx(7, abs=0.5)


def test_an_answer_is_not_told_before_the_whole_dead_periods_of_the_model() -> None:
    answer = 1 - 0.9 ** after(0)
    assert answers_after(curve(answer, 2), dead=3.4) == 4


def test_a_dead_time_before_the_first_point_counts() -> None:
    """Delays of a model's inputs stand in the periods, not in points of their own."""
    assert answers_after({"periods": [11, 12], "middle": [1.0, 2.0]}) == pytest.approx(11)


def test_no_answer_has_no_time() -> None:
    assert answers_after({"periods": [1, 2, 3], "middle": [0.0, 0.0, 0.0]}) == 0.0
