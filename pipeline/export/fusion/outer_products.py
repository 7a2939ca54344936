"""Rows that a product takes as columns: Gemm turns its first operand itself, without an operator."""

from __future__ import annotations

import onnx
from onnx import helper

from loopwright.pipeline.export.fusion.lone_factors import static_shapes, with_nodes

TURNS = ("Reshape", "Transpose")


def without_turns(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with ``transA`` in each Gemm whose first operand is a row made a column; the same numbers.

    An outer product a' b + C, a step of an elimination, so takes one operator in place of two.
    """
    rows = {n.output[0]: n.input[0] for n in model.graph.node if n.op_type in TURNS}
    columns = [n.output[0] for n in model.graph.node if n.op_type == "Gemm" and n.input[0] in rows and not _turned(n)]
    if not columns:
        return model
    shapes, nodes = static_shapes(model), []
    for node in model.graph.node:
        row = rows[node.input[0]] if node.output[0] in columns else ""
        if len(shapes.get(row, ())) == 2 and shapes[row][0] == 1 and shapes[node.input[0]] == shapes[row][::-1]:
            turned = {a.name: helper.get_attribute_value(a) for a in node.attribute} | {"transA": 1}
            nodes.append(helper.make_node("Gemm", [row, *node.input[1:]], node.output, node.name, **turned))
        else:
            nodes.append(node)
    used = {name for node in nodes for name in node.input} | {o.name for o in model.graph.output}
    return with_nodes(model, [n for n in nodes if n.op_type not in TURNS or n.output[0] in used], {})


def _turned(node: onnx.NodeProto) -> bool:
    return any(a.name == "transA" and a.i for a in node.attribute)
