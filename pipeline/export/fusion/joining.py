"""Networks that stand side by side, evaluated layer by layer together."""

from __future__ import annotations

from collections import defaultdict
from math import prod

import numpy as np
import onnx
from onnx import helper, numpy_helper

from loopwright.pipeline.export.fusion.affine import DENSE, Shape
from loopwright.serving.graph.audit import graph_values
from loopwright.serving.graph.onnx_bytes import read_model

JOINED = "Tanh"
MARK = "joined"  # in the names of what is added


def joined(model: onnx.ModelProto) -> onnx.ModelProto | None:
    """The same function with one Tanh for all those that no other one stands between; None where there is one a layer.

    Layers of two networks that wait for nothing but the layers before become one layer of both: what is
    affine between them is one product then, and onnxruntime calls half as many operators.
    """
    values, _ = graph_values(read_model(model.SerializeToString())["graph"])
    layers = _layers(model.graph)
    groups = [g for nodes in layers for g in _within(nodes, {n: v.shape for n, v in values.items()})]
    if not groups:
        return None
    made = onnx.ModelProto()
    made.CopyFrom(model)
    del made.graph.node[:]
    replaced = {id(node) for group in groups for node, _ in group}
    nodes = [node for node in model.graph.node if id(node) not in replaced]
    for k, group in enumerate(groups):
        nodes += _side_by_side(made.graph, f"{MARK}{k}", group)
    made.graph.node.extend(_in_order(made.graph, nodes))
    return made


def _layers(graph: onnx.GraphProto) -> list[list[onnx.NodeProto]]:
    """The nodes to join by how many of them stand before; none depends on another of the same number."""
    depth: dict[str, int] = defaultdict(int)
    found: dict[int, list[onnx.NodeProto]] = defaultdict(list)
    for node in graph.node:
        before = max((depth[name] for name in node.input), default=0)
        if node.op_type == JOINED:
            found[before].append(node)
        for name in node.output:
            depth[name] = before + (node.op_type == JOINED)
    return [found[k] for k in sorted(found)]


def _within(nodes: list[onnx.NodeProto], shapes: dict[str, Shape]) -> list[list[tuple[onnx.NodeProto, Shape]]]:
    """The nodes of a layer in groups of two or more, each small enough for a matrix of its own."""
    groups: list[list[tuple[onnx.NodeProto, Shape]]] = [[]]
    size = 0
    for node in nodes:
        shape = shapes[node.output[0]]
        if (size + prod(shape)) ** 2 > DENSE:
            groups.append([])
            size = 0
        groups[-1].append((node, shape))
        size += prod(shape)
    return [group for group in groups if len(group) > 1]


def _side_by_side(graph: onnx.GraphProto, name: str, group: list[tuple[onnx.NodeProto, Shape]]) -> list[onnx.NodeProto]:
    """One node for all, on a vector of all their elements; its constants go into the graph."""

    def constant(label: str, numbers: list[int]) -> str:
        graph.initializer.append(numpy_helper.from_array(np.array(numbers, dtype=np.int64), f"{name}_{label}"))
        return f"{name}_{label}"

    lengths = constant("lengths", [prod(shape) for _, shape in group])
    flat, pieces, nodes = [], [], []
    for i, (node, shape) in enumerate(group):
        flat.append(f"{name}_in{i}")
        pieces.append(f"{name}_out{i}")
        nodes += [
            helper.make_node("Reshape", [node.input[0], constant(f"length{i}", [prod(shape)])], [flat[-1]]),
            helper.make_node("Reshape", [pieces[-1], constant(f"shape{i}", list(shape))], [node.output[0]]),
        ]
    return [
        *nodes,
        helper.make_node("Concat", flat, [f"{name}_all"], axis=0),
        helper.make_node(JOINED, [f"{name}_all"], [f"{name}_of_all"]),
        helper.make_node("Split", [f"{name}_of_all", lengths], pieces, axis=0),
    ]


def _in_order(graph: onnx.GraphProto, nodes: list[onnx.NodeProto]) -> list[onnx.NodeProto]:
    """Each node behind those whose results it takes."""
    known = {"", *(v.name for v in (*graph.input, *graph.initializer))}
    found: list[onnx.NodeProto] = []
    while nodes:
        later = []
        for node in nodes:
            if known.issuperset(node.input):
                found.append(node)
                known.update(node.output)
            else:
                later.append(node)
        nodes = later
    return found
