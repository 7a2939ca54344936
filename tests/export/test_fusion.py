"""A fused graph computes what the given one does, in double precision, with fewer operators or none changed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from onnx import numpy_helper
from onnx_graphs import Nodes, assert_equal, graph, n_nodes, narrow, results, session
from shipped_files import SHIPPED

from loopwright.pipeline.export import fusion
from loopwright.pipeline.export.fusion import emission, fused, lone_factors, reading
from loopwright.pipeline.export.fusion.affine import Affine
from loopwright.pipeline.export.fusion.items import Group, SelectionPool
from loopwright.pipeline.export.fusion.plan import FormChoice, Item
from loopwright.pipeline.export.fusion.reading import GraphReading

ARTIFACTS = Path(__file__).parents[2] / "artifacts"
WITHOUT_QP = [p for p in SHIPPED if p.stem != "predictive"]
KINDS = (
    ["Add", "Sub", "Mul", "Div", "scaled", "shifted", "MatMul", "Slice", "Split", "Concat", "Tanh", "Abs", "bounded"],
    ["Where", "kept", "between", "ReduceSum", "squares", "outer", "Neg", "Gather"],
)


# ---------------------------------------------------------------------- any graph
@st.composite
def graphs(draw: Callable[..., Any]) -> onnx.ModelProto:
    """Vectors of 1 to 4 elements through affine and nonlinear operators, one on top of the other."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    inputs = {"x": (3,), "y": (2,), "z": (1,)}
    sizes = {name: shape[0] for name, shape in inputs.items()}
    nodes: Nodes = []

    def add(op: str, names: list[Any], size: int, attributes: dict[str, Any] | None = None) -> str:
        name = f"v{len(nodes)}"
        nodes.append((op, names, [name], attributes or {}))
        sizes[name] = size
        return name

    kinds = st.sampled_from([*KINDS[0], *KINDS[1]])
    for kind in draw(st.lists(kinds, min_size=4, max_size=24)):
        names = list(sizes)
        a = draw(st.sampled_from(names))
        b = draw(st.sampled_from([n for n in names if sizes[n] in (1, sizes[a])]))
        n, c = sizes[a], rng.normal(size=sizes[a])
        if kind in ("Add", "Sub", "Mul"):
            add(kind, [a, b] if rng.random() < 0.5 or kind != "Sub" else [b, a], n)
        elif kind == "Div":
            add(kind, [a, add("Add", [add("Mul", [b, b], sizes[b]), np.ones(1)], sizes[b])], n)
        elif kind == "scaled":
            add("Mul", [a, c[:1] if rng.random() < 0.5 else c], n)
        elif kind == "shifted":
            add("Add", [c, a], n)
        elif kind == "MatMul":
            add(kind, [a, rng.normal(size=(n, 3)) / n], 3)
        elif kind == "Slice":
            add(kind, [a, np.array([n // 2]), np.array([n])], n - n // 2)
        elif kind == "Gather":
            add(kind, [a, rng.integers(0, n, 2)], 2)
        elif kind == "Split" and n == 3:
            nodes.append(("Split", [a, np.array([1, 2])], [f"v{len(nodes)}", f"w{len(nodes)}"]))
            sizes[f"v{len(nodes) - 1}"], sizes[f"w{len(nodes) - 1}"] = 1, 2
        elif kind == "Concat" and n + sizes[b] <= 4:
            add(kind, [a, b], n + sizes[b], {"axis": 0})
        elif kind in ("Tanh", "Abs", "Neg"):
            add(kind, [a], n)
        elif kind == "bounded":
            add("Min", [add("Max", [a, np.array([-0.7])], n), np.array([0.6])], n)
        elif kind in ("Where", "kept", "between"):
            # Of an input: what is computed might be just at the limit.
            condition = f"c{len(nodes)}"
            nodes.append(("Greater", ["z", np.array([0.1])], [condition]))
            branches = {"Where": [a, b], "kept": [a, np.zeros(n)], "between": [np.full(n, 2.0), np.ones(n)]}[kind]
            add("Where", [condition, *branches], n)
        elif kind == "ReduceSum":
            add(kind, [a, np.array([0])], 1, {"keepdims": 1})
        elif kind == "squares":
            add("ReduceSum", [add("Mul", [a, a], n), np.array([0])], 1, {"keepdims": 1})
        elif kind == "outer":
            column = add("Unsqueeze", [a, np.array([1])], n)
            product = add("Mul", [column, add("Unsqueeze", [b, np.array([0])], sizes[b])], n)
            sizes[add("ReduceSum", [product, np.array([1])], n, {"keepdims": 0})] = n
            for name in [k for k in sizes if k in (column, product) or k == nodes[-3][2][0]]:
                del sizes[name]  # matrices
        else:
            add("Tanh", [a], n)
        last = list(sizes)[-1]
        if kind in ("Mul", "squares", "outer", "Div"):  # so that nothing grows without end
            add("Tanh", [last], sizes[last])
    wanted = {name: (n,) for name, n in list(sizes.items())[-3:]}
    kept = {f"out_{name}": shape for name, shape in wanted.items()}
    nodes += [("Identity", [name], [f"out_{name}"]) for name in wanted]
    return graph(nodes, kept, **inputs)


@given(model=graphs())
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
def test_any_graph_stays_what_it_is(model: onnx.ModelProto) -> None:
    assert_equal(model, fused(model))


def dependences(item: Item) -> list[Item]:
    """All that an item may use, whatever is chosen."""
    if isinstance(item, FormChoice):
        return list(item.forms.values())
    if isinstance(item, Group):
        return [item.flat(b) for v in item.values.values() if v.affine is not None for b in v.affine.parts]
    return [item.source] if isinstance(item, SelectionPool) else list(item.uses)


def cyclic(model: onnx.ModelProto) -> bool:
    """Whether some choice of forms could make a value depend on itself."""
    _, outputs = fusion.listed(GraphReading(model, factors=True))
    done: set[int] = set()
    open_: set[int] = set()
    stack = [(item, False) for _, item in outputs if isinstance(item, Item)]
    while stack:
        item, left = stack.pop()
        if left:
            open_.discard(id(item))
            done.add(id(item))
        elif id(item) in open_:
            return True
        elif id(item) not in done:
            open_.add(id(item))
            stack.append((item, True))
            for used in dependences(item):
                if id(used) in open_:
                    return True
                stack.append((used, False))
    return False


@given(model=graphs())
@settings(max_examples=50, deadline=None, suppress_health_check=list(HealthCheck))
def test_no_choice_makes_a_value_depend_on_itself(model: onnx.ModelProto) -> None:
    assert not cyclic(model)


def test_what_cancels_does_not_depend_on_what_it_is_part_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """u = v - T t is the part of v that depends on x alone, so v may be computed from u: then u may not from v."""
    rng = np.random.default_rng(0)
    m, t = rng.normal(size=(4, 3)), rng.normal(size=(2, 3))
    model = graph(
        [
            ("Tanh", ["y"], ["t"]),
            ("MatMul", ["t", t], ["tt"]),
            ("Concat", ["x", "t"], ["xt"], {"axis": 0}),
            ("MatMul", ["xt", np.concatenate([m, t])], ["v"]),
            ("Sub", ["v", "tt"], ["u"]),
            ("Tanh", ["v"], ["a"]),
            ("Tanh", ["u"], ["b"]),
        ],
        {"a": (3,), "b": (3,)},
        x=(4,),
        y=(2,),
    )
    assert not cyclic(model)
    assert_equal(model, fused(model))
    monkeypatch.setattr("loopwright.pipeline.export.fusion.forms._before", lambda operand, value: True)
    assert cyclic(model)


# ---------------------------------------------------------------------- pitfalls
def scaled_product(rng: np.random.Generator) -> onnx.ModelProto:
    """Constants of one element beside products that stay products: batched rows."""
    return graph(
        [
            ("Tanh", ["x"], ["h"]),
            ("MatMul", ["h", rng.normal(size=(6, 8))], ["p"]),
            ("Mul", ["p", np.array([0.1])], ["q"]),
            ("Tanh", ["q"], ["r"]),
            ("Mul", ["r", np.array([0.3])], ["s"]),
            ("MatMul", ["s", rng.normal(size=(8, 1))], ["out"]),
        ],
        {"out": (40, 1)},
        x=(40, 6),
    )


@pytest.mark.parametrize("least_saving", [-1.0, 1.0], ids=["fused", "as it is"])
def test_no_factor_is_fused_into_a_float32_attribute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, least_saving: float
) -> None:
    model = scaled_product(np.random.default_rng(0))
    assert narrow(model, tmp_path) == ["FusedMatMul", "FusedMatMul"]  # what the guard is for
    monkeypatch.setattr(fusion, "LEAST_SAVING", least_saving)
    made = fused(model)
    assert narrow(made, tmp_path) == []
    assert_factors_exact(model, made)
    for home in (emission, lone_factors):
        monkeypatch.setattr(home, "apart", lambda nodes, *_: list(nodes))
    assert narrow(fused(model), tmp_path)


def assert_factors_exact(model: onnx.ModelProto, made: onnx.ModelProto) -> None:
    """Against numpy, as the given graph itself is fused in float32."""
    constants = [numpy_helper.to_array(t) for t in model.graph.initializer]
    first, tenth, third, last = constants
    x = np.random.default_rng(1).normal(size=(40, 6))
    wanted = np.tanh(np.tanh(x) @ first * tenth) * third @ last
    np.testing.assert_allclose(results(made, {"x": x})[0], wanted, rtol=1e-13, atol=1e-13)


def test_a_factor_of_one_element_beside_a_product_stays_double(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    model = graph(
        [
            ("Log", ["x"], ["l"]),  # of no group: what may be infinite keeps its operators
            ("MatMul", ["l", rng.normal(size=(5, 1))], ["p"]),
            ("Div", ["p", np.array([0.7])], ["q"]),
            ("Tanh", ["q"], ["out"]),
        ],
        {"out": (1,)},
        x=(5,),
    )
    monkeypatch.setattr(fusion, "LEAST_SAVING", -10.0)
    made = fused(model)
    assert narrow(made, tmp_path) == []
    x = np.array([0.3, 1.2, 2.0, 0.7, 0.5])
    matrix = numpy_helper.to_array(model.graph.initializer[0])
    np.testing.assert_allclose(results(made, {"x": x})[0], np.tanh(np.log(x) @ matrix / 0.7), rtol=1e-14)


def guarded_logarithm() -> onnx.ModelProto:
    """A logarithm of zero that nobody asks for, and values of its level that have nothing to do with it."""
    rng = np.random.default_rng(1)
    return graph(
        [
            ("Log", ["x"], ["l"]),
            ("Tanh", ["y"], ["t"]),
            ("Concat", ["l", "t", "y"], ["all"], {"axis": 0}),
            ("Slice", ["all", np.array([0]), np.array([1])], ["l1"]),
            ("Mul", ["l1", np.array([2.0])], ["l2"]),
            ("Add", ["l2", np.array([1.0])], ["l3"]),
            ("Greater", ["x", np.array([0.0])], ["c"]),
            ("Where", ["c", "l3", np.array([0.0])], ["safe"]),
            ("Slice", ["all", np.array([1]), np.array([9])], ["rest"]),
            ("MatMul", ["rest", rng.normal(size=(8, 4))], ["m"]),
            ("Add", ["m", rng.normal(size=4)], ["n"]),
            ("Abs", ["n"], ["a"]),
            ("MatMul", ["rest", rng.normal(size=(8, 4))], ["o"]),
            ("Tanh", ["o"], ["b"]),
        ],
        {"safe": (1,), "a": (4,), "b": (4,)},
        x=(1,),
        y=(4,),
    )


def test_what_is_infinite_spreads_no_further(monkeypatch: pytest.MonkeyPatch) -> None:
    model = guarded_logarithm()
    made = fused(model)
    assert n_nodes(made) < n_nodes(model)
    for x in (0.0, 2.0):
        assert_equal(model, made, x=np.array([x]))
    monkeypatch.setattr(reading, "RISKS", frozenset())
    at_zero = results(fused(model), {"x": np.zeros(1), "y": np.ones(4)})
    assert not all(np.isfinite(v).all() for v in at_zero)


def test_a_product_with_zero_still_passes_on_what_is_no_number() -> None:
    """A law may write ``+ 0 * pv`` to that end."""
    model = graph(
        [
            ("Mul", ["x", np.zeros(1)], ["none"]),
            ("Add", ["y", np.ones(3)], ["a"]),
            ("Add", ["a", "none"], ["b"]),
            ("Mul", ["b", np.array([2.0, 3.0, 4.0])], ["c"]),
            ("Slice", ["c", np.array([1]), np.array([3])], ["d"]),
            ("Tanh", ["d"], ["out"]),
        ],
        {"out": (2,)},
        x=(1,),
        y=(3,),
    )
    made = fused(model)
    assert_equal(model, made)
    assert np.isnan(results(made, {"x": np.array([np.nan]), "y": np.ones(3)})[0]).all()


def test_values_without_an_axis_keep_none() -> None:
    model = graph(
        [
            ("Gather", ["x", np.array(1)], ["s"]),
            ("Mul", ["s", np.array(3.0)], ["t"]),
            ("Add", ["t", np.array(0.5)], ["u"]),
            ("Max", ["u", np.array(-1.0)], ["v"]),
            ("Min", ["v", np.array(1.0)], ["w"]),
            ("Add", ["w", np.array(0.25)], ["out"]),
            ("Mul", ["w", "x"], ["wx"]),
            ("ReduceSum", ["wx", np.array([0])], ["sum"], {"keepdims": 0}),
        ],
        {"out": (), "sum": ()},
        x=(4,),
    )
    made = fused(model)
    assert "Clip" in {n.op_type for n in made.graph.node}
    assert_equal(model, made)
    constants = {t.name: tuple(t.dims) for t in made.graph.initializer}
    clip = next(n for n in made.graph.node if n.op_type == "Clip")
    assert [constants[name] for name in clip.input[1:]] == [(), ()]


def test_a_batched_product_stays_batched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten candidates through one layer: as one dense product they would be ten times as many multiply-adds."""
    rng = np.random.default_rng(2)
    w = rng.normal(size=(8, 12))
    model = graph(
        [
            ("Tanh", ["x"], ["h"]),
            ("MatMul", ["h", w], ["p"]),
            ("Add", ["p", rng.normal(size=12)], ["q"]),
            ("Tanh", ["q"], ["r"]),
            ("Max", ["r", np.array([-0.5])], ["s"]),
            ("Min", ["s", np.array([0.5])], ["out"]),
        ],
        {"out": (10, 12)},
        x=(10, 8),
    )
    made = fused(model)
    assert n_nodes(made) == n_nodes(model) - 1  # the Clip
    assert max(np.prod(t.dims) for t in made.graph.initializer) == w.size
    assert_equal(model, made)


def test_where_between_a_value_and_zero_keeps_what_may_be_infinite() -> None:
    """As a product it would be 0 x inf."""
    model = graph(
        [
            ("Greater", ["x", np.array([0.0])], ["c"]),
            ("Div", [np.ones(1), "x"], ["d"]),
            ("Where", ["c", "d", np.zeros(1)], ["e"]),
            ("Mul", ["e", np.array([2.0])], ["f"]),
            ("Add", ["f", "x"], ["out"]),
        ],
        {"out": (1,)},
        x=(1,),
    )
    made = fused(model)
    assert_equal(model, made, x=np.zeros(1))
    assert np.isfinite(results(made, {"x": np.zeros(1)})[0]).all()


def test_a_clip_has_one_number_for_all_elements(monkeypatch: pytest.MonkeyPatch) -> None:
    bounds = [np.array([-0.2, -0.4]), np.array([0.3, 0.1])]
    ops: Nodes = [("Max", ["x", bounds[0]], ["a"]), ("Min", ["a", bounds[1]], ["out"])]
    model = graph(ops, {"out": (2,)}, x=(2,))
    assert fused(model) is model
    # And no Clip where the lower bound is the higher one: its order differs.
    crossed = graph(
        [("Max", ["x", np.array([1.0])], ["a"]), ("Min", ["a", np.array([0.5])], ["out"])], {"out": (2,)}, x=(2,)
    )
    assert_equal(crossed, fused(crossed))


def test_a_value_that_is_partly_zero_is_no_copy_of_its_first_element() -> None:
    """Of a vector whose first element does not depend on x, every element looks the same at x = 0 alone."""
    model = graph(
        [
            ("Mul", ["x", np.array([2.0, 3.0])], ["s"]),
            ("Concat", [np.zeros(1), "s"], ["v"], {"axis": 0}),
            ("Mul", ["v", "y"], ["p"]),
            ("Tanh", ["p"], ["out"]),
        ],
        {"out": (3,)},
        x=(2,),
        y=(3,),
    )
    assert_equal(model, fused(model))


# ---------------------------------------------------------------------- as a whole
def test_a_graph_that_gains_nothing_comes_back_as_it_is() -> None:
    model = graph([("Tanh", ["x"], ["t"]), ("Mul", ["t", "x"], ["out"])], {"out": (3,)}, x=(3,))
    assert fused(model) is model


def test_plain_formulas_become_few_products() -> None:
    """A PID in velocity form as a person writes it: eleven affine operators around one limit."""
    model = graph(
        [
            ("Slice", ["state", np.array([0]), np.array([1])], ["y1"]),
            ("Slice", ["state", np.array([1]), np.array([2])], ["y2"]),
            ("Slice", ["state", np.array([2]), np.array([3])], ["e1"]),
            ("Sub", ["sp", "pv"], ["e"]),
            ("Sub", ["e", "e1"], ["p"]),
            ("Mul", ["e", np.array([0.1])], ["i"]),
            ("Mul", ["y1", np.array([2.0])], ["two"]),
            ("Sub", ["pv", "two"], ["d0"]),
            ("Add", ["d0", "y2"], ["d"]),
            ("Mul", ["d", np.array([0.3])], ["dd"]),
            ("Add", ["p", "i"], ["pi"]),
            ("Sub", ["pi", "dd"], ["pid"]),
            ("Mul", ["pid", np.array([1.7])], ["move"]),
            ("Add", ["mv_applied", "move"], ["u"]),
            ("Max", ["u", np.array([0.0])], ["low"]),
            ("Min", ["low", np.array([1.0])], ["mv"]),
            ("Concat", ["pv", "y1", "e"], ["state_next"], {"axis": 0}),
        ],
        {"mv": (1,), "state_next": (3,)},
        sp=(1,),
        pv=(1,),
        mv_applied=(1,),
        state=(3,),
    )
    made = fused(model)
    assert n_nodes(made) <= 6
    assert_equal(model, made)


@pytest.mark.parametrize("path", WITHOUT_QP, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_shipped_graphs_stay_double_and_equal(path: Path, tmp_path: Path) -> None:
    model = onnx.load(path)
    made = fused(model)
    assert narrow(made, tmp_path) == []
    assert n_nodes(made) <= 1.15 * n_nodes(model)
    before, after = session(model), session(made)
    names, rng = [o.name for o in before.get_outputs()], np.random.default_rng(0)
    for _ in range(20):
        feed = {i.name: rng.uniform(0, 1, i.shape) for i in before.get_inputs()}
        for a, b in zip(before.run(names, feed), after.run(names, feed), strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(a).max()))


def test_the_same_graph_gives_the_same_bytes() -> None:
    """In any process: no order comes from an address or a seed of hashing."""
    path = next(p for p in WITHOUT_QP if p.stem == "gauss_newton_pid")
    code = (
        "import hashlib, onnx, sys; from loopwright.pipeline.export.fusion import fused; "
        "print(hashlib.sha256(fused(onnx.load(sys.argv[1])).SerializeToString()).hexdigest())"
    )
    seen = set()
    for seed in ("1", "2"):
        command = [sys.executable, "-c", code, str(path)]
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        seen.add(done.stdout)
    assert len(seen) == 1
    assert fused(onnx.load(path)).SerializeToString() == fused(onnx.load(path)).SerializeToString()


def test_equal_functions_have_one_key() -> None:
    one, two = Affine.block(0, (2,)), Affine.block(1, (2,))
    assert one.key() == Affine.block(0, (2,)).key()
    assert len({one.key(), two.key(), one.times(np.array(2.0)).key(), one.plus(two).key()}) == 4
    assert one.plus(two.times(np.array(-1.0))).plus(two).key() == one.key()
