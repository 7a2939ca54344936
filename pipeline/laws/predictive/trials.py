"""Closed loops of a law over its own model with errors: set points, loads and noise, drawn once for all candidates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from pipeline.laws.base import ControlLaw
from pipeline.models.identified.identified import Identified
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array

LOOPS = 6  # with set points, and as many with loads
HOLDS = 5  # set points of a loop, and steps of its loads
SETTLE = 300  # samples to come to rest
STILL = 0.25  # share of a movement in the last third of SETTLE from which on it does not end; a level's is 1/3
SPAN = 4.0  # scaled: a record's outputs lie within two standard deviations
REACH = 0.8  # of the MVs' range -1..1: where the set points are rests
GAINS = (1.0, 1.1, 0.9, 1.1, 0.9, 1.0)  # the plant's over the model's, by loop; of several MVs each by its own sign
PACES = (1.0, 1.0, 0.93, 0.93, 1.07, 1.0)  # the plant's speed over the model's
LATE = (0.0, 0.3, 0.0, 0.0, 0.0, 0.3)  # samples by which the plant answers later than its model
BIAS = 0.2  # of half an MV's range: the largest steps of a load at the MV
LOAD = 0.6  # scaled, over the samples of the horizon: steps of a load at the output
DRIFT = 0.15  # of BIAS and LOAD: a sample's share of a load that walks
WALKS = (2, 5)  # loops whose loads walk; the loads of the others step
AT_OUTPUT = (3, 4, 5)  # loops whose loads act on the outputs; those of the others on the MVs


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of C laws: errors of the loops [% of four standard deviations], and the MVs' travel [% of range a sample]."""

    set_points: Array  # (C, LOOPS)
    loads: Array  # (C, LOOPS)
    travel: Array  # (C, 2) with set points, with loads


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """Loops side by side over plants that are the model with errors: of gain, of dead time, of pace.

        x+ = x + p (f(x, m + g (u - m) + bias) - x) + [load; 0]

    with the model f, the gains g, the middle m of the MVs' range and the pace p. The loads are biases of the MVs and
    loads at the outputs, in steps and in random walks; the noise is the model's estimate. Every set point is a rest
    of the loop's own plant, so that all are within reach. An output that never comes to rest, as a level, has set
    points within its record's range.
    """

    model: Identified
    signals: Signals
    quiet: int  # samples at the beginning that do not count
    x0: Tensor  # (2 LOOPS, n_x)
    mv0: Tensor  # (2 LOOPS, n_mv) [mv]
    gain: Tensor  # (2 LOOPS, n_mv)
    pace: Tensor  # (2 LOOPS, 1)
    late: Tensor  # (2 LOOPS, 1) samples
    sp: Tensor  # (n, 2 LOOPS, n_cv) [pv]
    bias: Tensor  # (n, 2 LOOPS, n_mv) [mv]
    load: Tensor  # (n, 2 LOOPS, n_y) scaled
    noise: Tensor  # (n, 2 LOOPS, n_y) [pv]

    @classmethod
    @torch.no_grad()
    def draw(cls, model: Identified, signals: Signals, horizon: int, seed: int) -> Self:
        """Loops with holds of twice the horizon, after one horizon that does not count; a seed gives the same loops."""
        rng, n_cv, n_mv, hold = np.random.default_rng(seed), len(signals.sp), model.n_mv, 2 * horizon
        n, loops = horizon + HOLDS * hold, 2 * LOOPS
        low, high = (np.array([getattr(s, end) for s in signals.mv]) for end in ("low", "high"))
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        signs = rng.choice([-1.0, 1.0], (loops, n_mv)) if n_mv > 1 else np.ones((loops, 1))
        gain = np.tile(GAINS, 2)[:, None] ** signs
        pace = np.tile(PACES, 2)[:, None]
        acting = middle + half * rng.uniform(-REACH, REACH, (HOLDS + 1, loops, n_mv))
        acting[:, LOOPS:] = middle + 0.6 * (acting[:1, LOOPS:] - middle)
        rests, moving = _rests(model, acting.reshape(-1, n_mv))
        x = rests.reshape(HOLDS + 1, loops, -1)
        y = model.measured(x.clamp(-SPAN / 2, SPAN / 2))[..., :n_cv].numpy().copy()
        free = model.measured(torch.from_numpy(rng.uniform(-1.5, 1.5, (HOLDS + 1, loops, model.n_x))))[
            ..., :n_cv
        ].numpy()
        y[..., moving[:n_cv]] = free[..., moving[:n_cv]]
        y[:, LOOPS:] = y[:1, LOOPS:]
        x0 = x[0].clone()
        x0[:, :n_cv] = torch.from_numpy((y[0] - model.y_center[:n_cv].numpy()) / model.y_scale[:n_cv].numpy())
        steps = rng.uniform(0.5, 1.0, (HOLDS, LOOPS, 1)) * rng.choice([-1.0, 0.0, 1.0], (HOLDS, LOOPS, max(n_mv, n_cv)))
        course = np.concatenate([np.zeros_like(steps[:1].repeat(horizon, axis=0)), np.repeat(steps, hold, axis=0)])
        walk = np.cumsum(DRIFT * rng.normal(size=(n, LOOPS, course.shape[-1])), axis=0)
        course[:, WALKS] = np.clip(walk, -1, 1)[:, WALKS]
        bias, load = np.zeros((n, loops, n_mv)), np.zeros((n, loops, model.n_y))
        at_mv = [i for i in range(LOOPS) if i not in AT_OUTPUT]
        bias[:, [LOOPS + i for i in at_mv]] = BIAS * half * course[:, at_mv, :n_mv]
        load[:, [LOOPS + i for i in AT_OUTPUT], :n_cv] = LOAD / horizon * course[:, AT_OUTPUT, :n_cv]
        noise = (model.noise * model.y_scale).numpy() * rng.normal(size=(n, loops, model.n_y))
        mv0 = np.clip(middle + (acting[0] - middle) / gain, low, high)
        late = np.tile(LATE, 2)[:, None]
        sp = np.concatenate([np.repeat(y[:1], horizon, axis=0), np.repeat(y[1:], hold, axis=0)])
        tensors = (x0, mv0, gain, pace, late, sp, bias, load, noise)
        return cls(model, signals, horizon, *(torch.as_tensor(t) for t in tensors))

    @torch.no_grad()
    def run(self, laws: ControlLaw, count: int) -> Outcome:
        """The loops of ``count`` laws side by side; infinite where a loop is not finite."""
        model, (n, loops, n_cv) = self.model, self.sp.shape
        low, high = (torch.tensor([getattr(s, end) for s in self.signals.mv]).double() for end in ("low", "high"))
        middle, n_y = 0.5 * (low + high), model.n_y
        mv, x = self.mv0.expand(count, -1, -1), self.x0.expand(count, -1, -1)
        state = torch.zeros(count, loops, laws.n_state, dtype=torch.float64)
        more = torch.tensor([s.middle for s in self.signals.pv[n_y:]]).double().expand(count, loops, -1)
        dv = model.v_center[len(low) :].expand(count, loops, -1)
        error = torch.zeros(count, loops, dtype=torch.float64)
        travel = torch.zeros(count, loops, dtype=torch.float64)
        for k in range(n):
            y = model.measured(x)
            if k >= self.quiet:
                error += ((y[..., :n_cv] - self.sp[k]).abs() / model.y_scale[:n_cv]).mean(dim=-1)
            before = mv
            wanted = self.sp[k].expand(count, -1, -1)
            mv, state, _ = laws(wanted, torch.cat([y + self.noise[k], more], dim=-1), dv, mv, state)
            if k >= self.quiet:
                travel += ((mv - before).abs() / (high - low)).mean(dim=-1)
            late = mv + self.late * (before - mv)
            acting = middle + self.gain * (late - middle) + self.bias[k]
            x = x + self.pace * (model(torch.cat([x, acting, dv], dim=-1)) - x)
            x = torch.cat([x[..., :n_y] + self.load[k], x[..., n_y:]], dim=-1)
        error, travel = (100 / (n - self.quiet) * t for t in (error / SPAN, travel))
        error = torch.nan_to_num(error, nan=torch.inf)
        moved = torch.stack([travel[:, :LOOPS].mean(dim=-1), travel[:, LOOPS:].mean(dim=-1)], dim=-1)
        return Outcome(error[:, :LOOPS].numpy(), error[:, LOOPS:].numpy(), moved.numpy())


def _rests(model: Identified, mv: Array) -> tuple[Tensor, Array]:
    """States (n, n_x) after SETTLE samples under mv (n, n_mv), and which outputs (n_y,) never come to rest.

    Where an output runs away, the state is that of a rest in the middle of the record.
    """
    v = torch.cat([torch.from_numpy(mv), model.v_center[model.n_mv :].expand(len(mv), -1)], dim=-1)
    x = start = late = model.at_rest(model.y_center.expand(len(mv), -1), v)
    for k in range(SETTLE):
        x, late = model(torch.cat([x, v], dim=-1)), x if k == SETTLE * 2 // 3 else late
    moved, lately = ((x - since)[:, : model.n_y].abs().median(dim=0).values for since in (start, late))
    within = x.abs().amax(dim=-1, keepdim=True) < 2 * SPAN
    return torch.where(within, x, start), (lately > STILL * moved).numpy()
