"""A controller's graph for runtimes that want a leading batch dimension: the same step on values of shape (1, n)."""

from __future__ import annotations

import struct

from loopwright.serving.controller_file import seal, unseal
from loopwright.serving.errors import ArtifactError
from loopwright.serving.graph.audit import audit
from loopwright.serving.graph.onnx_bytes import Message, read_model, write_model
from loopwright.serving.graph.work import DOUBLE, INT64


def batch_of_one(data: bytes) -> bytes:
    """The controller file ``data`` with inputs and outputs of shape (1, n) under the same names; sealed as it was.

    A Reshape before and one behind the graph carry the numbers from (1, n) to (n,) and back. They compute nothing, so
    that each result has the bits of the controller's own. The manifest inside is the controller's: its sizes are n.

    Raises ArtifactError for bytes that are no sealed controller.
    """
    body = unseal(data)
    audit(data)
    model = read_model(body)
    graph: Message = model["graph"]
    taken = {name for node in graph["node"] for name in (*node["input"], *node["output"])}
    taken |= {tensor["name"] for tensor in graph.get("initializer", [])}
    renamed = {end["name"]: _free(f"{end['name']}_of_one", taken) for end in (*graph["input"], *graph["output"])}
    for node in graph["node"]:
        node["input"] = [renamed.get(name, name) for name in node["input"]]
        node["output"] = [renamed.get(name, name) for name in node["output"]]
    shapes: list[Message] = []

    def reshaped(name: str, to: str, shape: tuple[int, ...]) -> Message:
        wanted = _free(f"{name}_shape", taken)
        raw = struct.pack(f"<{len(shape)}q", *shape)
        shapes.append({"dims": [len(shape)], "data_type": INT64, "name": wanted, "raw_data": raw})
        return {"input": [name, wanted], "output": [to], "name": f"batch_{to}", "op_type": "Reshape"}

    before = [reshaped(end["name"], renamed[end["name"]], (_size(end),)) for end in graph["input"]]
    behind = [reshaped(renamed[end["name"]], end["name"], (1, _size(end))) for end in graph["output"]]
    graph["node"] = [*before, *graph["node"], *behind]
    graph["initializer"] = [*graph.get("initializer", []), *shapes]
    for which in ("input", "output"):
        graph[which] = [_end(end["name"], _size(end)) for end in graph[which]]
    made = seal(write_model(model))
    audit(made)
    return made


def _size(end: Message) -> int:
    """The length n of an input or output (n,)."""
    dimensions = end["type"]["tensor_type"]["shape"]["dim"]
    if len(dimensions) != 1:
        raise ArtifactError(f"{end['name']} has {len(dimensions)} dimensions; a controller's ends have one")
    return int(dimensions[0]["dim_value"])


def _end(name: str, n: int) -> Message:
    shape = {"dim": [{"dim_value": 1}, {"dim_value": n}]}
    return {"name": name, "type": {"tensor_type": {"elem_type": DOUBLE, "shape": shape}}}


def _free(name: str, taken: set[str]) -> str:
    """A name that no value of the graph has yet; it is taken from then on."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name
