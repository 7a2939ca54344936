"""Deep graphs, layers that go together, and values that wait for a later product."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import onnx
from onnx_graphs import Nodes, assert_equal, graph, n_nodes

from loopwright.pipeline.export.fusion import fused
from loopwright.pipeline.export.fusion.joining import joined

RNG = np.random.default_rng(0)


def kinds(model: onnx.ModelProto) -> Counter[str]:
    return Counter(node.op_type for node in model.graph.node)


def network(name: str, given: str, sizes: list[int]) -> Nodes:
    """A network of tanh layers on a vector; its last layer is affine."""
    nodes: Nodes = []
    for i, (n, m) in enumerate(pairwise(sizes)):
        nodes += [
            ("MatMul", [given, RNG.normal(size=(n, m))], [f"{name}p{i}"]),
            ("Add", [f"{name}p{i}", RNG.normal(size=m)], [f"{name}b{i}"]),
        ]
        given = f"{name}b{i}"
        if i < len(sizes) - 2:
            nodes.append(("Tanh", [given], [f"{name}t{i}"]))
            given = f"{name}t{i}"
    return nodes


def test_a_long_chain_is_no_deep_recursion() -> None:
    """A predictive law over a long horizon is a thousand levels deep."""
    nodes: Nodes = []
    for i in range(1_200):
        before = f"s{i - 1}" if i else "x"
        nodes += [("Tanh", [before], [f"t{i}"]), ("Add", [f"t{i}", "y"], [f"s{i}"])]
    nodes.append(("Concat", ["s1199", "y"], ["out"], {"axis": 0}))
    model = graph(nodes, {"out": (2,)}, x=(1,), y=(1,))
    assert_equal(model, fused(model))


def test_networks_side_by_side_become_one() -> None:
    """Two networks of the same inputs: their layers go together, and the graph is shorter."""
    nodes = [*network("a", "x", [3, 8, 8, 2]), *network("b", "x", [3, 6, 6, 2]), ("Mul", ["ab2", "bb2"], ["out"])]
    model = graph(nodes, {"out": (2,)}, x=(3,))
    made = fused(model)
    assert kinds(made)["Tanh"] == 2
    assert n_nodes(made) <= n_nodes(model) - 5
    assert_equal(model, made)


def test_only_what_waits_for_nothing_else_goes_together() -> None:
    """A network of a network's result keeps its own layers, and one layer alone stays as it is."""
    chain = graph([*network("a", "x", [2, 4, 2]), *network("b", "ab1", [2, 4, 1])], {"bb1": (1,)}, x=(2,))
    assert joined(chain) is None
    nodes = [*network("a", "x", [2, 4, 2]), *network("b", "x", [2, 4, 2]), *network("c", "ab1", [2, 5, 2])]
    model = graph([*nodes, ("Add", ["bb1", "cb1"], ["out"])], {"out": (2,)}, x=(2,))
    together = joined(model)
    assert together is not None
    assert kinds(together)["Tanh"] == 2  # a and b; c
    assert_equal(model, together)
    assert_equal(model, fused(model))


def test_layers_too_large_for_one_matrix_stay_apart() -> None:
    nodes = [*network("a", "x", [2, 100, 1]), *network("b", "x", [2, 100, 1]), ("Mul", ["ab1", "bb1"], ["out"])]
    model = graph(nodes, {"out": (1,)}, x=(2,))
    assert joined(model) is None
    assert_equal(model, fused(model))


def test_a_value_that_nothing_waits_for_joins_a_later_product() -> None:
    """What only the end needs is no product of its own beside that of the end."""
    weights = RNG.normal(size=(4, 3))
    nodes: Nodes = [
        ("MatMul", ["x", RNG.normal(size=(4, 4))], ["h"]),
        ("Tanh", ["h"], ["t"]),
        ("MatMul", ["t", RNG.normal(size=(4, 3))], ["one"]),
        ("MatMul", ["x", weights], ["other"]),
        ("Mul", ["one", "other"], ["out"]),
    ]
    model = graph(nodes, {"out": (3,)}, x=(4,))
    made = fused(model)
    assert kinds(made)["MatMul"] == 2
    assert_equal(model, made)


def test_a_vector_made_a_row_or_a_column_is_multiplied_as_a_vector() -> None:
    """S' phi and S w as a person writes them, with axes of length one that the product does not need."""
    nodes: Nodes = [
        ("Reshape", ["flat", np.array([3, 3])], ["made"]),
        ("Tanh", ["made"], ["root"]),
        ("Unsqueeze", ["x", np.array([0])], ["row"]),
        ("MatMul", ["row", "root"], ["w1"]),
        ("Squeeze", ["w1", np.array([0])], ["w"]),
        ("Unsqueeze", ["w", np.array([1])], ["column"]),
        ("MatMul", ["root", "column"], ["kc"]),
        ("Squeeze", ["kc", np.array([1])], ["out"]),
    ]
    model = graph(nodes, {"out": (3,)}, x=(3,), flat=(9,))
    made = fused(model)
    assert not kinds(made).keys() & {"Unsqueeze", "Squeeze"}
    assert_equal(model, made)
