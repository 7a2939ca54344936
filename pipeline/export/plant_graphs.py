"""The plant of a closed loop as two ONNX graphs: one sampling period, and what is measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.casadi_graph import OPSET, casadi_graph
from loopwright.pipeline.plants.equations import EquationPlant, rk4_step
from loopwright.pipeline.plants.simulator import Array

UNROLLED = 1_500  # operations above which the substeps are a loop: a runtime takes seconds to load thousands of nodes
TOLERANCE = 1e-9
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
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=once.ir_version, producer_name="loopwright"
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
        if not np.allclose(theirs, ours, rtol=TOLERANCE, atol=0.0):
            raise ExportError(
                f"plant {plant.name!r}: the graph {model.graph.name!r} gives {theirs} where the plant gives {ours}"
            )
