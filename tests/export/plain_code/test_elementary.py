"""exp, log and tanh of the plain programs: within one unit of the last place, ends and signs as stated."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import numpy as np
import pytest
from mpmath import mp

from loopwright.pipeline.export.plain_code.elementary import (
    HIGH_TANH,
    LARGEST,
    LEAST_EXP,
    LOW_TANH,
    MOST_EXP,
    plain_exp,
    plain_log,
    plain_tanh,
)

RNG = np.random.default_rng(0)
N = 3_000  # the benchmark of plain programs takes 10^6


def spread(low: float, high: float) -> np.ndarray:
    return RNG.uniform(low, high, N)


@pytest.mark.parametrize(
    ("ours", "exact", "at"),
    [
        (plain_exp, mp.exp, [spread(-1, 1), spread(-745, 709.7), spread(-1e-9, 1e-9)]),
        (plain_log, mp.log, [spread(0.4, 2.5), np.exp(spread(-740, 709)), 1 + spread(-1e-4, 1e-4)]),
        (plain_tanh, mp.tanh, [spread(-1, 1), spread(-21, 21), spread(-1e-5, 1e-5), LOW_TANH + spread(-1e-9, 1e-9)]),
    ],
)  # fmt: skip
def test_each_result_is_within_one_unit_of_its_last_place(
    ours: Callable[[float], float], exact: Callable[..., float], at: list[np.ndarray]
) -> None:
    with mp.workprec(140):
        worst = 0.0
        for x in np.concatenate(at).tolist():
            true = exact(mp.mpf(x))
            worst = max(worst, float(abs(mp.mpf(ours(x)) - true) / math.ulp(float(true))))
    assert 0.3 < worst < 1.0


def test_beyond_the_doubles_they_end_as_stated() -> None:
    assert [plain_exp(x) for x in (MOST_EXP, 1e300, LEAST_EXP, -1e300)] == [LARGEST, LARGEST, 0.0, 0.0]
    assert [plain_log(x) for x in (0.0, -3.0)] == [-LARGEST, -LARGEST]
    assert [plain_tanh(x) for x in (HIGH_TANH, -HIGH_TANH, 1e300)] == [1.0, -1.0, 1.0]
    assert plain_exp(0.0) == 1.0
    assert plain_log(1.0) == 0.0
    assert all(math.isnan(of(math.nan)) for of in (plain_exp, plain_log, plain_tanh))
    assert plain_log(sys.float_info.max) == pytest.approx(709.782712893384, rel=1e-15)


def test_tanh_is_odd_and_rises_where_its_formula_changes() -> None:
    x = LOW_TANH + np.arange(-200, 200) * math.ulp(LOW_TANH)
    found = [plain_tanh(v) for v in x.tolist()]
    assert found == [-plain_tanh(-v) for v in x.tolist()]
    assert min(np.diff(found)) >= -math.ulp(found[0])
