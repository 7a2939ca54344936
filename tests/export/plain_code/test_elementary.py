"""exp, log, tanh and softmax of the plain programs: within one unit of the last place, ends and signs as stated."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import numpy as np
import pytest
from mpmath import mp
from onnx_graphs import graph

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
from loopwright.pipeline.export.plain_code.interpreter import run
from loopwright.pipeline.export.plain_code.lowering import lowered

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


def softmax(x: np.ndarray, axis: int) -> np.ndarray:
    """By the statements that a graph of it becomes."""
    nodes = [("Reshape", ["x", np.array(x.shape)], ["xx"]), ("Softmax", ["xx"], ["y"], {"axis": axis})]
    program = lowered(graph(nodes, {"y": x.shape}, x=(x.size,)))
    return run(program, x=x.ravel())["out_y"].reshape(x.shape)


@pytest.mark.parametrize("spread", [1.0, 30.0, 700.0])
def test_each_share_of_a_softmax_is_within_one_unit_of_its_last_place(spread: float) -> None:
    x = RNG.uniform(-spread, spread, (600, 5))
    x[::7, 3] = x[::7, 1]  # equal ones
    found, worst = softmax(x, axis=1), 0.0
    with mp.workprec(140):
        for row, shares in zip(x.tolist(), found.tolist(), strict=True):
            grown = [mp.exp(mp.mpf(v)) for v in row]
            for share, part in zip(shares, grown, strict=True):
                true = part / mp.fsum(grown)
                if true > 1e-290:
                    worst = max(worst, float(abs(mp.mpf(share) - true) / math.ulp(float(true))))
    assert 0.3 < worst < 0.75


def test_a_softmax_goes_along_any_axis_and_says_where_a_number_is_none() -> None:
    x = RNG.uniform(-3, 3, (2, 3, 4))
    for axis in range(3):
        usual = np.exp(x) / np.exp(x).sum(axis, keepdims=True)
        np.testing.assert_allclose(softmax(x, axis), usual, rtol=1e-15)
    x[0, 1, 2] = math.nan
    missing = np.isnan(softmax(x, axis=2))
    assert missing[0, 1].all()
    assert missing.sum() == 4
    assert softmax(np.array([[1e300, -1e300, 0.0]]), axis=1).tolist() == [[1.0, 0.0, 0.0]]
    assert softmax(np.full((1, 4), 7.0), axis=1).tolist() == [[0.25] * 4]
