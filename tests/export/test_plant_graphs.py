"""A plant's graphs give what the plant gives, over random states, inputs and parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import onnx
import onnxruntime as ort
import pytest

from loopwright.pipeline.cases import CASES, PLANTS
from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export import plant_graphs as module
from loopwright.pipeline.export.plant_graphs import casadi_graph, plant_graphs
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

RUNS = 200
EQUATIONS = sorted(name for name, plant in PLANTS.items() if issubclass(plant, EquationPlant))


def run(model: onnx.ModelProto, **given: Array) -> Array:
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {name: v for name, v in given.items() if v.shape[1]})[0]


def drawn(rng: np.random.Generator, signals: tuple[Signal, ...]) -> Array:
    """Values (RUNS, n) over the signals' ranges, of a discrete one its allowed values."""
    columns = [
        rng.choice(s.values, RUNS) if s.values else rng.uniform(s.low, s.high, RUNS) if s.high > s.low else None
        for s in signals
    ]
    return np.array(columns).T.reshape(RUNS, len(signals))


def close(ours: Array, theirs: Array, within: float = 1e-9) -> None:
    """Equal to ``within`` of each value wherever the plant gives a number; there it must be in most runs."""
    known = np.isfinite(theirs).all(axis=1)
    assert known.sum() >= RUNS / 4  # some states of the whole range no plant can be in
    np.testing.assert_allclose(ours[known], theirs[known], rtol=within, atol=0)


@pytest.mark.parametrize("name", EQUATIONS)
def test_a_plants_graphs_equal_its_step_and_measure_over_random_states_and_parameters(name: str) -> None:
    plant = PLANTS[name]()
    assert isinstance(plant, EquationPlant)
    rng = np.random.default_rng(0)
    x, mv, dv = (drawn(rng, s) for s in (plant.state_signals, plant.mv_signals, plant.dv_signals))
    p = plant.parameters() * rng.uniform(0.95, 1.05, (RUNS, len(plant.parameters())))
    graphs = plant_graphs(plant)
    stepped = np.array([plant.step(*row) for row in zip(x, mv, dv, p, strict=True)])
    close(run(graphs.transition, x=x, mv=mv, dv=dv, p=p), stepped)
    close(run(graphs.measurement, x=x), plant.measured(x))


def test_all_cases_are_among_them() -> None:
    assert {case.plant.name for case in CASES.values()} <= set(EQUATIONS)


@dataclass(frozen=True)
class Tank(EquationPlant):
    """A tank with a measured inflow: dh/dt = (a u + d - c sqrt(h)) / A."""

    c: float = field(default=2.0, metadata={"unit": "l/(min m^0.5)"})
    area: float = field(default=3.0, metadata={"unit": "m2"})
    name: ClassVar[str] = "tank_of_the_graphs"
    title: ClassVar[str] = "Tank"
    state_signals: ClassVar[tuple[Signal, ...]] = (Signal("h", "m", 0.5, 4.0),)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("volume", "m3", 0.0, 20.0), Signal("h", "m", 0.5, 4.0))
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("volume", "m3", 1.0, 10.0),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("u", "%", 0.0, 100.0),)
    dv_signals: ClassVar[tuple[Signal, ...]] = (Signal("d", "l/min", 0.0, 2.0),)
    period_s: ClassVar[float] = 30.0
    time_unit_s: ClassVar[float] = 60.0
    substeps: ClassVar[int] = 3

    @property
    def start(self) -> tuple[Array, Array]:
        return np.array([1.0]), np.array([40.0])

    @property
    def dv_nominal(self) -> Array:
        return np.array([1.0])

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        return (0.05 * mv[0] + dv[0] - self.c * ca.sqrt(x[0])) / self.area

    def output(self, x: Any) -> Any:
        return ca.vertcat(self.area * x[0], x[0])


@pytest.mark.parametrize("unrolled", [0, 10**6])
def test_measured_disturbances_are_an_input_with_a_loop_as_without_one(
    unrolled: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "UNROLLED", unrolled)
    plant, rng = Tank(), np.random.default_rng(1)
    graphs = plant_graphs(plant)
    assert [v.name for v in graphs.transition.graph.input] == ["x", "mv", "dv", "p"]
    assert ("Loop" in {node.op_type for node in graphs.transition.graph.node}) == (unrolled == 0)
    x, mv, dv = (drawn(rng, s) for s in (plant.state_signals, plant.mv_signals, plant.dv_signals))
    p = plant.parameters() * rng.uniform(0.5, 1.5, (RUNS, 2))
    stepped = np.array([plant.step(*row) for row in zip(x, mv, dv, p, strict=True)])
    close(run(graphs.transition, x=x, mv=mv, dv=dv, p=p), stepped, 1e-14)
    close(run(graphs.measurement, x=x), plant.measured(x), 1e-14)


@dataclass(frozen=True)
class Bad(Tank):
    """A tank whose outflow is written with an operation that no runtime has in float64."""

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        return ca.erf(x[0]) - mv[0]


def test_an_operation_without_float64_is_named_with_those_that_have_it() -> None:
    with pytest.raises(ExportError, match=r"uses erf, .* write it with add, .*exp"):
        plant_graphs(Bad())


OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "arithmetic": lambda a, b: a + b * a - a / b,
    "powers": lambda a, b: ca.fabs(a) ** b + a**2 + a**3 + 1 / a,
    "roots and logarithms": lambda a, b: ca.sqrt(ca.fabs(a)) * ca.log(ca.fabs(b) + 1),
    "exponential": lambda a, b: ca.exp(-a / (1 + b**2)),
    "angles": lambda a, b: ca.sin(a) * ca.cos(b) + ca.tan(a),
    "tanh": lambda a, b: ca.tanh(a - b),
    "rounding": lambda a, b: ca.floor(a) + ca.ceil(b) + ca.sign(a),
    "extremes": lambda a, b: ca.fmin(a, b) - 2 * ca.fmax(a, 0),
    "a choice": lambda a, b: ca.if_else(a < b, a, -b),
    "a choice of logic": lambda a, b: ca.if_else(ca.logic_or(ca.logic_and(a < b, a >= 0), a == b), a, b),
    "a negated choice": lambda a, b: ca.if_else(ca.logic_not(a != b), 1, ca.if_else(a, b, 0)),
    "truth as a number": lambda a, b: (a <= b) + 2 * ca.logic_not(a),
}


@pytest.mark.parametrize("what", OPERATIONS)
def test_casadis_operations_become_onnxs(what: str) -> None:
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    function = ca.Function("f", [a, b], [ca.vertcat(OPERATIONS[what](a, b), b)])
    model = casadi_graph([(function, ("a", "b"), ("c",))], "f")
    values = np.random.default_rng(2).uniform(-3, 3, (RUNS, 2))
    values[:10] = values[:10].round()
    values[10:20, 1] = values[10:20, 0]
    values = values[(values != 0).all(axis=1)] if what == "arithmetic" or what == "powers" else values
    ours = run(model, a=values[:, :1], b=values[:, 1:])
    theirs = np.array([np.array(function(*row))[:, 0] for row in values])
    np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-15)


def test_constants_get_as_many_rows_as_there_are_runs() -> None:
    a = ca.SX.sym("a")
    model = casadi_graph([(ca.Function("f", [a], [ca.DM(7.0), 2 * a]), ("a",), ("seven", "twice"))], "f")
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    seven, twice = session.run(None, {"a": np.array([[1.0], [2.0]])})
    assert seven.tolist() == [[7.0], [7.0]]
    assert twice.tolist() == [[2.0], [4.0]]


def test_a_matrix_and_arguments_of_one_name_and_two_sizes_are_refused() -> None:
    a, m = ca.SX.sym("a"), ca.SX.sym("m", 2, 2)
    with pytest.raises(ExportError, match=r"argument 'm' of function 'g' is 2x2; it must be a dense column"):
        casadi_graph([(ca.Function("g", [m], [m[0]]), ("m",), ("y",))], "g")
    two = ca.SX.sym("b", 2)
    functions = [
        (ca.Function("f", [a], [a]), ("a",), ("y",)),
        (ca.Function("g", [two], [two]), ("a",), ("z",)),
    ]
    with pytest.raises(ExportError, match="must be of one size"):
        casadi_graph(functions, "f")
    with pytest.raises(ExportError, match="no arguments"):
        casadi_graph([(ca.Function("h", [], [ca.DM(1.0)]), (), ("y",))], "h")
