"""Factors of one element beside a matrix product, which onnxruntime would take into the product in float32."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import prod
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from loopwright.pipeline.errors import ExportError

Array = NDArray[Any]


def apart(
    nodes: Iterable[onnx.NodeProto],
    values: Mapping[str, Array],
    shapes: Mapping[str, tuple[int, ...]],
    constant: Callable[[Array], str],
) -> list[onnx.NodeProto]:
    """The nodes, with no constant of one element beside a MatMul: onnxruntime would fuse the two in float32.

    Its FusedMatMul has a factor ``alpha``, which is a float32 attribute. A factor of several elements is written out
    for each; a factor of one element becomes a product with a 1 x 1 matrix. ``values`` are the constants by name,
    ``shapes`` those of what nodes give, and ``constant`` makes a new one and gives its name.
    """
    nodes = list(nodes)
    products = {n.output[0] for n in nodes if n.op_type == "MatMul"}
    multiplied = {name for n in nodes if n.op_type == "MatMul" for name in n.input}
    found = []
    for node in nodes:
        beside = node.op_type in ("Mul", "Div") and bool(
            node.output[0] in multiplied or products.intersection(node.input)
        )
        places = [i for i, name in enumerate(node.input) if name in values and values[name].size == 1]
        shape = shapes.get(node.output[0], ())
        if not beside or not places or (node.op_type == "Div" and places == [0]) or shape == ():
            found.append(node)
            continue
        name, factor = node.input[1 - places[0]], values[node.input[places[0]]].reshape(())
        if prod(shape) > 1:
            inputs = [name, name]
            inputs[places[0]] = constant(np.full(shape, factor))
            found.append(helper.make_node(node.op_type, inputs, node.output))
        else:
            factor = 1 / factor if node.op_type == "Div" else factor
            found.append(helper.make_node("MatMul", [name, constant(np.array([[factor]]))], node.output))
    return found


def static_shapes(model: onnx.ModelProto) -> dict[str, tuple[int, ...]]:
    """Shape of each value but the constants. ExportError where one is not static."""
    inferred = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph
    shapes = {}
    for value in (*inferred.input, *inferred.value_info, *inferred.output):
        lengths = [d.dim_value for d in value.type.tensor_type.shape.dim]
        if not all(lengths):
            raise ExportError(f"the graph's value {value.name} has no static shape; every shape must be one")
        shapes[value.name] = tuple(lengths)
    return shapes


def with_nodes(model: onnx.ModelProto, nodes: list[onnx.NodeProto], new: Mapping[str, Array]) -> onnx.ModelProto:
    """The model of other ``nodes``, with ``new`` constants by name behind those of the old ones that it still uses."""
    found = onnx.ModelProto()
    found.CopyFrom(model)
    del found.graph.node[:]
    found.graph.node.extend(nodes)
    used = {name for node in nodes for name in node.input} | {o.name for o in found.graph.output}
    kept = [i for i in model.graph.initializer if i.name in used]
    del found.graph.initializer[:]
    found.graph.initializer.extend([*kept, *(numpy_helper.from_array(v, name) for name, v in new.items())])
    return found


def with_factors_apart(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model after ``apart``; itself where it has no such factor. ExportError where a shape is not static."""
    values = {i.name: numpy_helper.to_array(i) for i in model.graph.initializer}
    new: dict[str, Array] = {}

    def constant(value: Array) -> str:
        name = f"factor_{len(new)}"
        new[name] = value
        return name

    nodes = apart(model.graph.node, values, static_shapes(model), constant)
    return with_nodes(model, nodes, new) if new else model
