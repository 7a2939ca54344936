"""A row that a Gemm takes as a column is turned by the Gemm itself; other turns stay."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx_graphs import graph, results

from loopwright.pipeline.export.fusion.outer_products import without_turns


def eliminated(turn: str, rows: int = 1) -> onnx.ModelProto:
    """out = a' b + c for a and b (rows, 3), with a turned by an operator of its own."""
    turned = (
        ("Transpose", ["a"], ["t"], {"perm": [1, 0]})
        if turn == "Transpose"
        else ("Reshape", ["a", np.array([3, rows])], ["t"])
    )
    product = ("Gemm", ["t", "b", "c"], ["out"], {"alpha": 1.0, "beta": 1.0, "transA": 0, "transB": 0})
    return graph([turned, product], {"out": (3, 3)}, a=(rows, 3), b=(rows, 3), c=(3, 3))


@pytest.mark.parametrize("turn", ["Transpose", "Reshape"])
def test_an_outer_product_takes_one_operator_and_gives_the_same(turn: str) -> None:
    model = eliminated(turn)
    found = without_turns(model)
    assert [n.op_type for n in found.graph.node] == ["Gemm"]
    assert not found.graph.initializer
    rng = np.random.default_rng(0)
    given = {"a": rng.random((1, 3)), "b": rng.random((1, 3)), "c": rng.random((3, 3))}
    before, after = (results(m, given)[0] for m in (model, found))
    np.testing.assert_array_equal(after, before)
    np.testing.assert_allclose(after, given["a"].T @ given["b"] + given["c"], rtol=1e-15)


def test_a_reshape_that_is_no_turn_stays() -> None:
    model = eliminated("Reshape", rows=2)
    assert [n.op_type for n in without_turns(model).graph.node] == ["Reshape", "Gemm"]
