"""Trials of exported files over every test of their case: loops, their figures, in pieces that fill a cluster."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Final, Literal

import numpy as np

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.evaluation.closed_loop import STEP_BAND, last_half, swings
from loopwright.pipeline.evaluation.extrapolation import reached_by, widest
from loopwright.pipeline.evaluation.law_evidence import BASE, Cycle
from loopwright.pipeline.evaluation.metric import DRAW_SEEDS, TRAVEL, mean_of_draws, together
from loopwright.pipeline.evaluation.stuck_loops import seized, swings_on
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario
from loopwright.pipeline.simulation.simulate import (
    DV_DRAW,
    Trajectory,
    noise_of_disturbances,
    read_now,
    simulate_closed,
)
from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import Signal

# --------------------------------------------------- limit cycles at the end of loops on models, where no valve sticks
MV_SWING: Final = 0.05  # of an MV's range: a valve that swings farther to the end wears, whatever the CV does
NOISES: Final = 5.0  # standard deviations of the noise: a smaller swing of a CV is lost in them


def cycle_of(case: Case, test: Scenario, loop: Trajectory) -> Cycle | None:
    """The limit cycle of a loop without noise, by the signal that goes farthest beyond its limit; None without one.

    Over the last half of what comes after the last move of a set point or a disturbance a CV goes from one side of its
    set point to the other, or an MV of its mean, as ``swings`` counts. The limit of a CV is ``STEP_BAND`` of the span
    of the case's set points, within which a step counts as settled, and no less than ``NOISES`` of its noise; that of
    an MV is ``MV_SWING`` of its range. An MV of a few allowed values has to swing and does not count.
    """
    n, measured = test.sp.shape[1], [] if test.dv is None else [test.dv]
    half = last_half(test.sp, *test.changes.values(), *measured)
    limits = np.maximum(STEP_BAND * case.asked, NOISES * case.noise_std[:n])
    found = _beyond(case.plant.sp_signals, (loop.pv[:, :n] - loop.sp)[half], limits, case.plant.period_s)
    mvs = [i for i, s in enumerate(case.plant.mv_signals) if s.values is None]
    moved = loop.mv[half][:, mvs]
    signals = [case.plant.mv_signals[i] for i in mvs]
    ranges = np.array([s.high - s.low for s in signals])
    found += _beyond(signals, moved - moved.mean(axis=0), MV_SWING * ranges, case.plant.period_s)
    return max(found, key=lambda one: one.times, default=None)


def _beyond(signals: Sequence[Signal], about: Array, limits: Array, period_s: float) -> list[Cycle]:
    """The cycles of signals (n, signals) about 0 beyond their limits (signals,)."""
    found = []
    which = swings(np.zeros_like(about), about, limits, 1.0, whole=True)
    for s, course, limit, on in zip(signals, about.T, limits, which, strict=True):
        if on:
            amplitude = float(np.ptp(course)) / 2
            found.append(Cycle(s.name, s.unit, amplitude, _period(course, limit) * period_s, amplitude / float(limit)))
    return found


def _period(course: Array, limit: float) -> float:
    """Samples of a whole swing: twice those between the changes of side of a course (n,) beyond a limit, on average."""
    beyond = np.flatnonzero(np.abs(course) > limit)
    changed = beyond[1:][np.diff(np.sign(course[beyond])) != 0]
    return 2.0 * float(changed[-1] - changed[0]) / (len(changed) - 1)


# ---------------------------------------------------------------------------- the closed loops of one file over a test
Metrics = dict[str, float]
TIMING_ROUNDS = 8  # of timing a step
TIMED = 1_000  # samples of a round
DEVELOPED: Final = "development"  # stands for all development sequences among the names of tests
DEVELOPMENT = 100_000  # added to the noise's seed over the development sequences


@dataclass(frozen=True)
class Trial:
    """One file's closed loops: figures by scenario (noisy ones under their own names), curves, faults."""

    form: str
    seed: int
    info: tuple[str, ...]
    metrics: dict[str, Metrics]
    sequences: dict[str, dict[str, Metrics]]  # of the tests with several sequences, by their seeds
    development: float  # the case's metric over the development sequences, see ``Case.developed``
    development_travel: float  # of the MVs over these, their mean; nan without any
    locked_up: dict[str, int]  # test -> closed loops that locked up, of those where any did; DEVELOPED: development
    swings: dict[str, int]  # the same of closed loops that swing to the end
    beyond_reach: dict[str, int]  # test -> holds that count as no lock-up: no control gets there
    curves: dict[str, Trajectory]
    reached: dict[str, tuple[float, float]]  # without noise, models gone wrong apart, PVs and MVs; of a case on models
    cycles: dict[str, Cycle]  # test -> its worst limit cycle, without noise; of a case on models alone
    cycling: Trajectory | None  # the loop with the worst of them

    @property
    def lock_ups(self) -> int:
        """Closed loops that locked up, those of the development included."""
        return sum(self.locked_up.values())

    @property
    def development_lock_ups(self) -> int:
        """The ones of these over the development sequences."""
        return self.locked_up.get(DEVELOPED, 0)


@dataclass(frozen=True)
class Repeated:
    """One test, repeated with different noise where it is noisy: mean figures, the first loop.

    And of all the lock-ups, those that swing to the end, and the holds whose set point is beyond reach; without noise,
    on models, the limit cycle.
    """

    metrics: Metrics
    first: Trajectory
    lock_ups: int
    swings: int
    beyond_reach: int = 0
    cycle: Cycle | None = None


def repeated(controller: Controller, case: Case, test: Scenario, noise: bool, seed: int) -> Repeated:
    """One test; with noise it runs ``noise_draws`` times."""
    draws = range(case.noise_draws if noise else 1)
    loops = [
        close_loop(
            controller, case.plant, test, case.noise_std if noise else None, seed + DRAW_SEEDS * i, case.read_every
        )
        for i in draws
    ]
    rows = [case.score(test, loop.pv, loop.mv) for loop in loops]
    found = [seized(case, test, loop, controller.manifest.operate) for loop in loops]
    swing = sum(swings_on(case, test, loop) for loop in loops)
    cycle = cycle_of(case, test, loops[0]) if case.on_models and not noise and not test.replayed else None
    return Repeated(
        mean_of_draws(rows),
        loops[0],
        sum(jammed for jammed, _ in found),
        max(swing, int(cycle is not None)),
        sum(holds for _, holds in found),
        cycle,
    )


def close_loop(
    controller: Controller,
    plant: Simulator,
    test: Scenario,
    noise: Array | None,
    seed: int,
    every: Sequence[int] = (),
) -> Trajectory:
    """One closed loop over the test's plant, or over ``plant`` where it has none.

    With ``every``, see ``simulate_closed``, some PVs are read now and then; a law that reads ``fresh`` is told when.

    An extra entry of info is 1 if the controller refused the step. The MV then stays at its last value, as in the real
    loop's HOLD. With noise, measured disturbances have theirs.
    """
    plant, state = test.plant or plant, controller.cold_state()
    disturbances = test.disturbances(plant)
    if noise is not None:
        disturbances = disturbances + noise_of_disturbances(plant, test.samples, np.random.default_rng([seed, DV_DRAW]))
    measured, n_info, samples = iter(disturbances), len(controller.manifest.info), count()
    operated = test.operated(controller.manifest.operate)
    asked = None if operated is None else iter(operated.values)
    told = bool(every) and "fresh" in controller.manifest.inputs

    def step(sp: Array, pv: Array, mv_applied: Array) -> tuple[Array, tuple[float, ...]]:
        nonlocal state
        steered = {} if asked is None else {"operate": next(asked)}
        steered |= {"fresh": read_now(every, next(samples)).astype(np.float64)} if told else {}
        given = {"sp": sp, "pv": pv, "dv": next(measured), "mv_applied": mv_applied, "state": state}
        try:
            mv, state, info = controller.step(**given, **steered)
        except LoopwrightError:
            state = controller.cold_state()
            return mv_applied, (*(0.0 for _ in range(n_info)), 1.0)
        return mv, (*info.tolist(), 0.0)

    return simulate_closed(plant, step, test, noise=noise, seed=seed, every=every)


def step_us(controller: Controller, loop: Trajectory, dv: Array) -> dict[str, float]:
    """Time of one step along a loop under dv (n_dv,) [us], with all checks: the fastest of several rounds.

    A round is the loop's first 1,000 samples. Other processes can slow it down.
    """
    n = min(len(loop.sp), TIMED + 1)
    rounds = np.empty((TIMING_ROUNDS, n - 1))
    for taken in rounds:
        state = controller.cold_state()
        for k in range(1, n):
            begun = time.perf_counter()
            sample = {"sp": loop.sp[k], "pv": loop.pv[k], "dv": dv, "mv_applied": loop.mv[k - 1]}
            state = controller.step(**sample, state=state).state
            taken[k - 1] = 1e6 * (time.perf_counter() - begun)
    p50, p99 = np.quantile(rounds, [0.5, 0.99], axis=1)
    best = int(np.argmin(p50))
    return {"p50": float(p50[best]), "p99": float(p99[best])}


# ------------------------------------------------------------------------------------------------- all tests of a case
Kind = Literal["scored", "development", "shown"]


@dataclass(frozen=True)
class TrialPiece:
    """The smallest part of a trial: one sequence of one test."""

    form: str
    seed: int
    path: Path
    kind: Kind
    test: str
    place: int
    noise: bool = False

    @property
    def key(self) -> str:
        """The name of the figures, and of the curve."""
        return self.test + (NOISE_SUFFIX if self.noise else "")


@dataclass(frozen=True)
class TrialResult:
    """The result of a piece; the first sequence of a test alone brings its curve."""

    info: tuple[str, ...]
    metrics: Metrics
    lock_ups: int
    swings: int
    beyond_reach: int
    curve: Trajectory | None
    reached: dict[str, tuple[float, float]] | None
    cycle: tuple[Cycle, Trajectory] | None  # of a scored test


class Trials:
    """Trials of files over a case's tests; the shipped form also runs the development sequences.

    Variants run the tests in ``variants_run``, with noise only if development has noise too.
    """

    def __init__(self, case: Case, noise_seed: int) -> None:
        self.case, self.noise_seed = case, noise_seed
        self._opened: tuple[Path, Controller] | None = None  # pieces of one file come one after the other

    @cached_property
    def sequences(self) -> dict[Kind, Mapping[str, tuple[Scenario, ...]]]:
        """The sequences of each test, computed once a process: their steady states take their time."""
        shown = {name: (test,) for name, test in self.case.unscored().items()}
        return {"scored": self.case.scenarios(), "shown": shown, DEVELOPED: {DEVELOPED: self.case.development()}}

    def pieces(self, form: str, seed: int, path: Path) -> list[TrialPiece]:
        """The pieces of the trial of one file."""
        found = list[TrialPiece]()
        for kind, tests in self.sequences.items():
            for name, sequences in tests.items():
                if form != BASE and (kind == DEVELOPED or (kind == "scored" and not self.case.variants_run(sequences))):
                    continue
                for noise in self._noises(form, kind):
                    if noise and sequences[0].replayed:
                        continue
                    found += [TrialPiece(form, seed, path, kind, name, i, noise) for i in range(len(sequences))]
        return found

    def _noises(self, form: str, kind: Kind) -> tuple[bool, ...]:
        if kind == DEVELOPED:
            return (self.case.development_noise,)
        return (False, True) if kind == "scored" and (form == BASE or self.case.development_noise) else (False,)

    def run(self, piece: TrialPiece) -> TrialResult:
        """The closed loops of a piece."""
        test, case = self.sequences[piece.kind][piece.test][piece.place], self.case
        controller, seed = self._controller(piece.path), self.noise_seed + piece.place
        if piece.kind == DEVELOPED:
            seed += DEVELOPMENT
        one = repeated(controller, case, test, piece.noise, seed)
        # A plant gone wrong may overshoot far on a model that is a straight line: such figures say nothing of ranges.
        told = piece.kind == "scored" and not piece.noise and piece.test not in case.gone_wrong
        reached = reached_by([one.first], case) if case.on_models and told else None
        kept = piece.kind != DEVELOPED and piece.place == 0
        counts = one.lock_ups, one.swings, one.beyond_reach
        cycle = (one.cycle, one.first) if one.cycle is not None and piece.kind == "scored" else None
        return TrialResult(controller.manifest.info, one.metrics, *counts, one.first if kept else None, reached, cycle)

    def weight(self, piece: TrialPiece) -> float:
        """The cost of a piece beside others: its samples."""
        samples = self.sequences[piece.kind][piece.test][piece.place].samples
        return float(samples * (self.case.noise_draws if piece.noise else 1))

    def trial(self, found: Mapping[TrialPiece, TrialResult]) -> Trial:
        """The trial of one file from its pieces, which are in their order."""
        metrics, locked_up, swings, beyond = dict[str, Metrics](), dict[str, int](), dict[str, int](), dict[str, int]()
        curves, sequences = dict[str, Trajectory](), dict[str, dict[str, Metrics]]()
        for piece, ran in found.items():
            locked_up[piece.key] = locked_up.get(piece.key, 0) + ran.lock_ups
            swings[piece.key] = swings.get(piece.key, 0) + ran.swings
            beyond[piece.key] = beyond.get(piece.key, 0) + ran.beyond_reach
            if ran.curve is not None:
                curves[piece.key] = replace(ran.curve, info=ran.curve.info[:, :-1])
            if piece.kind != "scored" or piece.key in metrics:
                continue
            rows = [r.metrics for p, r in found.items() if (p.kind, p.key) == (piece.kind, piece.key)]
            metrics[piece.key] = together(rows, self.case.metrics)
            if len(rows) > 1 and not piece.noise:
                tests = self.sequences[piece.kind][piece.test]
                sequences[piece.test] = {str(t.seed): row for t, row in zip(tests, rows, strict=True)}
        developed = [r.metrics for p, r in found.items() if p.kind == DEVELOPED]
        first, ran = next(iter(found.items()))
        # Of each test the worst comes last; of all, on plants gone wrong where there is no other.
        cycles = sorted(
            ((*r.cycle, p.key) for p, r in found.items() if r.cycle is not None),
            key=lambda c: (c[2] not in self.case.gone_wrong, c[0].times),
        )
        return Trial(
            first.form,
            first.seed,
            ran.info,
            metrics,
            sequences,
            self.case.developed([row[self.case.metric] for row in developed]),
            statistics.fmean(row[TRAVEL] for row in developed) if developed else math.nan,
            {name: count for name, count in locked_up.items() if count},
            {name: count for name, count in swings.items() if count},
            {name: count for name, count in beyond.items() if count},
            curves,
            widest(r.reached for r in found.values() if r.reached is not None),
            {key: cycle for cycle, _, key in cycles},
            cycles[-1][1] if cycles else None,
        )

    def _controller(self, path: Path) -> Controller:
        if self._opened is None or self._opened[0] != path:
            self._opened = path, Controller(path)
        return self._opened[1]


def try_files(case: Case, noise_seed: int, files: Sequence[tuple[str, int, Path]], label: str) -> list[Trial]:
    """The trials of several files, each of a (form, data seed), under a label for their progress."""
    trials = Trials(case, noise_seed)
    each = [trials.pieces(*file) for file in files]
    work = [piece for pieces in each for piece in pieces]
    ran = parallel_map(trials.run, work, label, [trials.weight(piece) for piece in work], in_folder=True)
    found = iter(ran)
    return [trials.trial({piece: next(found) for piece in pieces}) for pieces in each]
