"""From a record to a controller on plants that no case has: the predictive law beside a PID and the perfect NMPC.

``python benchmarks/own_plants.py [--rows N] [PLANT ...]``; without plants, all of them; a row a plant as it comes,
about a minute each. The record holds an operator's random steps and measurement noise. The model and the law know
the record alone, with all defaults. The PID is tuned in closed loop on the true plant, with its noise; the NMPC knows
the true equations and the state. Figures: mean absolute error in % of the set point's range, on random set points and
after unmeasured loads that no one has seen, the true output under measurement noise (of the NMPC without noise).
The method was chosen with the plants of DEVELOPMENT in sight; the others are reported as they come.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import torch

from pipeline.evaluation.effort import Effort
from pipeline.laws import LAWS
from pipeline.laws.base import ControlLaw
from pipeline.models import MODELS
from pipeline.models.part import Source
from pipeline.optimal.perfect import PerfectNmpc, run_nmpc
from pipeline.plants.equations import EquationPlant
from pipeline.plants.simulator import Array
from pipeline.plants.spoilt import SpoiltPlant
from pipeline.records.record import Record
from pipeline.simulation.scenario import Scenario, held
from pipeline.simulation.simulate import Trajectory, simulate_closed, simulate_open
from serving.manifest import Signal

HELD_OUT = (71, 72, 73)
LEVELS = 8
MV = Signal("u", "%", 0.0, 100.0)


class OwnPlant(EquationPlant):
    """One output, one input, an unmeasured load on the input [%]; ``noise`` [unit of the output]."""

    noise: ClassVar[float]
    hold: ClassVar[int]  # samples of a set point
    moves: ClassVar[tuple[int, int]]  # fewest and most samples of a step in the record
    span: ClassVar[tuple[float, float]] = (10.0, 90.0)  # of the MV in the record
    mv_signals: ClassVar[tuple[Signal, ...]] = (MV,)
    period_s: ClassVar[float] = 10.0
    substeps: ClassVar[int] = 4

    def output(self, x: Any) -> Any:
        """The first state."""
        return x[0]

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise, shape (1,)."""
        return np.array([self.noise])


def _lags(x: Any, u: Any, tau: float) -> list[Any]:
    """Rates of a chain of equal lags, the last state first behind the input."""
    n = x.shape[0]
    return [((x[i + 1] if i + 1 < n else u) - x[i]) / tau for i in range(n)]


def _states(n: int, unit: str = "-") -> tuple[Signal, ...]:
    return tuple(Signal(f"x{i}", unit, -1e3, 1e3) for i in range(n))


@dataclass(frozen=True)
class Exchanger(OwnPlant):
    """A heat exchanger behind a pipe: a gain that falls with the flow, and a transport of six lags."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "exchanger"
    title: ClassVar[str] = "Heat exchanger"
    noise: ClassVar[float] = 0.15
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (5, 60)
    state_signals: ClassVar[tuple[Signal, ...]] = _states(8)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("T", "degC", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("T", "degC", 40.0, 65.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u = (mv[0] + self.load) / 100
        steady = 20 + 60 * u / (0.25 + u)
        return ca.vertcat((x[1] - x[0]) / 60, *_lags(x[1:], steady, 8.0))


@dataclass(frozen=True)
class Inverse(OwnPlant):
    """Two lags against each other: the answer starts the wrong way."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "inverse"
    title: ClassVar[str] = "Inverse response"
    noise: ClassVar[float] = 0.2
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 50)
    state_signals: ClassVar[tuple[Signal, ...]] = _states(3)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("y", "%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("y", "%", 20.0, 75.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u = mv[0] + self.load
        slow, fast = (1.4 * u + 0.003 * u * u - x[1]) / 80, (0.6 * u - x[2]) / 25
        return ca.vertcat((x[1] - x[2] - x[0]) / 5, slow, fast)


@dataclass(frozen=True)
class Tanks(OwnPlant):
    """Three tanks in a row whose outflow goes with the root of the level."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "tanks"
    title: ClassVar[str] = "Three tanks"
    noise: ClassVar[float] = 0.01
    hold: ClassVar[int] = 120
    moves: ClassVar[tuple[int, int]] = (10, 120)
    state_signals: ClassVar[tuple[Signal, ...]] = _states(3, "m")
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("h", "m", 0.0, 5.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("h", "m", 0.4, 3.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [m/s]."""
        out = [0.04 * x[i] / (x[i] ** 2 + 1e-4) ** 0.25 for i in range(3)]  # the root, and its mirror image
        inflow = 0.08 * (mv[0] + self.load) / 100
        return ca.vertcat((out[1] - out[0]) / 2, (out[2] - out[1]) / 2, (inflow - out[2]) / 2)


@dataclass(frozen=True)
class Noisy(OwnPlant):
    """Two lags behind a valve whose gain grows sixfold, with a noise of 10 % of the range."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "noisy"
    title: ClassVar[str] = "Noisy valve"
    noise: ClassVar[float] = 5.0
    hold: ClassVar[int] = 80
    moves: ClassVar[tuple[int, int]] = (5, 80)
    state_signals: ClassVar[tuple[Signal, ...]] = _states(2)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("f", "m3/h", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("f", "m3/h", 15.0, 65.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u = (mv[0] + self.load) / 100
        return ca.vertcat((x[1] - x[0]) / 40, (100 * (0.3 * u + 0.7 * u * u) - x[1]) / 60)


@dataclass(frozen=True)
class Turning(OwnPlant):
    """A fermenter: product over dilution, a gain that falls to a fifth towards the top."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "turning"
    title: ClassVar[str] = "Falling gain, fast and slow modes"
    noise: ClassVar[float] = 0.3
    hold: ClassVar[int] = 80
    moves: ClassVar[tuple[int, int]] = (5, 70)
    state_signals: ClassVar[tuple[Signal, ...]] = _states(3)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("c", "g/l", 0.0, 80.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("c", "g/l", 20.0, 55.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u = (mv[0] + self.load) / 100
        steady = 70 * (1 - ca.exp(-2.2 * u))
        return ca.vertcat((0.6 * x[1] + 0.4 * x[2] - x[0]) / 8, (steady - x[1]) / 30, (steady - x[2]) / 200)


@dataclass(frozen=True)
class Recycle(OwnPlant):
    """A reactor with recycle: slow, with a pole that moves with the level."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "recycle"
    title: ClassVar[str] = "Reactor with recycle"
    noise: ClassVar[float] = 0.004
    hold: ClassVar[int] = 100
    moves: ClassVar[tuple[int, int]] = (8, 90)
    state_signals: ClassVar[tuple[Signal, ...]] = _states(4)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("x", "mol/l", 0.0, 2.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("x", "mol/l", 0.3, 0.9),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [mol/(l s)]."""
        feed = (mv[0] + self.load) / 100
        rate = 0.02 * x[0] ** 2
        return ca.vertcat(
            (0.02 * feed + 0.012 * x[3] - 0.012 * x[0]) - rate, *[(x[i - 1] - x[i]) / 20 for i in (1, 2)],
            (0.5 * x[2] - x[3]) / 20,
        )  # fmt: skip


@dataclass(frozen=True)
class Delayed(OwnPlant):
    """One lag behind a long transport of twenty lags: dead time above the time constant."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "delayed"
    title: ClassVar[str] = "Long transport"
    noise: ClassVar[float] = 0.3
    hold: ClassVar[int] = 90
    moves: ClassVar[tuple[int, int]] = (5, 60)
    state_signals: ClassVar[tuple[Signal, ...]] = _states(21)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("w", "%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("w", "%", 20.0, 70.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]."""
        u = mv[0] + self.load
        return ca.vertcat((x[1] - x[0]) / 40, *_lags(x[1:], 0.6 * u + 0.003 * u * u, 5.0))


@dataclass(frozen=True)
class Oscillating(OwnPlant):
    """A lightly damped second order behind a saturating actuator."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "oscillating"
    title: ClassVar[str] = "Lightly damped"
    noise: ClassVar[float] = 0.2
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (3, 40)
    state_signals: ClassVar[tuple[Signal, ...]] = _states(3)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("p", "bar", -20.0, 120.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("p", "bar", 25.0, 75.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        force = 100 * ca.tanh(1.5 * ((mv[0] + self.load) / 100 - 0.5)) + 50
        omega, damping = 2 * np.pi / 150, 0.25
        return ca.vertcat(x[1], omega**2 * (x[2] - x[0]) - 2 * damping * omega * x[1], (force - x[2]) / 15)


DEVELOPMENT: tuple[type[OwnPlant], ...] = (Exchanger, Inverse, Tanks, Noisy)
UNTOUCHED: tuple[type[OwnPlant], ...] = (Turning, Recycle, Delayed, Oscillating)


def record_of(plant: OwnPlant, rows: int, seed: int = 0) -> Record:
    """An operator's random steps over the MV's range, with measurement noise."""
    rng, levels = np.random.default_rng(seed), []
    while len(levels) < rows:
        levels += [rng.uniform(*plant.span)] * int(rng.integers(plant.moves[0], plant.moves[1] + 1))
    mv = np.array(levels[:rows])[:, None]
    pv = plant.measured(simulate_open(plant, plant.start[0], mv)[:-1])
    return Record.of(plant.signals, pv + plant.noise * rng.standard_normal(pv.shape), mv)


def tests_of(plant: OwnPlant) -> dict[str, list[Scenario]]:
    """Random set points, and a load of 10 % of the MV's range that comes and goes at each of three set points."""
    sp, hold = plant.sp_signals[0], plant.hold
    sequences, loads = [], []
    for seed in HELD_OUT:
        rng = np.random.default_rng(seed)
        levels = rng.uniform(sp.low, sp.high, LEVELS).tolist()
        x0, mv0 = plant.steady_state_at(levels[0])
        sequences.append(Scenario("set points", "", held(levels, hold), x0, mv0, {}, hold, seed))
        level = rng.uniform(sp.low + 0.2 * (sp.high - sp.low), sp.high - 0.2 * (sp.high - sp.low))
        x0, mv0 = plant.steady_state_at(level)
        load = np.repeat([0.0, 10.0, 0.0, -10.0], [5, hold, hold, hold])
        loads.append(Scenario("loads", "", np.full((len(load), 1), level), x0, mv0, {"load": load}))
    return {"set points": sequences, "loads": loads}


def closed(law: ControlLaw, plant: OwnPlant, test: Scenario) -> Trajectory:
    """One closed loop of a law over the true plant, with measurement noise."""
    state = torch.zeros(law.n_state, dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.float64)

    def step(sp: Array, pv: Array, mv: Array) -> tuple[Array, Array]:
        nonlocal state
        with torch.no_grad():
            out, state, info = law(torch.from_numpy(sp), torch.from_numpy(pv), none, torch.from_numpy(mv), state)
        return out.numpy(), info.numpy()

    return simulate_closed(plant, step, test, noise=plant.noise_std, seed=test.seed or 5)


def nmae(plant: OwnPlant, runs: list[tuple[Array, Array]]) -> float:
    """Mean absolute error [% of the set point's range] over runs of (sp, pv)."""
    sp = plant.sp_signals[0]
    return float(100 * np.mean([np.abs(s - y).mean() for s, y in runs]) / (sp.high - sp.low))


def row_of(plant: OwnPlant, rows: int, settings: dict[str, Any]) -> str:
    """The row of one plant."""
    began = time.perf_counter()
    record = record_of(plant, rows)
    model = MODELS["identified"]().learn(Source(record, plant.signals)).model
    fitted = time.perf_counter() - began
    predictive = LAWS["predictive"]
    laws = {
        "pid": LAWS["pid"].design(LAWS["pid"].Params(), {}, plant.signals, SpoiltPlant(plant, {})).eval(),
        "predictive": predictive.design(
            predictive.Params(**settings), {"identified": model}, plant.signals, None
        ).eval(),
    }
    figures: dict[str, list[float]] = {}
    for name, tests in tests_of(plant).items():
        nmpc = PerfectNmpc(plant, effort=Effort(periods=max(40, plant.hold // 2), elements=1, every=8))
        own = {law: nmae(plant, [(t.sp, closed(m, plant, t).pv) for t in tests]) for law, m in laws.items()}
        sp = plant.sp_signals[0]
        bound = [run_nmpc(nmpc, t, unforeseen=True)["mae"] for t in tests] if name == "set points" else []
        figures[name] = [own["pid"], own["predictive"], 100 * float(np.mean(bound or [np.nan])) / (sp.high - sp.low)]
    (pid, ours, bound), (pid_load, our_load, _) = figures.values()
    return (
        f"{plant.name:12} {pid:8.2f} {bound:8.2f} {ours:8.2f} {ours / bound:8.2f} {ours / pid:8.2f}"
        f" {pid_load:9.2f} {our_load:9.2f} {fitted:7.0f} {time.perf_counter() - began:7.0f}"
    )


def main(argv: list[str]) -> int:
    """Print a row a plant."""
    plants: dict[str, Callable[[], OwnPlant]] = {p.name: p for p in (*DEVELOPMENT, *UNTOUCHED)}
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("plants", nargs="*", choices=[[], *plants], help="(default: all)")
    parser.add_argument("--rows", type=int, default=8_000, help="of the record (8000)")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    print("nMAE in %      PID true  NMPC true  ours    /NMPC    /PID  load PID  load ours  fit [s]  all [s]")
    for name in options.plants or plants:
        print(row_of(plants[name](), options.rows, {"tuning": "search"}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
