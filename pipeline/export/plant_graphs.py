"""The plant of a closed loop as two ONNX graphs: one sampling period, and what is measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.plants.equations import EquationPlant, rk4_step
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.graph.audit import MAX_IR

PLANT_OPSET = 18  # as of a law's graph
RUNS = "n"  # the first dimension of every input and output: runs side by side

# Operations of CasADi that are one operator of ONNX; onnxruntime has each of them in float64.
ONE_OPERATOR = {
    ca.OP_ADD: "Add",
    ca.OP_SUB: "Sub",
    ca.OP_MUL: "Mul",
    ca.OP_DIV: "Div",
    ca.OP_NEG: "Neg",
    ca.OP_EXP: "Exp",
    ca.OP_LOG: "Log",
    ca.OP_POW: "Pow",
    ca.OP_CONSTPOW: "Pow",
    ca.OP_SQRT: "Sqrt",
    ca.OP_SIN: "Sin",
    ca.OP_COS: "Cos",
    ca.OP_TANH: "Tanh",
    ca.OP_FLOOR: "Floor",
    ca.OP_CEIL: "Ceil",
    ca.OP_FABS: "Abs",
    ca.OP_SIGN: "Sign",
    ca.OP_FMIN: "Min",
    ca.OP_FMAX: "Max",
}
COMPARISONS = {ca.OP_LT: "Less", ca.OP_LE: "LessOrEqual", ca.OP_EQ: "Equal"}
LOGIC = {ca.OP_AND: "And", ca.OP_OR: "Or"}
NAMES = {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}


def casadi_graph(functions: Sequence[tuple[ca.Function, Sequence[str], Sequence[str]]], name: str) -> onnx.ModelProto:
    """One graph of some functions of column vectors, each with the names of its arguments and of its results.

    Functions that name the same argument share it. An argument or a result ``v`` (m,) of a function is the graph's
    input or output (n, m): row i belongs to run i. Arguments of size zero are left out. Every operation
    is carried out once, in CasADi's order and in float64, so that the graph gives what the functions give but for the
    rounding of exp and its like.

    Raises ExportError for an operation that ONNX lacks in float64, for a matrix, and for a sparse vector.
    """
    graph = _Graph(name)
    for function, arguments, results in functions:
        graph.add(function if function.is_a("SXFunction") else function.expand(), arguments, results)
    return graph.model()


class _Graph:
    """The nodes so far. A value is a column (n, 1) or a constant (); one with the same operands is made once."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.nodes: list[onnx.NodeProto] = []
        self.inputs: dict[str, list[str]] = {}  # name -> its columns
        self.outputs: dict[str, int] = {}  # name -> its size
        self.constants: dict[str, str] = {}  # bits -> name
        self.made: dict[tuple[str, ...], str] = {}
        self.truths: dict[str, str] = {}  # a column of 0 and 1 -> the same as booleans
        self.count = 0
        self.tensors: list[onnx.TensorProto] = []

    def add(self, function: ca.Function, arguments: Sequence[str], results: Sequence[str]) -> None:
        """Add the function's operations."""
        columns = [self._input(function, i, name) for i, name in enumerate(arguments)]
        found: list[dict[int, str]] = [{} for _ in results]
        work: dict[int, str] = {}
        for i in range(function.n_instructions()):
            operation = function.instruction_id(i)
            given, gives = function.instruction_input(i), function.instruction_output(i)
            if operation == ca.OP_INPUT:
                work[gives[0]] = columns[given[0]][given[1]]
            elif operation == ca.OP_OUTPUT:
                found[gives[0]][gives[1]] = work[given[0]]
            elif operation == ca.OP_CONST:
                work[gives[0]] = self._constant(function.instruction_constant(i))
            else:
                work[gives[0]] = self._operation(function, operation, [work[place] for place in given])
        for i, name in enumerate(results):
            self._output(function, i, name, found[i], columns)

    # ------------------------------------------------------------------ ends
    def _input(self, function: ca.Function, i: int, name: str) -> list[str]:
        size = _size(function, f"argument {name!r}", function.sparsity_in(i))
        if name not in self.inputs:
            self.inputs[name] = [self._fresh() for _ in range(size)]
            if size:
                self.nodes.append(helper.make_node("Split", [name], self.inputs[name], axis=1, num_outputs=size))
        if len(self.inputs[name]) != size:
            raise ExportError(
                f"argument {name!r} has {size} entries in function {function.name()!r} and "
                f"{len(self.inputs[name])} in another; arguments of one name must be of one size"
            )
        return self.inputs[name]

    def _output(
        self, function: ca.Function, i: int, name: str, entries: dict[int, str], columns: list[list[str]]
    ) -> None:
        size = _size(function, f"result {name!r}", function.sparsity_out(i))
        # A constant belongs to no run; it gets the shape of an argument's column.
        like = next((column for given in columns for column in given), None)
        parts = [self._column(entries[k], like, function) for k in range(size)]
        self.nodes.append(helper.make_node("Concat", parts, [name], axis=1))
        self.outputs[name] = size

    def _column(self, value: str, like: str | None, function: ca.Function) -> str:
        if value not in self.constants.values():
            return value
        if like is None:
            raise ExportError(f"function {function.name()!r} has no arguments, so its results belong to no run")
        return self._node("Expand", value, self._node("Shape", like))

    # ------------------------------------------------------------------ operations
    def _operation(self, function: ca.Function, operation: int, given: list[str]) -> str:
        if operation in ONE_OPERATOR:
            return self._node(ONE_OPERATOR[operation], *given)
        if operation in COMPARISONS:
            return self._number(self._node(COMPARISONS[operation], *given))
        if operation in LOGIC:
            return self._number(self._node(LOGIC[operation], *map(self._truth, given)))
        composed = self._composed().get(operation)
        if composed is None:
            known = sorted(NAMES[o] for o in {*ONE_OPERATOR, *COMPARISONS, *LOGIC, *self._composed()})
            raise ExportError(
                f"function {function.name()!r} uses {NAMES.get(operation, operation)}, for which onnxruntime has no "
                f"operator in float64; write it with {', '.join(known)}"
            )
        return composed(*given)

    def _composed(self) -> dict[int, Callable[..., str]]:
        return {
            ca.OP_ASSIGN: lambda a: a,
            ca.OP_SQ: lambda a: self._node("Mul", a, a),
            ca.OP_TWICE: lambda a: self._node("Add", a, a),
            ca.OP_INV: lambda a: self._node("Div", self._constant(1.0), a),
            ca.OP_TAN: lambda a: self._node("Div", self._node("Sin", a), self._node("Cos", a)),
            ca.OP_NOT: lambda a: self._number(self._node("Not", self._truth(a))),
            ca.OP_NE: lambda a, b: self._number(self._node("Not", self._node("Equal", a, b))),
            ca.OP_IF_ELSE_ZERO: lambda a, b: self._node("Where", self._truth(a), b, self._constant(0.0)),
        }

    def _truth(self, value: str) -> str:
        """The booleans of a column of numbers: all but 0 are true."""
        known = self.truths.get(value)
        return known or self._node("Not", self._node("Equal", value, self._constant(0.0)))

    def _number(self, truth: str) -> str:
        """0 and 1 for booleans."""
        number = self._node("Cast", truth, to=TensorProto.DOUBLE)
        self.truths[number] = truth
        return number

    def _node(self, operator: str, *given: str, **attributes: Any) -> str:
        key = (operator, *given)
        if key not in self.made:
            self.made[key] = self._fresh()
            self.nodes.append(helper.make_node(operator, list(given), [self.made[key]], **attributes))
        return self.made[key]

    def _constant(self, value: float) -> str:
        bits = float(value).hex()
        if bits not in self.constants:
            self.constants[bits] = self._fresh()
            self.tensors.append(numpy_helper.from_array(np.array(float(value)), self.constants[bits]))
        return self.constants[bits]

    def _fresh(self) -> str:
        self.count += 1
        return f"v{self.count}"

    # ------------------------------------------------------------------ the model
    def model(self) -> onnx.ModelProto:
        """The graph as a checked model."""

        def ends(sizes: dict[str, int]) -> list[onnx.ValueInfoProto]:
            return [helper.make_tensor_value_info(n, TensorProto.DOUBLE, [RUNS, m]) for n, m in sizes.items() if m]

        inputs = ends({name: len(columns) for name, columns in self.inputs.items()})
        graph = helper.make_graph(self.nodes, self.name, inputs, ends(self.outputs), self.tensors)
        opset = [helper.make_opsetid("", PLANT_OPSET)]
        model = helper.make_model(graph, opset_imports=opset, ir_version=MAX_IR, producer_name="loopwright")
        onnx.checker.check_model(model, full_check=True)
        return model


def _size(function: ca.Function, what: str, sparsity: ca.Sparsity) -> int:
    """Number of entries of a dense column; ExportError for anything else."""
    if not (sparsity.is_dense() and sparsity.size2() == 1) and sparsity.numel():
        raise ExportError(
            f"{what} of function {function.name()!r} is {sparsity.dim()}; it must be a dense column (use ca.densify)"
        )
    return int(sparsity.numel())


# ----------------------------------------------------------------------------------------------- the graphs of a plant
UNROLLED = 1_500  # operations above which the substeps are a loop: a runtime takes seconds to load thousands of nodes
PLANT_TOLERANCE = 1e-9  # relative difference of a plant's graph and its equations
MANIPULATED = ("x", "mv", "dv", "p")


@dataclass(frozen=True, slots=True)
class PlantGraphs:
    """The graphs of a plant, in float64, for n runs side by side.

    ``transition``: x (n, n_x), mv (n, n_mv), dv (n, n_dv), p (n, n_p) -> x_next (n, n_x), one period later, with the
    inputs held. ``measurement``: x (n, n_x) -> pv (n, n_pv). Units are the plant's. An input of size zero is left out.
    """

    transition: onnx.ModelProto
    measurement: onnx.ModelProto


def plant_graphs(plant: EquationPlant) -> PlantGraphs:
    """The plant's graphs; ExportError where one cannot be written, or differs from the plant where it starts."""
    measurement = casadi_graph([(plant.measurement, ("x",), ("pv",))], f"{plant.name}_measurement")
    graphs = PlantGraphs(_transition(plant), measurement)
    _compare(plant, graphs)
    return graphs


def _transition(plant: EquationPlant) -> onnx.ModelProto:
    """``EquationPlant.transition``, its substeps one after the other or, where these are many, in a Loop."""
    name = f"{plant.name}_transition"
    usual = type(plant).transition is EquationPlant.transition
    if plant.substeps == 1 or not usual or plant.transition.n_instructions() <= UNROLLED:
        return casadi_graph([(plant.transition, MANIPULATED, ("x_next",))], name)
    return _repeated(casadi_graph([(_substep(plant), MANIPULATED, ("x_next",))], "substep"), plant.substeps, name)


def _substep(plant: EquationPlant) -> ca.Function:
    """CasADi function (x, mv, dv, p) -> x one RK4 substep later, the one that ``transition`` repeats."""
    sizes = (plant.n_x, len(plant.mv_signals), len(plant.dv_signals), len(plant.parameter_names()))
    x, mv, dv, p = (ca.SX.sym(name, n) for name, n in zip(MANIPULATED, sizes, strict=True))
    h = plant.period_s / plant.time_unit_s / plant.substeps
    state = rk4_step(lambda at: plant.rate(at, mv, dv, p), x, h)
    return ca.Function("substep", [x, mv, dv, p], [ca.densify(state)])


def _repeated(once: onnx.ModelProto, times: int, name: str) -> onnx.ModelProto:
    """The graph (x, ...) -> x_next carried out ``times`` times, its other inputs held."""
    x, x_next = once.graph.input[0], once.graph.output[0]
    going = [helper.make_tensor_value_info(n, TensorProto.BOOL, []) for n in ("going", "goes_on")]
    place = helper.make_tensor_value_info("place", TensorProto.INT64, [])
    # The body reads the inputs that do not change from the graph around it.
    body = helper.make_graph(
        [*once.graph.node, helper.make_node("Identity", ["going"], ["goes_on"])],
        once.graph.name,
        [place, going[0], _renamed(x, "x_at")],
        [going[1], _renamed(x_next, "x_after")],
        list(once.graph.initializer),
    )
    for node in body.node:
        node.input[:] = ["x_at" if given == "x" else given for given in node.input]
        node.output[:] = ["x_after" if made == "x_next" else made for made in node.output]
    loop = helper.make_node("Loop", ["times", "always", "x"], ["x_next"], body=body)
    constants = [
        numpy_helper.from_array(np.array(times, dtype=np.int64), "times"),
        numpy_helper.from_array(np.array(True), "always"),
    ]
    graph = helper.make_graph([loop], name, list(once.graph.input), [x_next], constants)
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", PLANT_OPSET)],
        ir_version=once.ir_version,
        producer_name="loopwright",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def _renamed(value: onnx.ValueInfoProto, name: str) -> onnx.ValueInfoProto:
    renamed = onnx.ValueInfoProto()
    renamed.CopyFrom(value)
    renamed.name = name
    return renamed


def _compare(plant: EquationPlant, graphs: PlantGraphs) -> None:
    """ExportError unless the graphs give what the plant gives where it starts, to 1e-9 of it.

    Its MVs are those in the middle of their ranges: under those of its start it may be at rest, and nothing would move.
    """
    x, mv = plant.start[0], np.array([s.middle for s in plant.mv_signals])
    dv, p = plant.dv_nominal, plant.parameters()
    feeds = {name: v[None] for name, v in zip(MANIPULATED, (x, mv, dv, p), strict=True) if v.size}
    for model, ours, given in (
        (graphs.transition, plant.step(x, mv, dv, p), feeds),
        (graphs.measurement, plant.measure(x), {"x": feeds["x"]}),
    ):
        results: Any = ReferenceEvaluator(model).run(None, given)
        theirs: Array = np.asarray(results[0])[0]
        if not np.allclose(theirs, ours, rtol=PLANT_TOLERANCE, atol=0.0):
            raise ExportError(
                f"plant {plant.name!r}: the graph {model.graph.name!r} gives {theirs} where the plant gives {ours}"
            )
