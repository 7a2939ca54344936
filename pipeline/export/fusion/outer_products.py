"""Rows that a product takes as columns: Gemm turns its first operand itself, without an operator."""

from __future__ import annotations

import onnx
from onnx import helper, shape_inference

TURNS = ("Reshape", "Transpose")


def without_turns(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with ``transA`` in each Gemm whose first operand is a row made a column; the same numbers.

    An outer product a' b + C, a step of an elimination, so takes one operator in place of two.
    """
    made = {o: n for n in model.graph.node for o in n.output}
    found = []
    for node in model.graph.node:
        turn = made.get(node.input[0]) if node.op_type == "Gemm" else None
        if turn is not None and turn.op_type in TURNS and not _turned(node):
            found.append((node, turn.input[0]))
    if not found:
        return model
    inferred = shape_inference.infer_shapes(model, strict_mode=True, data_prop=True).graph
    shapes = {
        v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in (*inferred.value_info, *inferred.input)
    }
    done = onnx.ModelProto()
    done.CopyFrom(model)
    of = {node.output[0]: node for node in done.graph.node}
    for node, row in found:
        length = shapes.get(row, [])
        if length[:1] == [1] and shapes.get(node.input[0]) == length[::-1]:
            of[node.output[0]].input[0] = row
            others = [a for a in node.attribute if a.name != "transA"]
            del of[node.output[0]].attribute[:]
            of[node.output[0]].attribute.extend([*others, helper.make_attribute("transA", 1)])
    used = {name for node in done.graph.node for name in node.input} | {o.name for o in done.graph.output}
    kept = [n for n in done.graph.node if n.op_type not in TURNS or n.output[0] in used]
    del done.graph.node[:]
    done.graph.node.extend(kept)
    used = {name for node in kept for name in node.input}
    constants = [i for i in done.graph.initializer if i.name in used]
    del done.graph.initializer[:]
    done.graph.initializer.extend(constants)
    return done


def _turned(node: onnx.NodeProto) -> bool:
    return any(a.name == "transA" and a.i for a in node.attribute)
