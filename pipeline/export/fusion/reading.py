"""A graph as blocks (inputs, results of nonlinear operators) and the affine functions of them between these."""

from __future__ import annotations

from math import inf, prod
from typing import Any

import onnx
from onnx import helper, numpy_helper

from loopwright.pipeline.export.fusion import intervals, normal_form
from loopwright.pipeline.export.fusion.affine import DENSE, Affine, Array, Attributes, Shape, applied
from loopwright.pipeline.export.fusion.prices import OUTPUT, price
from loopwright.pipeline.export.fusion.values import Block, Operand, Origin, Value
from loopwright.serving.graph.audit import graph_values
from loopwright.serving.graph.onnx_bytes import read_model

DOUBLE = onnx.TensorProto.DOUBLE
OWN = ""  # the name of a value that the graph does not have; it is a double
# What these give may be infinite or no number, and so may what is made of that, but for what the guards give of it.
RISKS = frozenset({"Div", "Log", "Exp", "Pow", "Sqrt", "Reciprocal", "Tan"})
GUARDS = frozenset({"Where", "Clip", "Min", "Max", "Tanh", "Sigmoid", "Softmax", "Sign"})


class Reading:
    """The graph, read. ``price_before`` is what its operators cost [ns]; without ``factors`` products keep theirs.

    ``without_factors`` says whether any product had one to lose, so that the two readings may differ.
    """

    def __init__(self, model: onnx.ModelProto, *, factors: bool) -> None:
        graph = model.graph
        found, _ = graph_values(read_model(model.SerializeToString())["graph"])
        self._shapes = {name: v.shape for name, v in found.items()}
        self._types = {OWN: DOUBLE, **{name: v.dtype for name, v in found.items()}}
        self._factors, self.without_factors = factors, False
        self._known: dict[Any, Value] = {}
        self._computed: dict[Any, list[Value]] = {}
        self._sliced: set[str] = set()
        self.blocks: list[Block] = []
        self.values: list[Value] = []
        self.price_before = 0.0
        self.names: dict[str, Operand] = {"": None}
        for tensor in graph.initializer:
            self.names[tensor.name] = numpy_helper.to_array(tensor)
        for given in graph.input:
            self.names[given.name] = self._of_block(self._block(given.name, self._shapes[given.name]))
        for node in graph.node:
            self._read(node)
        self.outputs = [(o.name, self.names[o.name]) for o in graph.output]

    # ------------------------------------------------------------------ values
    def value(self, affine: Affine, origin: Origin | None = None) -> Value:
        """The value of an affine function, the same for equal functions."""
        key = affine.key()
        if key not in self._known:
            level = max((self.blocks[b].level for b in affine.parts), default=-1)
            self._known[key] = Value(len(self.values), affine.shape, level, affine, None, origin)
            self.values.append(self._known[key])
        return self._known[key]

    def risky(self, value: Value) -> bool:
        """Whether a value may be infinite or no number while the inputs are finite."""
        if value.affine is None:
            return value.block is not None and value.block.risky
        return any(self.blocks[b].risky for b in value.affine.parts)

    def _block(self, name: str, shape: Shape, **more: Any) -> Block:
        block = Block(len(self.blocks), name, shape, **more)
        self.blocks.append(block)
        return block

    def _of_block(self, block: Block) -> Value:
        """The value that is a block."""
        if self._types[block.name] == DOUBLE and 0 < prod(block.shape) ** 2 <= DENSE:
            return self.value(Affine.block(block.number, block.shape))
        value = Value(len(self.values), block.shape, block.level, None, block)
        self.values.append(value)
        return value

    # ------------------------------------------------------------------ operators
    def _read(self, node: onnx.NodeProto) -> None:
        op, names = node.op_type, list(node.output)
        attributes = {a.name: helper.get_attribute_value(a) for a in node.attribute}
        operands = [self.names[n] for n in node.input]
        shapes = [self._shapes[n] for n in names]
        if op == "Slice" and node.input[0] in self._sliced:
            self.price_before += OUTPUT  # onnxruntime makes one Split of them
        else:
            self.price_before += price(op, [self._shapes[n] for n in node.input if n], shapes)
        if op == "Slice":
            self._sliced.add(node.input[0])
        results = self._affine(op, attributes, operands, names, shapes)
        if results is None:
            results = self.computed(op, attributes, operands, names, shapes)
        self.names.update(zip(names, results, strict=True))

    def _affine(
        self, op: str, attributes: Attributes, operands: list[Operand], names: list[str], shapes: list[Shape]
    ) -> list[Value] | None:
        """The outputs of an operator as affine functions; None where they are not, or have too large matrices."""
        if any(self._types[n] != DOUBLE for n in names):
            return None
        if op == "Where":
            switched = normal_form.switched(self, operands, shapes[0])
            return None if switched is None else [switched]
        if any(isinstance(o, Value) and o.affine is None for o in operands):
            return None
        arguments = [o.affine if isinstance(o, Value) else o for o in operands]
        blocks = {b: len(m) for a in arguments if isinstance(a, Affine) for b, m in a.parts.items()}
        if not blocks or sum(blocks.values()) * max(map(prod, shapes)) > DENSE:
            return None
        results = applied(op, attributes, arguments, shapes)
        if results is None:
            return None
        return [self.value(r, Origin(op, operands, attributes, shapes, i)) for i, r in enumerate(results)]

    def computed(
        self, op: str, attributes: Attributes, operands: list[Operand], names: list[str], shapes: list[Shape]
    ) -> list[Value]:
        """The outputs of an operator that is computed as it stands, the same for equal ones."""
        factor: Array | None = None
        operands = normal_form.narrowed(self, op, operands, shapes[0])
        if op == "MatMul":
            found = normal_form.by_vector(self, operands, shapes[0])
            if found is not None:
                return [found]
        if self._factors and op in ("Mul", "Div"):
            known = len(self.values)
            operands, factor = normal_form.without_factors(self, op, operands, shapes[0])
            self.without_factors |= factor is not None or len(self.values) > known
        if op == "Min":
            op, operands, attributes = normal_form.clipped(self, operands, attributes, shapes[0])
        key = (op, tuple(map(_key, operands)), tuple(sorted((k, str(v)) for k, v in attributes.items())))
        if key not in self._computed:
            self._computed[key] = self._made(op, attributes, operands, names, shapes)
        results = self._computed[key]
        if factor is None:
            return results
        affine = results[0].affine
        assert affine is not None
        return [self.value(affine.times(factor))]

    def _made(
        self, op: str, attributes: Attributes, operands: list[Operand], names: list[str], shapes: list[Shape]
    ) -> list[Value]:
        """New blocks."""
        used = [o for o in operands if isinstance(o, Value)]
        level = 1 + max((v.level for v in used), default=-1)
        given = [intervals.interval(o, self.blocks) for o in operands]
        risky = op in RISKS and not intervals.finite(op, given)
        risky = risky or (op not in GUARDS and any(map(self.risky, used)))
        low, high = intervals.bounds(op, operands, given)
        blocks = [self._block(n, s, op=op, level=level, risky=risky) for n, s in zip(names, shapes, strict=True)]
        for block in blocks:
            block.operands, block.attributes, block.siblings = operands, attributes, blocks
            block.low, block.high = (-inf, inf) if risky else (low, high)
        if op == "Where" and self._types[names[0]] == DOUBLE:
            blocks[0].wide = normal_form.wide(self, operands, shapes[0])
        return [self._of_block(b) for b in blocks]


def _key(operand: Operand) -> Any:
    if operand is None:
        return None
    if isinstance(operand, Value):
        return operand.number
    return (operand.dtype.str, operand.shape, operand.tobytes())
