"""The predictive law's numbers from closed loops over spoilt models: no plant, and nothing tuned by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from pipeline.laws.base import ControlLaw
from pipeline.models.identified.identified import Identified
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array

VARIANTS = 4  # of each member, each once with set points and once with loads
GAIN = 0.25  # the members' gains are wrong by up to this share
HOLDS = 5  # set points of a loop, and steps of its loads
SETTLE = 300  # samples to come to rest
SPAN = 4.0  # scaled: a record's outputs lie within two standard deviations
BIAS = 0.12  # of half an MV's range: the steps of a load at the valve
LOAD = 0.6  # scaled, over the samples of the horizon: steps of a load at the output, worth .25 at rest
DRIFT = 0.1  # of LOAD: a sample's share of a load that walks
WORST, TRAVEL = 0.3, 0.05  # weights of the worst loop beyond the mean, and of the MVs' travel
FACTORS: Mapping[str, tuple[float, ...]] = {
    "move_weight": (0.1, 0.3, 3.0, 10.0),
    "q_d": (0.2, 4.0, 16.0),
    "horizon": (0.7, 1.3),
    "q_x": (10.0, 30.0),
}
"""Of each number's starting value, in the order of the search."""

NEAR = (0.5, 2.0)
"""Factors of the first number when it is looked at again."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Numbers that were tried, and their cost: J of ``Trials.cost`` [%]."""

    numbers: dict[str, float]
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """Closed loops side by side: the members with wrong gains, half of the loops with set points, half with loads.

    In every second loop the plant answers one sample later than its model does.

    The loads are biases of the valves and loads at the outputs, in steps and in random walks. A law's model must not
    be all that it is tuned on: without errors of gain and drifting loads the search makes the observer too slow.
    """

    members: Sequence[Identified]
    signals: Signals
    x0: list[Tensor]  # (loops, n_x) of each member
    gain: Tensor  # (members, loops, n_mv)
    sp: Tensor  # (n, members, loops, n_cv)
    bias: Tensor  # (n, members, loops, n_mv) [mv]
    load: Tensor  # (n, members, loops, n_y) scaled
    noise: Tensor  # (n, members, loops, n_y) [pv]

    @classmethod
    @torch.no_grad()
    def draw(cls, members: Sequence[Identified], signals: Signals, horizon: int, seed: int) -> Self:
        """Loops with holds of twice the horizon; the same seed gives the same loops."""
        rng, n_cv, m = np.random.default_rng(seed), len(signals.sp), len(members)
        n_y, n_mv = members[0].n_y, members[0].n_mv
        hold, loops = 2 * horizon, 2 * VARIANTS
        shape = (HOLDS * hold, m, loops)
        gain = 1 + GAIN * rng.uniform(-1, 1, (m, loops, n_mv))
        gain[:, [0, VARIANTS]] = 1.0
        low, high = (np.array([getattr(s, end) for s in signals.mv]) for end in ("low", "high"))
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        x0, sp = [], np.empty((*shape, n_cv))
        for i, member in enumerate(members):
            start = _settled(member, middle[None])
            x0.append(start.expand(loops, -1))
            levels = _settled(member, middle + half * rng.uniform(-0.7, 0.7, (HOLDS * VARIANTS, n_mv)))
            y = member.measured(levels.clamp(-SPAN / 2, SPAN / 2))[:, :n_cv].numpy().reshape(HOLDS, VARIANTS, n_cv)
            sp[:, i, :VARIANTS] = np.repeat(y, hold, axis=0)
            sp[:, i, VARIANTS:] = member.measured(start)[:, :n_cv].numpy()
        bias, load = np.zeros((*shape, n_mv)), np.zeros((*shape, n_y))
        steps = rng.choice([-1.0, 0.0, 1.0], (HOLDS, m, VARIANTS, n_mv))
        bias[:, :, VARIANTS:] = BIAS * half * np.repeat(steps, hold, axis=0)
        walk = DRIFT * np.cumsum(rng.normal(size=(shape[0], m, VARIANTS, n_y)), axis=0)
        steps = np.repeat(rng.choice([-1.0, 0.0, 1.0], (HOLDS, m, VARIANTS, n_y)), hold, axis=0)
        odd = np.arange(VARIANTS)[:, None] % 2
        load[:, :, VARIANTS:] = LOAD / horizon * (odd * np.clip(walk, -2, 2) + (1 - odd) * steps)
        sizes = np.stack([(x.noise * x.y_scale).numpy() for x in members])
        noise = sizes[:, None] * rng.normal(size=(*shape, n_y))
        return cls(members, signals, x0, *(torch.from_numpy(t) for t in (gain, sp, bias, load, noise)))

    @torch.no_grad()
    def cost(self, law: ControlLaw) -> float:
        """J = sum over set points and loads of mean + .3 (worst - mean) of the loops' nMAE, + .05 travel, in %.

        nMAE counts a scaled error against 4; infinite where a loop is not finite.
        """
        error, travel = self._run(law)
        found = 0.0
        for part in (error[:, :VARIANTS], error[:, VARIANTS:]):
            found += (1 - WORST) * float(part.mean()) + WORST * float(part.max())
        found += TRAVEL * travel
        return found if np.isfinite(found) else np.inf

    def _run(self, law: ControlLaw) -> tuple[Array, float]:
        """NMAE [%] (members, loops), and mean travel [% of the MVs' range a sample]."""
        n, m, loops, n_cv = self.sp.shape
        low, high = (torch.tensor([getattr(s, end) for s in self.signals.mv]).double() for end in ("low", "high"))
        middle = 0.5 * (low + high)
        mv = middle.expand(m, loops, -1)
        state = torch.zeros(m, loops, law.n_state, dtype=torch.float64)
        n_y = self.load.shape[-1]
        more = torch.tensor([s.middle for s in self.signals.pv[n_y:]]).double().expand(m, loops, -1)
        dv = torch.stack([member.v_center[len(low) :] for member in self.members])[:, None].expand(m, loops, -1)
        error, travel, x = torch.zeros(m, loops, dtype=torch.float64), 0.0, list(self.x0)
        late = torch.arange(loops)[:, None] % 2 == 1
        scale = torch.stack([member.y_scale[:n_cv] for member in self.members])[:, None]
        for k in range(n):
            y = torch.stack([member.measured(at) for member, at in zip(self.members, x, strict=True)])
            error += ((y[..., :n_cv] - self.sp[k]).abs() / scale).mean(dim=-1)
            before = mv
            mv, state, _ = law(self.sp[k], torch.cat([y + self.noise[k], more], dim=-1), dv, mv, state)
            travel += float(((mv - before).abs() / (high - low)).mean())
            acting = middle + self.gain * (torch.where(late, before, mv) - middle) + self.bias[k]
            for i, member in enumerate(self.members):
                x[i] = member(torch.cat([x[i], acting[i], dv[i]], dim=-1))
                x[i] = torch.cat([x[i][:, :n_y] + self.load[k, i], x[i][:, n_y:]], dim=-1)
        return np.asarray((100 / SPAN / n * error).numpy()), 100 / n * travel


def searched(
    trials: Trials, law_of: Callable[[Mapping[str, float]], ControlLaw], start: Mapping[str, float]
) -> tuple[Candidate, list[Candidate]]:
    """The best numbers by a coordinate search from ``start``, and all that were tried, the start first.

    Each number in turn takes the factor of FACTORS that costs least; the first one's neighbours are looked at again.
    """
    best = Candidate(dict(start), trials.cost(law_of(start)))
    tried = [best]
    names = [name for name in FACTORS if name in start]
    rounds = [*((name, FACTORS[name]) for name in names), *((name, NEAR) for name in names[:1])]
    for name, factors in rounds:
        at = best.numbers[name]
        for factor in factors:
            value = at * factor
            numbers = {**best.numbers, name: float(np.clip(round(value), 8, 60)) if name == "horizon" else value}
            if any(numbers == c.numbers for c in tried):
                continue
            tried.append(Candidate(numbers, trials.cost(law_of(numbers))))
        best = min(tried, key=lambda c: c.cost)
    return best, tried


def _settled(member: Identified, mv: Array) -> Tensor:
    """States (n, n_x) after SETTLE samples under mv (n, n_mv); a level's are where they started."""
    v = torch.cat([torch.from_numpy(mv), member.v_center[member.n_mv :].expand(len(mv), -1)], dim=-1)
    start = x = member.at_rest(member.y_center.expand(len(mv), -1), v)
    for _ in range(SETTLE):
        x = member(torch.cat([x, v], dim=-1))
    within = x.abs().amax(dim=-1, keepdim=True) < 2 * SPAN
    return torch.where(within, x, start)
