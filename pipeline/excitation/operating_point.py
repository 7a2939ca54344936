"""Excitation where the plant is meant to run: dither around a feedback, and held moves from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.excitation.base import Excitation, within
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import noise_draws, simulate_batch
from loopwright.pipeline.tuning.rules import AllPole, PidSettings, imc_pid, robust_imc


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """One closed-loop run: states (n, n_x), measured PVs (n, n_pv) and MVs (n, 1) at its samples."""

    x: Array
    pv: Array
    mv: Array


@dataclass(frozen=True, kw_only=True)
class OperatingPoint(Excitation):
    """Closed-loop data around random set points, and short runs restarted from the states visited.

    An unstable operating region is hardly ever visited in open loop. A PID keeps the plant there
    while a dither on its MV excites it. From states of that run, moves of one random MV held for
    ``move_hold`` samples then show what every MV does there. Each closed-loop run stands in the
    record right before the short runs that start from it, so that a split in time separates states too.

    Attributes
    ----------
    samples [-]
        Closed-loop samples in all.
    run_length [-]
        Samples after which the loop is started anew, at the steady state of a random set point;
        a loop that has lost its plant at a limit is thereby set free.
    sp_low, sp_high [unit of the CV]
        Range of the set points; default: its signal's, less 2 % at both ends.
    sp_hold_low, sp_hold_high [-]
        Fewest and most samples for which a set point is held.
    filter_s [s]
        Time constant of the IMC filter that sets the PID for the plant linearized at ``tune_cv``;
        default: the shortest one that is robust (``robust_imc``).
    tune_cv [unit of the CV]
        CV of that steady state; default: the middle of the set points' range.
    kc [MV/CV], ti_s, td_s [s]
        Gain, integral and derivative time of the PID itself, instead of IMC.
    dither [unit of the MV]
        The dither is uniform over +-dither; default: 5 % of the MV's range.
    dither_hold [-]
        Samples for which a dither is held.
    restarts [-]
        Number of short runs, each of moves * move_hold + 1 rows.
    moves [-]
        Moves of a short run, one after the other. Several lead on from the states that the feedback
        visits to those which a controller meets that uses the whole MV.
    move_hold [-]
        Samples for which each MV of a short run is held.
    near [unit of the MV]
        Standard deviation, around the MV that the feedback had used in that state, of the MVs that
        are not drawn over the whole range; default: 10 % of the MV's range.
    near_fraction [-]
        Fraction of the short runs whose first MV is such a one.
    end_fraction [-]
        Fraction of the other moves that go to an end of the MV's range.
    """

    kind: ClassVar[str] = "operating_point"
    run_length: int = within(1_000, 1)
    sp_low: float | None = None
    sp_high: float | None = None
    sp_hold_low: int = within(20, 1)
    sp_hold_high: int = 80
    filter_s: float | None = None
    tune_cv: float | None = None
    kc: float | None = None
    ti_s: float | None = None
    td_s: float = within(0.0, 0)
    dither: float | None = within(None, 0)
    dither_hold: int = within(3, 1)
    restarts: int = field(metadata={"range": (1, np.inf)})
    moves: int = within(1, 1)
    move_hold: int = within(3, 1)
    near: float | None = within(None, 0)
    near_fraction: float = within(0.5, 0, 1)
    end_fraction: float = within(0.0, 0, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("sp_hold_high", self.sp_hold_low)

    def run(self, plant: Simulator, seed: int) -> Record:
        """The record: closed-loop runs, each followed by the short runs from its states.

        Raises PlantError for a plant with more than one MV.
        """
        if len(plant.mv_signals) != 1:
            raise PlantError(f"plant {plant.name!r} has {len(plant.mv_signals)} MVs; {self.kind!r} excites exactly one")
        rng = np.random.default_rng(seed)
        lengths = np.diff(np.r_[np.arange(0, self.samples, self.run_length), self.samples])
        pid = self.settings(plant)
        loops = [self.closed_loop(plant, pid, int(n), rng) for n in lengths]
        return self.with_moves(plant, loops, rng)

    def set_points(self, plant: Simulator) -> tuple[float, float]:
        """Lowest and highest set point."""
        sp = plant.sp_signals[0]
        rim = 0.02 * (sp.high - sp.low)
        low = sp.low + rim if self.sp_low is None else self.sp_low
        high = sp.high - rim if self.sp_high is None else self.sp_high
        if not sp.low <= low < high <= sp.high:
            raise PlantError(
                f"excitation {self.kind!r}: set points from {low:g} to {high:g} {sp.unit}; "
                f"sp_low < sp_high within {sp.low:g} to {sp.high:g} are allowed"
            )
        return low, high

    def settings(self, plant: Simulator) -> PidSettings:
        """The PID that holds the plant at its set points."""
        if self.kc is not None:
            return PidSettings(self.kc, np.inf if self.ti_s is None else self.ti_s, self.td_s)
        cv = sum(self.set_points(plant)) / 2 if self.tune_cv is None else self.tune_cv
        known = equations(plant, f"excitation {self.kind!r} without its own kc and ti_s")
        lin = known.linearize(*known.steady_state_at(cv))
        return robust_imc(lin, plant.period_s) if self.filter_s is None else imc_pid(AllPole.of(lin), self.filter_s)

    def closed_loop(self, plant: Simulator, pid: PidSettings, n: int, rng: np.random.Generator) -> Loop:
        """One run of n samples around random set points, from the steady state of a random one.

        A plant without equations begins every run where it starts.

            v(k) = v(k-1) + Kc [ e(k) - e(k-1) + (h/Ti) e(k) - (Td/h) (y - 2 y1 + y2) ],  mv = v + dither

        v is limited to the MV's range, which is the anti-windup; mv is limited to it as well.
        """
        sp_low, sp_high = self.set_points(plant)
        low, high, h = plant.mv_signals[0].low, plant.mv_signals[0].high, plant.period_s
        reach = 0.05 * (high - low) if self.dither is None else self.dither
        step, dv, p = plant.stepper(), plant.dv_nominal, plant.parameters()
        first = float(rng.uniform(sp_low, sp_high))
        state, steady_mv = plant.steady_state_at(first) if isinstance(plant, EquationPlant) else plant.start
        noise = noise_draws(plant, n, self.noise, rng)
        x, pv, mv = np.empty((n, len(state))), np.empty((n, noise.shape[1])), np.empty((n, 1))
        v, past, left = float(steady_mv[0]), None, 0
        sp = dither = 0.0
        for k in range(n):
            x[k] = state
            pv[k] = plant.measure(state) + noise[k]
            if left == 0:
                sp = float(rng.uniform(sp_low, sp_high))
                left = int(rng.integers(self.sp_hold_low, self.sp_hold_high + 1))
            left -= 1
            if k % self.dither_hold == 0:
                dither = float(rng.uniform(-reach, reach))
            y = float(pv[k, 0])
            e1, y1, y2 = (sp - y, y, y) if past is None else past
            v += pid.kc * (sp - y - e1 + h / pid.ti_s * (sp - y) - pid.td_s / h * (y - 2 * y1 + y2))
            v = min(max(v, low), high)
            past = (sp - y, y, y1)
            mv[k] = min(max(v + dither, low), high)
            state = step(state, mv[k], dv, p)
        return Loop(x, pv, mv)

    def with_moves(self, plant: Simulator, loops: Sequence[Loop], rng: np.random.Generator) -> Record:
        """The record of the loops and of held moves restarted from their states."""
        visited = np.concatenate([loop.x for loop in loops])
        used = np.concatenate([loop.mv for loop in loops])
        # Sorted, so that the short runs follow the loop in which their states were visited.
        pick = np.sort(rng.integers(len(visited), size=self.restarts))
        move = np.repeat(self.sequence(plant, used[pick, 0], rng), self.move_hold, axis=1)
        rows = move.shape[1] + 1
        x = simulate_batch(plant, visited[pick], move[:, :, None])
        # The last row shows where the last move led; its MV acts on nothing any more.
        move = np.hstack([move, move[:, -1:]])
        noise = noise_draws(plant, self.restarts * rows, self.noise, rng)
        pv = (plant.measured(x).reshape(len(noise), -1) + noise).reshape(self.restarts, rows, -1)
        ends = np.searchsorted(pick, np.cumsum([len(loop.x) for loop in loops]))
        pvs: list[Array] = []
        mvs: list[Array] = []
        lengths: list[int] = []
        for loop, start, end in zip(loops, np.r_[0, ends[:-1]], ends, strict=True):
            pvs += [loop.pv, pv[start:end].reshape(-1, pv.shape[2])]
            mvs += [loop.mv, move[start:end].reshape(-1, 1)]
            lengths += [len(loop.x), *[rows] * int(end - start)]
        run = np.repeat(np.arange(len(lengths)), lengths)
        return Record.of(plant.signals, np.concatenate(pvs), np.concatenate(mvs), run=run, dv=plant.dv_nominal)

    def sequence(self, plant: Simulator, used: Array, rng: np.random.Generator) -> Array:
        """The MVs of each short run, shape (restarts, moves): over the whole range, the first maybe near ``used``."""
        signal = plant.mv_signals[0]
        shape = (len(used), self.moves)
        anywhere = rng.uniform(signal.low, signal.high, shape)
        end = np.where(rng.random(shape) < 0.5, signal.low, signal.high)
        moves = np.where(rng.random(shape) < self.end_fraction, end, anywhere)
        spread = 0.1 * (signal.high - signal.low) if self.near is None else self.near
        close = np.clip(used + spread * rng.standard_normal(len(used)), signal.low, signal.high)
        moves[:, 0] = np.where(rng.random(len(used)) < self.near_fraction, close, moves[:, 0])
        return moves
