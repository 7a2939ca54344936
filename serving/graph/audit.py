"""The limits of a controller's graph, proved from the file's bytes before any runtime touches them.

A controller runs at a fixed cost with nothing outside its file: no loops or branches, no external
tensors, no functions, only operators of the list, and no more than a stated work a step.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import prod
from typing import Any

from loopwright.serving.errors import ArtifactError
from loopwright.serving.graph.onnx_bytes import Message, read_model
from loopwright.serving.graph.work import BOOL, DOUBLE, ITEM_BYTES, MAX_WORK, RULES, Node, TensorValue, results

MAX_GRAPH_BYTES = 64 * 2**20  # of a controller's file
# onnxruntime simplifies a graph in a time that grows with the square of its operators: seconds for so many. The largest
# law is the predictive one: 3,300 with the longest horizon that the work of a step allows, 2,700 with ten passes.
MAX_NODES = 6_000
MIN_IR, MAX_IR = 8, 10  # newer ones fail to load in today's runtimes
MIN_OPSET, MAX_OPSET = 18, 21  # the shape rules of graph_work are theirs
ALLOWED_OPS = frozenset(RULES)
# AttributeProto.type -> the one field that then holds the value, and whether it is a list.
ATTRIBUTE_FIELDS = {
    1: ("f", False), 2: ("i", False), 3: ("s", False), 6: ("floats", True), 7: ("ints", True), 8: ("strings", True)
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class GraphSummary:
    """Content of the file: versions, operators with their counts, metadata, and the work of a step.

    ``work`` is an upper bound in multiply-adds: those of products of matrices, and 32 for each
    element that any operator reads or writes, 4 where it only copies them.
    """

    ir_version: int
    opset: int
    ops: dict[str, int]
    metadata: dict[str, str]
    work: int

    @property
    def nodes(self) -> int:
        """Number of operators in the graph."""
        return sum(self.ops.values())


def audit(data: bytes) -> GraphSummary:
    """The summary of an ONNX file's bytes; ArtifactError where a controller may not look so.

    Refused: a file over 64 MiB; bytes that are not a protobuf in canonical form, or hold a field
    that no controller has; IR outside 8 to 10 or opset outside 18 to 21; an operator off the list;
    a subgraph, a function, training data, sparse or external tensors; values without a static
    shape; more than 6,000 operators; a step of more than 20 million multiply-adds.
    """
    if len(data) > MAX_GRAPH_BYTES:
        raise ArtifactError(f"the file has {len(data)} bytes; a controller has at most {MAX_GRAPH_BYTES}")
    try:
        model = read_model(data)
    except ValueError as error:
        raise ArtifactError(f"the file is not an ONNX model as the exporter writes it: {error}") from error
    if "graph" not in model:
        raise ArtifactError("the file is not an ONNX model: it has no graph")
    ir, opset = model.get("ir_version", 0), _opset(model)
    if not MIN_IR <= ir <= MAX_IR or not MIN_OPSET <= opset <= MAX_OPSET:
        raise ArtifactError(
            f"IR {ir}, opset {opset}: this runtime reads IR {MIN_IR} to {MAX_IR}, opset {MIN_OPSET} to {MAX_OPSET}"
        )
    nodes = model["graph"].get("node", [])
    if len(nodes) > MAX_NODES:
        raise ArtifactError(f"the graph has {len(nodes)} operators; a controller has at most {MAX_NODES}")
    _, work = graph_values(model["graph"])
    ops = Counter(node["op_type"] for node in nodes)
    return GraphSummary(ir, opset, dict(ops.most_common()), _metadata(model), work)


def _opset(model: Message) -> int:
    imports = model.get("opset_import", [])
    if len(imports) != 1 or imports[0].get("domain", "") not in ("", "ai.onnx"):
        named = ", ".join(repr(o.get("domain", "")) for o in imports) or "none"
        raise ArtifactError(f"the file imports the operator sets {named}; a controller imports that of ONNX alone")
    return int(imports[0].get("version", 0))


def _metadata(model: Message) -> dict[str, str]:
    entries = [(e.get("key", ""), e.get("value", "")) for e in model.get("metadata_props", [])]
    metadata = dict(entries)
    if len(metadata) < len(entries):
        raise ArtifactError("the file has a metadata entry twice")
    return metadata


def graph_values(graph: Message) -> tuple[dict[str, TensorValue], int]:
    """Every value of the graph, by its name, and the work of a step in multiply-adds.

    Raises ArtifactError where an operator is off the list, a value's shape cannot be known, or the
    work exceeds MAX_WORK.
    """
    values: dict[str, TensorValue] = {}
    for tensor in graph.get("initializer", []):
        _define(values, tensor.get("name", ""), _constant(tensor))
    for given in graph.get("input", []):
        _define(values, given.get("name", ""), _end(given))
    work = 0
    for row in graph.get("node", []):
        op, attributes = _operator(row)
        missing = [name for name in row.get("input", []) if name and name not in values]
        if missing:
            raise ArtifactError(f"operator {op} reads {missing[0]!r}, which nothing before it gives")
        names = row.get("output", [])
        node = Node(op, tuple(values.get(name) for name in row.get("input", [])), attributes, len(names))
        try:
            outputs, cost = results(node)
        except ValueError as error:
            raise ArtifactError(f"operator {op} ({row.get('name', '')!r}): {error}") from error
        work += cost
        if work > MAX_WORK:
            raise ArtifactError(
                f"a step takes more than {MAX_WORK} multiply-adds, which operator {op} ({row.get('name', '')!r}) "
                "exceeds; a controller computes a step in far less than a second"
            )
        for name, value in zip(names, outputs, strict=True):
            _define(values, name, value)
    for wanted in graph.get("output", []):
        name = wanted.get("name", "")
        if name not in values:
            raise ArtifactError(f"the graph's output {name!r} is computed nowhere")
        if values[name].shape != _end(wanted).shape:
            raise ArtifactError(f"the graph's output {name!r} has not the shape {values[name].shape} that it says")
    return values, work


def _define(values: dict[str, TensorValue], name: str, value: TensorValue) -> None:
    if not name or name in values:
        raise ArtifactError(f"the graph gives the value {name!r} twice" if name else "a value has no name")
    values[name] = value


def _constant(tensor: Message) -> TensorValue:
    """An initializer as a value; its bytes must be as many as its shape asks."""
    name = tensor.get("name", "")
    if "external_data" in tensor or "data_location" in tensor:
        raise ArtifactError(f"tensor {name!r} lies outside the file; a controller is one file")
    shape, dtype, raw = tuple(tensor.get("dims", [])), tensor.get("data_type", 0), tensor.get("raw_data", b"")
    if dtype not in ITEM_BYTES:
        raise ArtifactError(f"tensor {name!r} has the type {dtype}; allowed are {', '.join(map(str, ITEM_BYTES))}")
    if any(not 0 <= n <= MAX_GRAPH_BYTES for n in shape) or prod(shape) * ITEM_BYTES[dtype] != len(raw):
        raise ArtifactError(f"tensor {name!r} has the shape {shape} and {len(raw)} bytes, which do not fit together")
    if dtype == BOOL and raw.strip(b"\0\1"):
        raise ArtifactError(f"tensor {name!r} holds truth values other than 0 and 1")
    return TensorValue(shape, dtype, raw)


def _end(row: Message) -> TensorValue:
    """An input or an output of the graph as a value: its lengths must be numbers."""
    tensor = row.get("type", {}).get("tensor_type", {})
    dims = [d.get("dim_value", -1) for d in tensor.get("shape", {}).get("dim", [])]
    if "shape" not in tensor or any(not 0 <= n <= MAX_WORK for n in dims):
        raise ArtifactError(f"{row.get('name', '')!r} has no fixed shape of lengths up to {MAX_WORK}")
    return TensorValue(tuple(dims), tensor.get("elem_type", DOUBLE))


def _operator(row: Message) -> tuple[str, dict[str, Any]]:
    """The operator's name and attributes; ArtifactError if it is off the list or holds more than numbers and text."""
    op, domain = row.get("op_type", ""), row.get("domain", "")
    if domain not in ("", "ai.onnx") or op not in ALLOWED_OPS:
        name = f"{domain}.{op}" if domain else op
        raise ArtifactError(f"operator {name} is not on the list of what a controller may compute")
    attributes: dict[str, Any] = {}
    for attribute in row.get("attribute", []):
        name = attribute.get("name", "")
        if "g" in attribute or "graphs" in attribute:
            raise ArtifactError(f"operator {op} holds a subgraph; a controller has a fixed cost")
        field, repeated = ATTRIBUTE_FIELDS.get(attribute.get("type", 0), ("", False))
        held = set(attribute) | ({field} if repeated else set())  # an empty list leaves no trace
        if name in attributes or held != {"name", "type", field}:
            raise ArtifactError(f"operator {op} has the attribute {name!r} twice, or its value is not of its type")
        attributes[name] = attribute.get(field, [])
    return op, attributes
