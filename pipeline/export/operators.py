"""The operators that a law's graph may have."""

from __future__ import annotations

import onnx

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.laws.base import ControlLaw
from loopwright.serving.errors import ArtifactError
from loopwright.serving.graph.audit import audit

# Behind these a value is no longer a transposed matrix.
RESHAPING = frozenset({"Flatten", "Gather", "Gemm", "MatMul", "Reshape", "Squeeze"})


def check_operators(law: ControlLaw, proto: onnx.ModelProto) -> None:
    """ExportError for an operator off the list, a transposed product or a float32 value."""
    try:
        audit(proto.SerializeToString())
    except ArtifactError as error:
        raise ExportError(f"law {law.name!r}: {error}") from error
    products = _transposed_products(proto.graph)
    if products:
        raise ExportError(
            f"law {law.name!r}: {products[0]} multiplies a transposed matrix, which onnxruntime below 1.26 refuses; "
            "write the product as a sum, (a * b).sum(-1), or keep the matrix transposed in a buffer"
        )
    narrow = {onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16, onnx.TensorProto.BFLOAT16}
    casts = [a.i for n in proto.graph.node if n.op_type == "Cast" for a in n.attribute if a.name == "to"]
    if narrow & {*casts, *(t.data_type for t in proto.graph.initializer)}:
        raise ExportError(f"law {law.name!r} computes in float32 somewhere; make its constants and casts float64")


def _transposed_products(graph: onnx.GraphProto) -> list[str]:
    """Names of the matrix products that onnxruntime may fuse with a Transpose into its own FusedMatMul.

    The Transpose need not stand beside the product: onnxruntime moves it behind operators that have
    transposed operands alone.
    """
    transposed: set[str] = set()
    constants = {tensor.name for tensor in graph.initializer}
    products = []
    for node in graph.node:  # in the order of computation
        operands = set(node.input) - constants - {""}
        if node.op_type == "MatMul" and not transposed.isdisjoint(node.input):
            products.append(node.name)
        drops_axis = any(a.name == "keepdims" and a.i == 0 for a in node.attribute)
        passes_on = operands and operands <= transposed and node.op_type not in RESHAPING and not drops_axis
        if node.op_type == "Transpose" or passes_on:
            transposed.update(node.output)
    return products
