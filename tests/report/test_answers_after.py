"""When a variable first answers to an input, by the step response in the report."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.report.identified_model import answers_after


@pytest.mark.parametrize("dead", [0, 3, 10])
@pytest.mark.parametrize("sign", [1.0, -2.0])
def test_a_lag_with_dead_time_answers_after_it(dead: int, sign: float) -> None:
    k = np.arange(1, 200)
    answer = sign * (1 - 0.9 ** np.maximum(k - dead, 0))
    found = answers_after({"periods": k.tolist(), "middle": answer.tolist()})
    assert found == pytest.approx(dead + 0.5, abs=0.05)  # a tenth of the way in the first period


def test_a_dead_time_before_the_first_point_counts() -> None:
    """Delays of a model's inputs stand in the periods, not in points of their own."""
    assert answers_after({"periods": [11, 12], "middle": [1.0, 2.0]}) == pytest.approx(10.1)


def test_no_answer_has_no_time() -> None:
    assert answers_after({"periods": [1, 2, 3], "middle": [0.0, 0.0, 0.0]}) == 0.0
