"""Closed loops of one controller file over drawn plants, all of a batch side by side."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.evaluation.closed_loop import left_limits, lock_ups, swings
from loopwright.pipeline.evaluation.stress.draws import Actuators, Draw, Drawing
from loopwright.pipeline.evaluation.stuck_loops import kept_by_ranges
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.identified import IdentifiedPlant, StateEquation
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.serving.controller import Controller
from loopwright.serving.manifest import OperateEntry
from loopwright.serving.operating import Operate
from loopwright.serving.vectorized_controller import ComputeRows, VectorizedController

AdvanceRows = Callable[[Array, Array, Array, Array], Array]
"""``advance(x (n, n_x), mv (n, n_mv), dv (n, n_dv), p (n, n_p)) -> x (n, n_x)`` one period later."""


def advance_rows(plant: Simulator, n: int) -> AdvanceRows:
    """``plant.step`` of ``n`` rows. A row's numbers do not depend on the other rows, nor on how many there are."""
    if isinstance(plant, EquationPlant):
        return _equations(plant, n)
    if isinstance(plant, IdentifiedPlant):
        return lambda x, mv, dv, p: _identified(plant, x, mv, dv, p)

    def one_by_one(x: Array, mv: Array, dv: Array, p: Array) -> Array:
        return np.array([plant.step(*row) for row in zip(x, mv, dv, p, strict=True)], dtype=np.float64)

    return one_by_one


def _equations(plant: EquationPlant, n: int) -> AdvanceRows:
    batch = plant.transition.map(n)

    def advance(x: Array, mv: Array, dv: Array, p: Array) -> Array:
        return np.array(batch(x.T, mv.T, dv.T, p.T)).T

    return advance


def _identified(plant: IdentifiedPlant, x: Array, mv: Array, dv: Array, p: Array) -> Array:
    """``IdentifiedPlant.step`` with parameters of each row."""
    f, m, n, most = plant.arrays, plant.n_mv, len(plant.arrays.a), plant.most_dead_time
    v0 = plant.start_inputs[:m]
    gain, tau, dead, load = p[:, :m], p[:, m : m + 1], p[:, m + 1], p[:, m + 2 :]
    v = (np.concatenate([mv, dv], axis=1) - f.v_center) / f.v_scale
    held = np.concatenate([v[:, :m], x[:, n:]], axis=1)
    whole = np.minimum(dead.astype(np.int64), most)
    part = (np.minimum(dead, most) - whole)[:, None]
    newest, after = whole[:, None] * m + np.arange(m), np.minimum(whole + 1, most)[:, None] * m + np.arange(m)
    acting = (1 - part) * np.take_along_axis(held, newest, axis=1) + part * np.take_along_axis(held, after, axis=1)
    inputs = np.concatenate([v0 + gain * (acting - v0), v[:, m:]], axis=1)
    now = x[:, :n]
    ahead = _advanced(f, now, inputs)
    slow = now + (ahead - now) / np.maximum(tau, 1.0)
    second = _advanced(f, np.where(plant.remembers, now, ahead), inputs)
    fast = ahead + (1 / np.minimum(tau, 1.0) - 1) * (second - ahead)
    ahead = np.where(plant.remembers | (tau == 1.0), ahead, np.where(tau > 1.0, slow, fast))
    ahead[:, : load.shape[1]] += load / f.y_scale
    return np.concatenate([ahead, held[:, : most * m]], axis=1)


def _advanced(f: StateEquation, x: Array, v: Array) -> Array:
    """``f.advance`` whose sums have one order: a library's product rounds a row by how many rows there are."""
    z = np.concatenate([x, v], axis=1)
    found = _product(z, np.concatenate([f.a, f.b], axis=1)) + f.c
    return found + _product(np.tanh(_product(z, f.w1) + f.b1), f.w2) if len(f.w1) else found


def _product(x: Array, weights: Array) -> Array:
    """``x @ weights.T``, summed from the first column on."""
    total = np.zeros((len(x), len(weights)))
    for j in range(x.shape[1]):
        total += x[:, j, None] * weights[:, j]
    return total


# ----------------------------------------------------------------------------------------------------------- the loops
@dataclass(frozen=True)
class StressOutcome:
    """Figures of one loop. One that left what the plant can compute has infinite figures.

    ``swings`` says whether a controlled variable still swings about its set point as the test ends: no failure by
    itself, but no loop to leave alone.
    """

    index: int
    figures: dict[str, float]
    locked_up: bool
    left_limits: bool
    refused: int  # samples
    broke: bool
    swings: bool = False

    @property
    def failures(self) -> tuple[str, ...]:
        """How the loop failed, of LOOP_FAILURES; empty where it did not."""
        return tuple(name for name, holds in LOOP_FAILURES.items() if holds(self))

    @property
    def failed(self) -> bool:
        """Whether the loop is lost, whatever its figures."""
        return bool(self.failures)


REFUSED, SWINGS = "had a refused sample", "swings to the end"
LOOP_FAILURES: Mapping[str, Callable[[StressOutcome], bool]] = {
    "locked up": lambda o: o.locked_up,
    "left its limits": lambda o: o.left_limits,
    REFUSED: lambda o: o.refused > 0,
    "left what the plant can compute": lambda o: o.broke,
}
"""How a loop can fail: words that go on ``a loop that ...`` -> whether one did."""


@dataclass(frozen=True)
class Stress:
    """The needs of a worker for a batch of loops: how they are drawn, and the bytes of the controller file.

    ``operate`` holds the values, by name, of what operators have changed; the rest are the file's defaults. ``compute``
    computes the steps in place of the controller's session, and goes to the workers with all else.
    """

    drawing: Drawing
    content: bytes
    operate: tuple[tuple[str, float], ...] = ()
    compute: ComputeRows | None = None

    @cached_property
    def controller(self) -> Controller:
        """The controller, from its bytes: a worker sees no files of the client."""
        with tempfile.TemporaryDirectory(prefix="loopwright-stress-") as folder:
            path = Path(folder) / "controller.onnx"
            path.write_bytes(self.content)
            return Controller(path)

    @cached_property
    def entries(self) -> tuple[OperateEntry, ...]:
        """Entries of ``operate`` with what operators have changed as their defaults."""
        asked = dict(self.operate)
        return tuple(replace(e, default=asked.get(e.name, e.default)) for e in self.controller.manifest.operate)

    @cached_property
    def operated(self) -> Array | None:
        """Values of ``operate`` (n_operate,); None where they are the defaults. ContractError for a wrong one."""
        return Operate(self.controller.manifest.operate).with_values(dict(self.operate)) if self.operate else None

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}  # a session stays where it was made

    def outcomes(self, indices: Sequence[int]) -> list[StressOutcome]:
        """Figures of the loops with these numbers, in order."""
        return [self._outcome(draw, *loop) for draw, loop in self.loops(self.drawing.draws(indices))]

    def loop(self, index: int) -> tuple[Draw, Trajectory, StressOutcome]:
        """One loop with its course."""
        ((draw, loop),) = self.loops([self.drawing.draw(index)])
        return draw, loop[0], self._outcome(draw, *loop)

    def loops(self, draws: Sequence[Draw]) -> list[tuple[Draw, tuple[Trajectory, bool]]]:
        """(draw, (course, whether the plant left what it can compute)) in order; info of a course: step refused."""
        groups = dict[tuple[int, int], list[int]]()
        for i, draw in enumerate(draws):
            key = (id(self.drawing.plant_of(draw.scenario)), draw.scenario.samples)
            groups.setdefault(key, []).append(i)
        found = dict[int, tuple[Trajectory, bool]]()
        for places in groups.values():
            found.update(zip(places, self._together([draws[i] for i in places]), strict=True))
        return [(draw, found[i]) for i, draw in enumerate(draws)]

    def _together(self, draws: Sequence[Draw]) -> list[tuple[Trajectory, bool]]:
        """Loops over plants of one kind and tests of one length."""
        plant, tests = self.drawing.plant_of(draws[0].scenario), [draw.scenario for draw in draws]
        n, samples, std = len(draws), tests[0].samples, self.drawing.case.noise_std
        sp = np.stack([t.sp for t in tests], axis=1)
        dv = np.stack([t.disturbances(plant) for t in tests], axis=1)
        noise = np.stack([d.deviation(plant, std) for d in draws], axis=1)
        measured = dv + np.stack([d.dv_deviation(plant) for d in draws], axis=1)
        known = [t.parameters(plant) for t in tests]
        mv0, x = np.stack([t.mv0 for t in tests]), np.stack([t.x0 for t in tests])
        law, advance = VectorizedController(self.controller, n, self.compute), advance_rows(plant, n)
        operate = None if self.operated is None else np.tile(self.operated, (n, 1))
        actuators = Actuators(plant.mv_signals, [d.fault for d in draws], mv0, [d.late for d in draws])
        state, readback, broke = law.cold_state(), mv0.copy(), np.zeros(n, dtype=bool)
        pvs, mvs = np.empty((samples, n, noise.shape[2])), np.empty((samples, *mv0.shape))
        xs, refused = np.empty((samples, *x.shape)), np.zeros((samples, n), dtype=bool)
        for k in range(samples):
            xs[k], pvs[k] = x, plant.measured(x)
            seen = pvs[k] + noise[k]
            step = law.step(sp=sp[k], pv=seen, dv=measured[k], mv_applied=readback, state=state, operate=operate)
            refused[k] = step.refused
            command = np.where(step.refused[:, None], readback, step.mv)
            state = np.where(step.refused[:, None], 0.0, step.state)
            mvs[k], acting = actuators.move(k, command)
            readback = mvs[k]
            p = np.stack([table[k] for table in known])
            ahead = advance(x, acting, dv[k], p)
            fine: NDArray[np.bool_] = np.all(np.isfinite(ahead), axis=1)
            broke |= ~fine
            x = np.where(fine[:, None], ahead, x)
        time_s = np.arange(samples, dtype=np.float64) * plant.period_s
        return [
            (
                Trajectory(
                    time_s, sp[:, i], pvs[:, i], pvs[:, i] + noise[:, i], mvs[:, i], xs[:, i],
                    refused[:, i, None].astype(np.float64),
                ),
                bool(broke[i]),
            )
            for i in range(n)
        ]  # fmt: skip

    def _outcome(self, draw: Draw, loop: Trajectory, broke: bool) -> StressOutcome:
        case, plant, test = self.drawing.case, self.drawing.plant_of(draw.scenario), draw.scenario
        n_cv = test.sp.shape[1]
        mvs, cvs = plant.mv_signals[:n_cv], plant.sp_signals
        spans = [s.high - s.low for s in cvs]
        limits: dict[str, list[float]] = {end: [getattr(s, end) for s in mvs] for end in ("low", "high")}
        ends: dict[str, list[float]] = {end: [getattr(s, end) for s in cvs] for end in ("low", "high")}
        jammed = lock_ups(loop.sp, loop.pv[:, :n_cv], loop.mv[:, :n_cv], test.hold, **limits, span=case.asked)
        # A loop that is broken has no figures of worth; as infinite ones they count as worst.
        figures = case.score(test, loop.pv, loop.mv)
        return StressOutcome(
            draw.index,
            dict.fromkeys(figures, float("inf")) if broke else figures,
            not all(kept_by_ranges(case, test, loop, self.entries, of) for of in jammed),
            left_limits(loop.pv[:, :n_cv], test.hold, **ends),
            int(loop.info.sum()),
            broke,
            bool(np.any(swings(loop.sp, loop.pv[:, :n_cv], np.array(spans)))),
        )


def figures_of(outcomes: Sequence[StressOutcome], name: str) -> Array:
    """One figure of all loops, (n,); NaN of a loop whose test has no such figure."""
    return np.array([one.figures.get(name, np.nan) for one in outcomes])


def opened(path: Path) -> tuple[Controller, bytes]:
    """The controller of a file, and the bytes to send; ArtifactError where it is none."""
    return Controller(path), path.read_bytes()
