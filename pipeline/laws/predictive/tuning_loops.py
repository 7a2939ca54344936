"""Closed loops of a law over its own model with errors: set points, loads and noise, drawn once for all candidates."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from loopwright.pipeline.laws.base import ControlLaw
from loopwright.pipeline.laws.predictive.disturbance_model import REST_SAMPLES
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.identified import StateEquation, shift_rows
from loopwright.pipeline.plants.noise import coloured, deviation
from loopwright.pipeline.plants.simulator import Array, Signals, likely_error

M = TypeVar("M", bound=nn.Module)


def side_by_side(laws: Sequence[M]) -> M:
    """A law for inputs (C, loops, n) whose first index is that of the law among ``laws``.

    A buffer in which the laws differ has all their values, (C, 1, ...), or (C, 1, 1, n) of vectors. They must have the
    same shapes, as laws of one model with the same horizon and moves do.
    """
    together = copy.deepcopy(laws[0])
    buffers = [dict(law.named_buffers()) for law in laws]
    for name, values in buffers[0].items():
        if any(not torch.equal(values, other[name]) for other in buffers[1:]):
            owner, _, leaf = name.rpartition(".")
            stacked = torch.stack([b[name] for b in buffers]).unsqueeze(1)
            # The laws compute with rows (..., 1, n), whose second last index a vector lacks.
            setattr(together.get_submodule(owner), leaf, stacked.unsqueeze(1) if values.ndim == 1 else stacked)
    return together


# ----------------------------------------------------------------------------------------------------------- the loops
LOOPS = 6  # with set points, and as many with loads
LOOP_HOLDS = 5  # set points of a loop, and steps of its loads
# share of a movement in the last third of REST_SAMPLES from which on it does not end; a level's is 1/3
UNENDED_MOVEMENT = 0.25
SPAN = 4.0  # scaled: a record's outputs lie within two standard deviations
SET_POINT_REACH = 0.8  # of the MVs' range -1..1: where the set points are rests
# By loop, with set points and with loads: as the model; slow, late by DEAD_TIME_ERROR and with a high gain (of several
# MVs each by its own sign); fast with a low one. Errors that come together are worse than each alone.
LOOP_GAINS = (0, 1, -1, 1, -1, 0)
LOOP_PACES = (0, -1, 1, -1, 1, 0)  # powers of 1 + the error of pace, by loop
# multiples of DEAD_TIME_ERROR by which a plant is late, by loop; LATEST_LOOP has its own
LOOP_DEAD_TIMES = (0, 1, 0, 1, 0, 0)
# The loop as late as the record leaves open, and as the model in all else: a model with another dead time explains the
# record alike, so that its gain and its pace are no further off. Slow plants of a high gain that were so late, too,
# cost 20 to 40 % of error under loads where the model's dead time was right.
LATEST_LOOP = 5
# least errors; larger ones of pace and dead time calm loops that need no calm
GAIN_ERROR, PACE_ERROR, DEAD_TIME_ERROR = 0.25, 0.15, 0.5
MOST_TUNED_ERROR = 1.0  # of each error
LATEST_ANSWER = 0.25  # of the horizon, that plants answer later at most
BIAS = 0.2  # of half an MV's range: the largest steps of a load at the MV
OUTPUT_LOAD = 0.6  # scaled, over the samples of the horizon: steps of a load at the output
LOAD_WALK = 0.15  # of BIAS and OUTPUT_LOAD: a sample's share of a load that walks
WALKS = (2, 5)  # loops whose loads walk; the loads of the others step
STATE_NUDGE = 1e-9  # scaled
AT_OUTPUT = (3, 4, 5)  # loops whose loads act on the outputs; those of the others on the MVs


@dataclass(frozen=True, slots=True)
class LoopErrors:
    """The errors of the loops of C laws [% of four standard deviations], and the MVs' travel [% of range a sample]."""

    set_points: Array  # (C, LOOPS)
    loads: Array  # (C, LOOPS)
    travel: Array  # (C, 2) with set points, with loads


@dataclass(frozen=True, eq=False)
class TuningLoops:
    """Loops side by side over plants that are the model with errors: of gain, of dead time, of pace.

        F(x) = f(x, m + g (u - m) + bias),      x+ = x + p (F(x) - x) + [load; 0]

    with the model f, the gains g, the middle m of the MVs' range and the pace p; where p is above 1, a part of a second
    step, which leaves a stable model stable: x+ = F(x) + (p - 1) (F(F(x)) - F(x)) + [load; 0]. States that only
    remember keep their pace. The loads are biases of the MVs and loads at the outputs, in steps and in random walks;
    the noise is the model's estimate, that of the measured disturbances included. Every set point is a rest of the
    loop's own plant, so that all are within reach. An output that never comes to rest, as a level, has set points
    within its record's range. Errors of gain and pace are what the record leaves open (``likely_error``), and no less
    than ``GAIN_ERROR`` and ``PACE_ERROR``; plants are late by ``DEAD_TIME_ERROR``, and one, which is the model in all
    else, by what the record leaves open where that is more.
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
    dv_noise: Tensor  # (n, 2 LOOPS, n_dv) [dv]

    @classmethod
    @torch.no_grad()
    def draw(cls, model: Identified, signals: Signals, horizon: int, seed: int) -> Self:
        """Loops with holds of twice the horizon, after one horizon that does not count; a seed gives the same loops."""
        rng, n_cv, n_mv, hold = np.random.default_rng(seed), len(signals.sp), model.n_mv, 2 * horizon
        n, loops = horizon + LOOP_HOLDS * hold, 2 * LOOPS
        low, high = (np.array([getattr(s, end) for s in signals.mv]) for end in ("low", "high"))
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        signs = rng.choice([-1.0, 1.0], (loops, n_mv)) if n_mv > 1 else np.ones((loops, 1))
        gain, pace, late = _errors(model, signs, LATEST_ANSWER * horizon)
        # Every set point is a rest under MVs that act; a plant with another gain is given others for them.
        acting = middle + half * rng.uniform(-SET_POINT_REACH, SET_POINT_REACH, (LOOP_HOLDS + 1, loops, n_mv))
        acting[:, LOOPS:] = middle + 0.6 * (acting[:1, LOOPS:] - middle)
        x0, levels = _rests(model, acting, rng)
        levels[:, LOOPS:] = levels[:1, LOOPS:]
        x0[:, : model.n_y] = levels[0]
        sp = model.measured(levels)[..., :n_cv]
        sp = torch.cat([sp[:1].expand(horizon, -1, -1), sp[1:].repeat_interleave(hold, dim=0)])
        mv0 = np.clip(middle + (acting[0] - middle) / gain, low, high)
        course = _courses(rng, horizon, hold, max(n_mv, n_cv))
        bias, load = np.zeros((n, loops, n_mv)), np.zeros((n, loops, model.n_y))
        for i in range(LOOPS):
            if i in AT_OUTPUT:
                load[:, LOOPS + i, :n_cv] = OUTPUT_LOAD / horizon * course[:, i, :n_cv]
            else:
                bias[:, LOOPS + i] = BIAS * half * course[:, i, :n_mv]
        if model.recorded:
            own = [*range(LOOPS), *(LOOPS + i for i in AT_OUTPUT if i in WALKS)]
            load[:, own] = _replayed(model, n, horizon, len(own))
        colour = model.colour.numpy()
        sd = deviation((model.noise * model.y_scale).numpy(), colour)
        noise = sd * coloured(rng.normal(size=(n, loops, model.n_y)), colour)
        dv_sd = (model.dv_noise * model.v_scale[n_mv:]).numpy()
        dv_noise = dv_sd * rng.normal(size=(n, loops, model.n_dv))
        drawn = (torch.as_tensor(t) for t in (mv0, gain, pace, late, sp, bias, load, noise, dv_noise))
        return cls(model, signals, horizon, x0, *drawn)

    @torch.no_grad()
    def run(self, laws: ControlLaw, count: int) -> LoopErrors:
        """The loops of ``count`` laws side by side; infinite where a loop is not finite."""
        n_cv, span = self.sp.shape[-1], self._span
        error = torch.zeros(count, self.sp.shape[1], dtype=torch.float64)
        travel = error.clone()
        for k, (y, before, mv) in enumerate(self._samples(laws, self.x0.expand(count, -1, -1))):
            if k >= self.quiet:
                error += ((y[..., :n_cv] - self.sp[k]).abs() / self.model.y_scale[:n_cv]).mean(dim=-1)
                travel += ((mv - before).abs() / span).mean(dim=-1)
        error, travel = (100 / (len(self.sp) - self.quiet) * t for t in (error / SPAN, travel))
        error = torch.nan_to_num(error, nan=torch.inf)
        moved = torch.stack([travel[:, :LOOPS].mean(dim=-1), travel[:, LOOPS:].mean(dim=-1)], dim=-1)
        return LoopErrors(error[:, :LOOPS].numpy(), error[:, LOOPS:].numpy(), moved.numpy())

    @torch.no_grad()
    def growth(self, law: ControlLaw) -> float:
        """The largest difference of an MV, over its range, that a far smaller one of the first states makes of it.

        In units of that one. Some tens at most where the loop forgets; a loop that does not is thrown by rounding,
        and by noise.
        """
        drawn = np.random.default_rng(0).normal(size=self.x0.shape)
        x = torch.stack([self.x0, self.x0 + STATE_NUDGE * torch.from_numpy(drawn)])
        found = [((mv[1] - mv[0]).abs() / self._span).max() for _, _, mv in self._samples(law, x)]
        return float(torch.nan_to_num(torch.stack(found), nan=torch.inf).max()) / STATE_NUDGE

    @property
    def _span(self) -> Tensor:
        """Range (n_mv,) of the MVs."""
        return torch.tensor([s.high - s.low for s in self.signals.mv], dtype=torch.float64)

    def ahead(self, x: Tensor, v: Tensor) -> Tensor:
        """The states (..., 2 LOOPS, n_x) one period later at the loops' paces, without loads."""
        model, once, pace = self.model, self._remembers, self.pace
        ahead = model(torch.cat([x, v], dim=-1))
        fast = torch.nonzero(pace[:, 0] > 1)[:, 0]
        paced = x + pace * (ahead - x)
        begun = torch.where(once, x, ahead)[..., fast, :]
        second = model(torch.cat([begun, v[..., fast, :]], dim=-1))
        paced[..., fast, :] = begun + (pace[fast] - 1) * (second - begun)
        return torch.where(once, ahead, paced)

    @cached_property
    def _remembers(self) -> Tensor:
        """The states (n_x,) that are copies of another state or an input of the period before."""
        m = self.model
        return torch.from_numpy(shift_rows(StateEquation(*(t.numpy() for t in (m.a, m.b, m.c, m.w1, m.b1, m.w2)))))

    def _samples(self, laws: ControlLaw, x: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Outputs, the MV before and the MV, sample by sample, of loops from the states x (count, 2 LOOPS, n_x)."""
        model, (n, loops, _), count = self.model, self.sp.shape, len(x)
        middle, n_y = torch.tensor([s.middle for s in self.signals.mv]).double(), model.n_y
        mv = self.mv0.expand(count, -1, -1)
        whole = self.late[:, 0].long()
        acted = [mv] * (int(whole.max()) + 2)  # the latest MVs, the last one first
        state = torch.zeros(count, loops, laws.n_state, dtype=torch.float64)
        more = torch.tensor([s.middle for s in self.signals.pv[n_y:]]).double().expand(count, loops, -1)
        dv = model.v_center[len(middle) :].expand(count, loops, -1)
        for k in range(n):
            y, before = model.measured(x), mv
            wanted = self.sp[k].expand(count, -1, -1)
            mv, state, _ = laws(wanted, torch.cat([y + self.noise[k], more], dim=-1), dv + self.dv_noise[k], mv, state)
            yield y, before, mv
            acted = [mv, *acted[:-1]]
            late = _late(acted, whole, self.late - whole[:, None])
            acting = middle + self.gain * (late - middle) + self.bias[k]
            x = self.ahead(x, torch.cat([acting, dv], dim=-1))
            x = torch.cat([x[..., :n_y] + self.load[k], x[..., n_y:]], dim=-1)


def _late(acted: Sequence[Tensor], whole: Tensor, rest: Tensor) -> Tensor:
    """The MVs (..., 2 LOOPS, n_mv) of ``whole`` samples (2 LOOPS,) and the ``rest`` (2 LOOPS, 1) of one before."""
    if not bool(whole.any()):
        return acted[0] + rest * (acted[1] - acted[0])
    past, loops = torch.stack(list(acted), dim=-3), torch.arange(len(whole))  # (..., samples, 2 LOOPS, n_mv)
    near, far = past[..., whole, loops, :], past[..., whole + 1, loops, :]
    return near + rest * (far - near)


def _errors(model: Identified, signs: Array, latest: float) -> tuple[Array, Array, Array]:
    """Gains (2 LOOPS, n_mv) and paces (2 LOOPS, 1) over the model's, and how much later (2 LOOPS, 1) plants answer.

    ``signs`` (2 LOOPS, n_mv) say which MVs' gains are wrong the other way round; ``latest`` are the most samples.
    """
    gain, pace, dead = (
        likely_error(sd.numpy(), least, most)
        for sd, least, most in (
            (model.gain_sd, GAIN_ERROR, MOST_TUNED_ERROR),
            (model.pace_sd, PACE_ERROR, MOST_TUNED_ERROR),
            (model.dead_sd, DEAD_TIME_ERROR, latest),
        )
    )
    late = DEAD_TIME_ERROR * np.array(LOOP_DEAD_TIMES, dtype=np.float64)
    late[LATEST_LOOP] = dead[0] if dead[0] > DEAD_TIME_ERROR else 0.0
    turned = np.tile(LOOP_GAINS, 2)[:, None] * signs
    return (1 + gain) ** turned, (1 + pace) ** np.tile(LOOP_PACES, 2)[:, None], np.tile(late, 2)[:, None]


def _courses(rng: np.random.Generator, horizon: int, hold: int, count: int) -> Array:
    """Loads (n, LOOPS, count) within -1..1, none over the first horizon: steps, or random walks in the loops WALKS."""
    steps = rng.uniform(0.5, 1.0, (LOOP_HOLDS, LOOPS, 1)) * rng.choice([-1.0, 0.0, 1.0], (LOOP_HOLDS, LOOPS, count))
    course = np.repeat(steps, hold, axis=0)
    course[:, WALKS] = np.clip(np.cumsum(LOAD_WALK * rng.normal(size=course[:, WALKS].shape), axis=0), -1, 1)
    return np.concatenate([np.zeros((horizon, LOOPS, count)), course])


def _replayed(model: Identified, n: int, quiet: int, loops: int) -> Array:
    """Loads (n, loops, n_y), scaled, as the record's went on, from nothing after ``quiet`` samples, each elsewhere."""
    moves = model.load_moves.numpy()
    # Of a short record each loop begins elsewhere, too, and goes on from its end to its beginning.
    firsts = np.linspace(0, max(len(moves) - (n - quiet), 0) or len(moves), loops, endpoint=False).astype(int)
    rows = firsts[None, :] + np.arange(n - quiet)[:, None]
    course = np.cumsum(moves[rows % len(moves)], axis=0)  # (n - quiet, loops, n_y)
    return np.concatenate([np.zeros((quiet, loops, model.n_y)), course])


def _rests(model: Identified, mv: Array, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """States (loops, n_x) after REST_SAMPLES under the first of mv (n, loops, n_mv), and outputs (n, loops, n_y).

    An output that never comes to rest has random values within its record's range, and where anything runs away the
    state is that of a rest in the middle of the record. All scaled.
    """
    dv = model.v_center[model.n_mv :]
    v = torch.cat([torch.from_numpy(mv), dv.expand(*mv.shape[:-1], -1)], dim=-1)
    x = start = late = model.at_rest(model.y_center.expand(*v.shape[:-1], -1), v)
    for k in range(REST_SAMPLES):
        x, late = model(torch.cat([x, v], dim=-1)), x if k == REST_SAMPLES * 2 // 3 else late
    moved, lately = ((x - since)[..., : model.n_y].abs().flatten(0, 1).median(dim=0).values for since in (start, late))
    free = torch.from_numpy(rng.uniform(-1.5, 1.5, (*mv.shape[:-1], model.n_y)))
    y = torch.nan_to_num(x[..., : model.n_y]).clamp(-SPAN / 2, SPAN / 2)
    within = x[0].abs().amax(dim=-1, keepdim=True) < 2 * SPAN
    return torch.where(within, x[0], start[0]), torch.where(lately > UNENDED_MOVEMENT * moved, free, y)
