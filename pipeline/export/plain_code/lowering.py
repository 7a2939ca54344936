"""From a controller's ONNX graph to statements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import prod
from typing import Any, ClassVar

import numpy as np
import onnx
from onnx import numpy_helper

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.plain_code.elementary import GRID, MOST_SUMMED
from loopwright.pipeline.export.plain_code.interpreter import run_statement
from loopwright.pipeline.export.plain_code.statements import OUTPUT, Floats, Place, Places, PlainProgram, PlainStatement
from loopwright.pipeline.export.plain_code.views import View

ONE_OF_ONE = {
    "Abs": "abs", "Exp": "exp", "Log": "log", "Neg": "neg", "Not": "not", "Sign": "sign", "Sqrt": "sqrt",
    "Tanh": "tanh",
}  # fmt: skip
ONE_OF_TWO = {
    "Add": "add", "And": "and", "Div": "div", "Equal": "equal", "Greater": "greater", "GreaterOrEqual": "greater_equal",
    "Less": "less", "LessOrEqual": "less_equal", "Mul": "mul", "Or": "or", "Sub": "sub",
}  # fmt: skip
WHOLE = (onnx.TensorProto.BOOL, onnx.TensorProto.INT64, onnx.TensorProto.INT32)
REDUCED = {"ReduceSum": "sum", "ReduceSumSquare": "sum_squares", "ReduceMax": "largest", "ReduceMin": "least"}


class Lowering:
    """A graph's statements, node by node; views of one array cost nothing."""

    def __init__(self, model: onnx.ModelProto) -> None:
        graph = onnx.shape_inference.infer_shapes(model).graph
        self.types = {v.name: v.type.tensor_type.elem_type for v in (*graph.value_info, *graph.input, *graph.output)}
        self.types |= {c.name: c.data_type for c in graph.initializer}
        self.constants: dict[str, Floats] = {}
        self.tables: dict[str, Places] = {}
        self.arrays: dict[str, int] = {}
        self.statements: list[PlainStatement] = []
        self.views: dict[str, View] = {}
        self.integers: dict[str, Places] = {}  # shapes, axes and indices
        for given in graph.initializer:
            self._hold(given.name, numpy_helper.to_array(given))
        self.inputs = {i.name: _count(i) for i in graph.input}
        for name, count in self.inputs.items():
            self.views[name] = View.whole(name, (count,))
        for node in graph.node:
            self._lower(node)
        self.outputs = {o.name: _count(o) for o in graph.output}
        for name, count in self.outputs.items():
            view = self.views[name]
            target = View.whole(OUTPUT + name, view.shape)
            assert prod(view.shape) == count
            self._emit("copy", target, [view])

    def program(self) -> PlainProgram:
        """All of it."""
        outputs = {OUTPUT + name: n for name, n in self.outputs.items()}
        used = {p.buffer for s in self.statements for p in s.args}
        constants = {name: values for name, values in self.constants.items() if name in used}
        return PlainProgram(self.inputs, outputs, constants, self.tables, self.arrays, tuple(self.statements))

    # ------------------------------------------------------------------------------------------------ arrays and views
    def _hold(self, name: str, values: np.ndarray[Any, Any]) -> View:
        """A constant; of integers also its numbers."""
        if values.dtype.kind in "iu":
            self.integers[name] = values.astype(np.int64)
        held = f"c{len(self.constants)}"
        self.constants[held] = values.astype(np.float64).ravel()
        self.views[name] = View.whole(held, values.shape)
        return self.views[name]

    def _new(self, shape: Sequence[int]) -> View:
        name = f"t{len(self.arrays)}"
        self.arrays[name] = prod(shape)
        return View.whole(name, shape)

    def _emit(self, op: str, target: View, args: Sequence[View], table: str = "") -> None:
        """``target`` = op(args), all as large as the target."""
        places = [a.broadcast(target.shape).place() for a in args]
        if table:
            places[0] = replace(places[0], table=table)
        self._add(PlainStatement(op, target.place(), tuple(places), target.shape))

    def _add(self, statement: PlainStatement) -> None:
        """A statement; one of constants alone is done at once and is a constant itself."""
        buffer = statement.target.buffer
        if buffer in self.arrays and all(p.buffer in self.constants for p in statement.args):
            self.constants[buffer] = np.zeros(self.arrays.pop(buffer))
        if buffer in self.constants:
            run_statement(statement, self.constants, self.tables)
            return
        self.statements.append(statement.simplified())

    def _dense(self, view: View) -> View:
        """The same entries one after the other."""
        if view.dense:
            return view
        target = self._new(view.shape)
        self._emit("copy", target, [view])
        return target

    # ----------------------------------------------------------------------------------------------------------- nodes
    def _lower(self, node: onnx.NodeProto) -> None:
        """Add what a node does, and where its outputs lie."""
        given = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        try:
            if node.op_type == "Constant":
                self._hold(node.output[0], numpy_helper.to_array(given["value"]))
                return
            args = [self.views[name] for name in node.input if name]
            made = self._made(node, args, given)
        except KeyError as error:
            raise ExportError(
                f"operator {node.op_type} ({node.name or node.output[0]}) has no plain statements here: {error}; laws"
                f" are made of {', '.join(sorted({*ONE_OF_ONE, *ONE_OF_TWO, *REDUCED, *self._others}))}"
            ) from error
        for name, view in zip(node.output, made, strict=False):
            self.views[name] = view

    def _made(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        kind = node.op_type
        if kind in ONE_OF_ONE:
            return [self._each(ONE_OF_ONE[kind], args)]
        if kind in ONE_OF_TWO:
            return [self._each(ONE_OF_TWO[kind], args)]
        if kind in ("Max", "Min"):
            found = args[0]
            for other in args[1:]:
                found = self._each(kind.lower(), [found, other])
            return [found]
        if kind in REDUCED:
            return [self._reduced(REDUCED[kind], node, args[0], given)]
        return self._others[kind](self, node, args, given)

    def _each(self, op: str, args: Sequence[View]) -> View:
        target = self._new(np.broadcast_shapes(*(a.shape for a in args)))
        self._emit(op, target, args)
        return target

    def _ints(self, node: onnx.NodeProto, place: int) -> list[int]:
        """The integers that a node's input holds."""
        return [int(i) for i in self.integers[node.input[place]].ravel()]

    def _axes(self, node: onnx.NodeProto, view: View, given: dict[str, Any]) -> list[int]:
        axes = given.get("axes")
        if axes is None:
            axes = self._ints(node, 1) if len(node.input) > 1 and node.input[1] else range(len(view.shape))
        return sorted(a % len(view.shape) for a in axes)

    def _reduced(self, op: str, node: onnx.NodeProto, view: View, given: dict[str, Any]) -> View:
        axes = self._axes(node, view, given)
        found = self._together(op, view, axes)
        if given.get("keepdims", 1):
            return found
        return found.without(axes)

    def _together(self, op: str, view: View, axes: Sequence[int]) -> View:
        """Entries along ``axes`` put together; the axes stay, with one entry each."""
        held = [d for d in range(len(view.shape)) if d not in axes]
        order = [*held, *axes]
        target = self._new([1 if d in axes else n for d, n in enumerate(view.shape)])
        strides = tuple(0 if d in axes else target.strides[d] for d in order)
        read = Place(view.buffer, view.offset, tuple(view.strides[d] for d in order))
        loops = tuple(view.shape[d] for d in order)
        self._add(PlainStatement(op, Place(target.buffer, target.offset, strides), (read,), loops, len(axes)))
        return target

    def _product(self, a: View, b: View, added: View | None = None) -> View:
        """A b + added over the last two dimensions, the others repeated."""
        single = (len(a.shape) == 1, len(b.shape) == 1)
        a = replace(a, shape=(1, *a.shape), strides=(0, *a.strides)) if single[0] else a
        b = replace(b, shape=(*b.shape, 1), strides=(*b.strides, 0)) if single[1] else b
        batch = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
        rows, inner, columns = a.shape[-2], a.shape[-1], b.shape[-1]
        target = self._new((*batch, rows, columns))
        a, b = a.broadcast((*batch, rows, inner)), b.broadcast((*batch, inner, columns))
        held, (row, across), (down, column) = a.strides[:-2], a.strides[-2:], b.strides[-2:]
        args = [
            Place(a.buffer, a.offset, (*held, row, 0, across)),
            Place(b.buffer, b.offset, (*b.strides[:-2], 0, column, down)),
        ]
        if added is not None:
            c = added.broadcast(target.shape)
            args.append(Place(c.buffer, c.offset, (*c.strides, 0)))
        at = Place(target.buffer, target.offset, (*target.strides, 0))
        self._add(PlainStatement("dot", at, tuple(args), (*target.shape, inner), 1))
        return target.without([d for d, one in zip((-2, -1), single, strict=True) if one])

    def _matmul(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        return [self._product(*args)]

    def _gemm(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        if given.get("alpha", 1.0) != 1.0 or given.get("beta", 1.0) != 1.0:
            raise KeyError("alpha or beta is not 1")
        a, b = (v.turned() if given.get(t) else v for v, t in zip(args, ("transA", "transB"), strict=False))
        return [self._product(a, b, args[2] if len(args) > 2 else None)]

    def _clip(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        if len(args) == 3:
            return [self._each("clip", args)]
        ends = [self.views[name] if name else None for name in node.input[1:]]
        found = args[0]
        for op, end in zip(("max", "min"), ends, strict=False):
            found = found if end is None else self._each(op, [found, end])
        return [found]

    def _where(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        return [self._each("where", args)]

    def _reciprocal(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        return [self._each("div", [self._hold(f"one over {node.output[0]}", np.ones(())), args[0]])]

    def _relu(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        return [self._each("max", [args[0], self._hold(f"zero of {node.output[0]}", np.zeros(()))])]

    def _cast(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        if given["to"] == onnx.TensorProto.DOUBLE or self.types[node.input[0]] in WHOLE:
            return args  # truth and integers are doubles already
        if given["to"] == onnx.TensorProto.BOOL:
            return [self._each("not", [self._each("not", args)])]
        raise KeyError(f"Cast to type {given['to']}")

    def _reshape(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        view, wanted = args[0], self._ints(node, 1)
        shape = [view.shape[d] if n == 0 else n for d, n in enumerate(wanted)]
        known = prod(n for n in shape if n >= 0)
        shape = [prod(view.shape) // known if n < 0 else n for n in shape]
        view = self._dense(view)
        return [replace(View.whole(view.buffer, shape), offset=view.offset)]

    def _unsqueeze(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        view, axes = args[0], given.get("axes") or self._ints(node, 1)
        count = len(view.shape) + len(axes)
        at, entries = {a % count for a in axes}, iter(zip(view.shape, view.strides, strict=True))
        dims = [(1, 0) if d in at else next(entries) for d in range(count)]
        return [replace(view, shape=tuple(n for n, _ in dims), strides=tuple(s for _, s in dims))]

    def _squeeze(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        return [args[0].without(self._axes(node, args[0], given))]

    def _transpose(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        view = args[0]
        order = given.get("perm") or list(range(len(view.shape)))[::-1]
        shape, strides = (tuple(of[d] for d in order) for of in (view.shape, view.strides))
        return [replace(view, shape=shape, strides=strides)]

    def _split(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        view, axis = args[0], given.get("axis", 0) % len(args[0].shape)
        if len(node.input) > 1 and node.input[1]:
            sizes = self._ints(node, 1)
        else:
            each = -(-view.shape[axis] // len(node.output))
            sizes = [min(each, view.shape[axis] - i * each) for i in range(len(node.output))]
        starts = np.cumsum([0, *sizes])
        return [view.part(axis, int(at), n) for at, n in zip(starts, sizes, strict=False)]

    def _slice(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        view = args[0]
        starts, ends = self._ints(node, 1), self._ints(node, 2)
        axes = self._ints(node, 3) if len(node.input) > 3 and node.input[3] else range(len(starts))
        steps = self._ints(node, 4) if len(node.input) > 4 and node.input[4] else [1] * len(starts)
        for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
            axis %= len(view.shape)
            taken = range(*slice(start, end if end > -(2**62) else None, step).indices(view.shape[axis]))
            view = view.part(axis, taken.start, len(taken), step)
        return [view]

    def _concat(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        axis = given["axis"] % len(args[0].shape)
        shape = list(args[0].shape)
        shape[axis] = sum(a.shape[axis] for a in args)
        target, start = self._new(shape), 0
        constant = all(a.buffer in self.constants for a in args)
        for view in args:
            count = view.shape[axis]
            self._copy(target.part(axis, start, count), view, keep=not constant)
            start += count
        return [target]

    def _copy(self, target: View, view: View, *, keep: bool) -> None:
        """Entries of a part of an array; with ``keep`` done at each step, constants too."""
        statement = PlainStatement("copy", target.place(), (view.broadcast(target.shape).place(),), target.shape)
        if keep:
            self.statements.append(statement.simplified())
        else:
            self._add(statement)

    def _tile(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        view, times = args[0], self._ints(node, 1)
        target = self._new([n * t for n, t in zip(view.shape, times, strict=True)])
        shape = [k for n, t in zip(view.shape, times, strict=True) for k in (t, n)]
        spread = [s for n, s in zip(view.shape, target.strides, strict=True) for s in (n * s, s)]
        read = [k for s in view.strides for k in (0, s)]
        wide = View(target.buffer, tuple(shape), tuple(spread))
        self._emit("copy", wide, [View(view.buffer, tuple(shape), tuple(read), view.offset)])
        return [target]

    def _gather(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        view, indices = args[0], self.integers.get(node.input[1])
        axis = given.get("axis", 0) % len(view.shape)
        if indices is None:
            return [self._chosen(view, axis, args[1])]
        wanted = [int(i) % view.shape[axis] for i in indices.ravel()]
        steps = set(np.diff(wanted).tolist()) or {1}
        if len(steps) == 1 and wanted:
            found = view.part(axis, wanted[0], len(wanted), steps.pop())
        else:
            found = self._picked(view, axis, wanted)
        if indices.ndim == 1:
            return [found]
        if indices.ndim == 0:
            return [found.without([axis])]
        found = self._dense(found)
        shape = (*view.shape[:axis], *indices.shape, *view.shape[axis + 1 :])
        return [replace(View.whole(found.buffer, shape), offset=found.offset)]

    def _chosen(self, view: View, axis: int, index: View) -> View:
        """The entry of an axis that a number of the step names, one after the other."""
        after = len(view.shape) - axis - 1
        wide = replace(index, shape=index.shape + (1,) * after, strides=index.strides + (0,) * after)
        parts = [view.part(axis, i, 1) for i in range(view.shape[axis])]
        if len(index.shape) != 1:
            parts = [p.without([axis]) for p in parts]
            if index.shape:
                raise KeyError("Gather by numbers of the step of more than one dimension")
        found = parts[0]
        for i, part in enumerate(parts[1:], 1):
            here = self._each("equal", [wide, self._hold(f"{index.buffer} is {i}", np.array(float(i)))])
            found = self._each("where", [here, part, found])
        return found

    def _picked(self, view: View, axis: int, wanted: Sequence[int]) -> View:
        """Entries of an axis that lie anyhow: where each is read stands in a table."""
        shape = list(view.shape)
        shape[axis] = len(wanted)
        target = self._new(shape)
        at = np.full(shape, view.offset, dtype=np.int64)
        for d, stride in enumerate(view.strides):
            along = np.array(wanted) if d == axis else np.arange(view.shape[d])
            at = at + stride * along.reshape([-1 if e == d else 1 for e in range(len(shape))])
        table = f"i{len(self.tables)}"
        self.tables[table] = at.ravel()
        flat = View.whole(view.buffer, (at.size,))
        self._emit("copy", View.whole(target.buffer, (at.size,)), [flat], table)
        return target

    def _softmax(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        """In two parts, a double and what it lacks; the sum of upper bits alone is exact (``elementary.GRID``)."""
        view = args[0]
        axes = [given.get("axis", -1) % len(view.shape)]
        if view.shape[axes[0]] > MOST_SUMMED:
            raise KeyError(f"Softmax of {view.shape[axes[0]]} numbers, and {MOST_SUMMED} at most are summed exactly")
        largest, grid = self._together("largest", view, axes), self._hold(f"grid of {node.output[0]}", np.array(GRID))
        below = self._each("sub", [view, largest])
        grown = self._each("exp", [below])
        rest = self._each("exp_rest", [below, self._each("difference_rest", [view, largest])])
        upper = self._each("sub", [self._each("add", [grown, grid]), grid])
        lower = self._each("add", [self._each("sub", [grown, upper]), rest])
        sums = [self._together("sum", part, axes) for part in (upper, lower)]
        return [self._each("quotient", [grown, rest, *sums])]

    def _identity(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        return args

    def _expand(self, node: onnx.NodeProto, args: list[View], given: dict[str, Any]) -> list[View]:
        return [args[0].broadcast(np.broadcast_shapes(args[0].shape, tuple(self._ints(node, 1))))]

    _others: ClassVar[dict[str, Callable[..., list[View]]]] = {
        "Cast": _cast, "Clip": _clip, "Concat": _concat, "Expand": _expand, "Gather": _gather, "Gemm": _gemm,
        "Identity": _identity, "MatMul": _matmul, "Reciprocal": _reciprocal, "Relu": _relu, "Reshape": _reshape,
        "Slice": _slice, "Softmax": _softmax, "Split": _split, "Squeeze": _squeeze, "Tile": _tile,
        "Transpose": _transpose,
        "Unsqueeze": _unsqueeze, "Where": _where,
    }  # fmt: skip


def lowered(model: onnx.ModelProto) -> PlainProgram:
    """The statements of a controller's graph; ExportError for an operator that laws do not use."""
    return Lowering(model).program()


def _count(value: onnx.ValueInfoProto) -> int:
    return prod(d.dim_value for d in value.type.tensor_type.shape.dim)
