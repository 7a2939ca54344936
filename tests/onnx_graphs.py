"""Small ONNX graphs, and whether two of them are equal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

Nodes = list[tuple[Any, ...]]


def graph(nodes: Nodes, outputs: dict[str, tuple[int, ...]], **inputs: tuple[int, ...]) -> onnx.ModelProto:
    """A model of nodes (op, inputs, outputs, attributes); an input may be an array."""
    made, constants = [], []
    for op, names, results, *attributes in nodes:
        given = []
        for name in names:
            if not isinstance(name, str):
                constants.append(numpy_helper.from_array(np.asarray(name), f"k{len(constants)}"))
                name = constants[-1].name
            given.append(name)
        made.append(helper.make_node(op, given, results, **(attributes[0] if attributes else {})))
    ends = [[helper.make_tensor_value_info(n, TensorProto.DOUBLE, s) for n, s in e.items()] for e in (inputs, outputs)]
    whole = helper.make_graph(made, "g", *ends, constants)
    model = helper.make_model(whole, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model, full_check=True)
    return model


def session(model: onnx.ModelProto, optimized: Path | None = None, *, plain: bool = False) -> Any:
    """``plain``: the operators as they stand. onnxruntime's own fusion computes some in float32."""
    options = ort.SessionOptions()
    if plain:
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    if optimized is not None:
        options.optimized_model_filepath = str(optimized)
    return ort.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def narrow(model: onnx.ModelProto, folder: Path) -> list[str]:
    """What of onnxruntime's optimized graph computes in float32."""
    path = folder / "optimized.onnx"
    session(model, path)
    optimized = onnx.load(path).graph
    found = [t.name for t in optimized.initializer if t.data_type == TensorProto.FLOAT]
    for node in optimized.node:
        found += [node.op_type for a in node.attribute if a.name == "alpha" and a.f != 1]
        found += [node.op_type for a in node.attribute if a.name == "to" and a.i == TensorProto.FLOAT]
    return found


def results(model: onnx.ModelProto, feed: dict[str, np.ndarray], *, plain: bool = False) -> list[np.ndarray]:
    return session(model, plain=plain).run([o.name for o in model.graph.output], feed)


def assert_equal(model: onnx.ModelProto, made: onnx.ModelProto, steps: int = 5, **fixed: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    onnx.checker.check_model(made, full_check=True)
    for _ in range(steps):
        feed = {i.name: rng.normal(size=[d.dim_value for d in i.type.tensor_type.shape.dim]) for i in model.graph.input}
        for a, b in zip(results(model, feed | fixed, plain=True), results(made, feed | fixed), strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9 * max(1.0, np.nan_to_num(np.abs(a)).max(initial=0)))


def n_nodes(model: onnx.ModelProto) -> int:
    return len(model.graph.node)
