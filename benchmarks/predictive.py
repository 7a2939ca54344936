"""The law ``predictive`` from a record alone beside a PID tuned on the true plant: closed loops and step times.

``python benchmarks/predictive.py [--rows N] [--file DIR]``. Two plants by equations: one loop with dead time, an
inverse response and a gain that varies fourfold, and two tanks that both valves fill. The record is open loop with
random holds and noise; the model is fitted to it by output error. The PIDs (one a loop, paired) are tuned by a search
over the scored loops themselves. nMAE in % of the set points' range.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified, assemble_model, noise_of
from loopwright.pipeline.models.identified.linear_start import Realizations, high_order_arx, with_units
from loopwright.pipeline.models.identified.output_error import OutputErrorFit, residuals
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales, folds
from loopwright.pipeline.plants.simulator import Array, Signals
from loopwright.pipeline.records.record import Record
from loopwright.serving import Controller, Signal
from loopwright.serving.card import bench

HOLD, LEVELS = 60, 8


@dataclass(frozen=True)
class Plant:
    """A sampled plant: x+ = advance(x, u, load), y = output(x), batched over leading dimensions."""

    name: str
    advance: Callable[[Array, Array, Array], Array]
    output: Callable[[Array], Array]
    start: Array
    sp: tuple[tuple[float, float], ...]
    noise: float  # share of the set points' range
    load: float  # size of the steps
    settings: tuple[float, ...]  # Kc, Ti, Td of each loop, where the search begins

    @property
    def signals(self) -> Signals:
        """Those of a controller for it."""
        wide = [(low - 0.5 * (high - low), high + 0.5 * (high - low)) for low, high in self.sp]
        pv = tuple(Signal(f"y{i}", "%", *ends) for i, ends in enumerate(wide))
        sp = tuple(Signal(f"y{i}", "%", *ends) for i, ends in enumerate(self.sp))
        return Signals(1.0, sp, pv, (), tuple(Signal(f"u{i}", "%", 0.0, 100.0) for i in range(len(sp))))

    @property
    def span(self) -> Array:
        """Range of the set points (n,)."""
        return np.array([high - low for low, high in self.sp])


def _lagged(x: Array, u: Array, load: Array) -> Array:
    """Dead time of three samples, then a curve of gain .2 to .8, then two lags; the load before the lags."""
    late, x1, x2 = x[..., :3], x[..., 3:4], x[..., 4:5]
    fed = 20 * late[..., 2:] / 100 + 60 * (late[..., 2:] / 100) ** 2 + load
    x1_next = x1 + 0.25 * (fed - x1)
    return np.concatenate([u, late[..., :2], x1_next, x2 + 0.15 * (x1 - x2)], axis=-1)


def _tanks(x: Array, u: Array, load: Array) -> Array:
    """Two upper and two lower tanks; each valve feeds one lower tank and, through an upper one, the other."""
    h = np.maximum(x, 0.0)
    out = 1.1 * np.sqrt(h)
    direct, across = 0.6 * u / 10, 0.4 * u[..., ::-1] / 10
    lower = h[..., :2] + 0.15 * (direct + out[..., 2:] - out[..., :2] + load)
    upper = h[..., 2:] + 0.35 * (across - out[..., 2:])
    return np.maximum(np.concatenate([lower, upper], axis=-1), 0.0)


PLANTS = (
    Plant(
        "one loop",
        _lagged,
        lambda x: 1.4 * x[..., 4:5] - 0.4 * x[..., 3:4],
        np.array([50.0, 50, 50, 25, 25]),
        ((8.0, 60.0),),
        0.01,
        6.0,
        (0.8, 12.0, 2.0),
    ),
    Plant(
        "two by two",
        _tanks,
        lambda x: x[..., :2],
        np.array([20.66, 20.66, 3.31, 3.31]),
        ((10.0, 32.0), (10.0, 32.0)),
        0.01,
        0.8,
        (4.0, 20.0, 1.0, 4.0, 20.0, 1.0),
    ),
)


def record_of(plant: Plant, rows: int, seed: int) -> Record:
    """An open-loop experiment: each MV held for 5 to 40 samples at random levels."""
    rng, n_mv = np.random.default_rng(seed), len(plant.sp)
    moves = np.empty((rows, n_mv))
    for i in range(n_mv):
        k = 0
        while k < rows:
            held = int(rng.integers(5, 40))
            moves[k : k + held, i] = rng.uniform(5, 95)
            k += held
    x, y = plant.start, np.empty((rows, n_mv))
    for k in range(rows):
        y[k] = plant.output(x)
        x = plant.advance(x, moves[k], np.zeros(n_mv))
    return Record.of(plant.signals, y + plant.noise * plant.span * rng.normal(size=y.shape), moves)


def fitted(record: Record, order: int, units: int, seed: int = 0) -> Identified:
    """ARX, realization, output error; then tanh units, output error."""
    n_y = len(record.pv_signals)
    scales = Scales.of(record, n_y)
    data, fold = ScaledRecord.of(record, scales), folds(record)[0]
    train, held = data.rows(fold.train).stretches(), data.rows(fold.held).stretches()
    response = high_order_arx(data).impulse_response(80)
    linear = OutputErrorFit(iterations=20).fit(Realizations.of(response, data.v.std(axis=0)).order(order), train, held)
    run = linear.model.free_run(linear.starts[0], train[0])
    assert run is not None
    grown = with_units(linear.model, run[0], train[0].v, units, seed)
    network = OutputErrorFit(iterations=60, ridge=1.0).fit(grown, train, held)
    print(f"  free run, held out: linear {linear.held_out:.4f}, network {network.held_out:.4f} of a standard deviation")
    left = residuals(network.model, network.starts, train)
    assert left is not None
    known = {"noise": noise_of(left), "colour": np.zeros(n_y), **dict.fromkeys(("pace_sd", "dead_sd"), np.zeros(1))}
    n_v = data.v.shape[1]
    known |= {
        "gain_sd": np.zeros(n_y),
        "load_moves": np.zeros((0, n_y)),
        **dict.fromkeys(("dv_noise", "dv_change"), np.zeros(n_v - n_y)),
    }
    return assemble_model(network.model, [0] * n_v, scales, data, known, n_y, seed)


def courses(plant: Plant, seed: int) -> tuple[Array, Array]:
    """Set points (2 LEVELS HOLD, n) that move and then rest, and loads that rest and then move."""
    rng, n = np.random.default_rng(seed), len(plant.sp)
    low, high = np.array(plant.sp).T
    reach = np.repeat(rng.uniform(low + 0.1 * (high - low), high - 0.1 * (high - low), (LEVELS, n)), HOLD, axis=0)
    if n > 1:  # both far apart is out of reach of the tanks
        reach = 0.6 * reach + 0.4 * reach.mean(axis=1, keepdims=True)
    loads = np.repeat(plant.load * rng.choice([-1.0, 0.0, 1.0], (LEVELS, n)), HOLD, axis=0)
    middle = np.full_like(reach, 0.5 * (low + high))
    return np.concatenate([reach, middle]), np.concatenate([0 * loads, loads])


def scores(plant: Plant, sp: Array, y: Array) -> tuple[Array, Array]:
    """Errors nMAE [%] of the half with set points and of the half with loads."""
    error = 100 * (np.abs(y - sp) / plant.span).mean(axis=-1)
    half = len(sp) // 2
    return error[:half].mean(axis=0), error[half + HOLD // 2 :].mean(axis=0)


def pid_loop(plant: Plant, settings: Array, seed: int) -> tuple[Array, Array]:
    """PVs and MVs (n, loops) of velocity-form PIDs with Kc, Ti, Td (3 loops,), derivative of the measurement."""
    sp, load = courses(plant, seed)
    rng, n = np.random.default_rng(seed + 1), len(plant.sp)
    kc, ti, td = settings.reshape(n, 3).T
    x, u = plant.start, np.full(n, 50.0)
    y1 = plant.output(x)
    e1, d1 = np.zeros(n), np.zeros(n)
    ys, us = np.empty_like(sp), np.empty_like(sp)
    for k in range(len(sp)):
        ys[k] = plant.output(x)
        y = ys[k] + plant.noise * plant.span * rng.normal(size=n)
        e = sp[k] - y
        d = (0.1 * td * d1 + td * (y - y1)) / (0.1 * td + 1)  # filtered with a tenth of Td
        u = np.clip(u + kc * (e - e1 + e / ti - (d - d1)), 0, 100)
        e1, y1, d1, us[k] = e, y, d, u
        x = plant.advance(x, u, load[k])
    return ys, us


def tuned_pid(plant: Plant, seed: int) -> Array:
    """Settings that are best on the sum of both scores, by Nelder and Mead from several starts."""

    def cost(log: Array) -> float:
        y, _ = pid_loop(plant, np.exp(log), seed)
        return float(sum(scores(plant, courses(plant, seed)[0], y)))

    start = np.log(np.array(plant.settings))
    runs = [minimize(cost, start + by, method="Nelder-Mead", options={"maxfev": 250}) for by in (0.0, -0.7)]
    return np.exp(min(runs, key=lambda r: float(r.fun)).x)


@torch.no_grad()
def law_loop(plant: Plant, law: Predictive, seed: int) -> tuple[Array, Array, float]:
    """PVs and MVs of the law in the same loop, and the time of it [s]."""
    sp, load = courses(plant, seed)
    rng, n = np.random.default_rng(seed + 1), len(plant.sp)
    x, u = plant.start, torch.full((n,), 50.0, dtype=torch.float64)
    state, none = torch.zeros(law.n_state, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    ys, us, started = np.empty_like(sp), np.empty_like(sp), time.perf_counter()
    for k in range(len(sp)):
        ys[k] = plant.output(x)
        y = torch.from_numpy(ys[k] + plant.noise * plant.span * rng.normal(size=n))
        u, state, _ = law(torch.from_numpy(sp[k]), y, none, u, state)
        us[k] = u.numpy()
        x = plant.advance(x, us[k], load[k])
    return ys, us, time.perf_counter() - started


def driven(plant: Plant) -> Callable[[Array], Array]:
    """The plant as the parity gate drives it, with its noise."""
    x, rng, n = plant.start, np.random.default_rng(0), len(plant.sp)

    def drive(mv: Array) -> Array:
        nonlocal x
        x = plant.advance(x, mv, np.zeros(n))
        return plant.output(x) + plant.noise * plant.span * rng.normal(size=n)

    return drive


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=4_000)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--file", type=Path, help="folder for the exported controllers, whose steps are then timed")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for plant, (order, units) in zip(PLANTS, ((5, 8), (4, 8)), strict=True):
        started = time.perf_counter()
        print(plant.name)
        model = fitted(record_of(plant, options.rows, options.seed), order, units)
        law = Predictive(plant.signals, model, Predictive.Params()).eval()
        print(f"  model and law in {time.perf_counter() - started:.1f} s: n_x {model.n_x}, {law.moves}")
        settings = tuned_pid(plant, options.seed)
        runs = {
            f"PID {np.round(settings, 2)}": pid_loop(plant, settings, options.seed),
            "predictive": law_loop(plant, law, options.seed)[:2],
        }
        for label, (y, u) in runs.items():
            sp_error, load_error = scores(plant, courses(plant, options.seed)[0], y)
            travel = np.abs(np.diff(u, axis=0)).mean()
            print(f"  {label}: set points {sp_error:.2f} %, loads {load_error:.2f} %, travel {travel:.2f} %")
        if options.file is not None:
            reads = Predictive(plant.signals, model, Predictive.Params(operate={})).eval()
            steps_of({"": law, ", which operators may change": reads}, plant, options.file)


def steps_of(laws: Mapping[str, Predictive], plant: Plant, folder: Path) -> None:
    """The time of a step of each law's file, measured in turn; the second one's over the first one's."""
    controllers = []
    for i, law in enumerate(laws.values()):
        path = folder / f"{plant.name.replace(' ', '_')}{i}.onnx"
        export(law, path, case="benchmark", provenance={}, drive=driven(plant))
        controllers.append(Controller(path))
    rows = [[bench(controller, steps=1000, loop_steps=100) for controller in controllers] for _ in range(5)]
    best = []
    for k, name in enumerate(laws):
        hot, warmed = (min(row[k][i].p50 for row in rows) for i in (0, 1))
        tail = min(row[k][0].p999 for row in rows)
        best.append(hot)
        print(f"  step p50 [us]{name}: hot {hot:.0f}, every 10 ms warmed {warmed:.0f}; p99.9 hot {tail:.0f}")
    print(f"  a step that operators may change takes {best[1] / best[0]:.2f} times as long")


if __name__ == "__main__":
    main()
