"""The observer laws from an identified model: horizon, the PV that tells of disturbances, and learnt networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import Analysis
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.fit import LevenbergMarquardt
from loopwright.pipeline.models.training.objectives import Samples
from loopwright.pipeline.plants.simulator import Array, Signals

CLEAR_OVER_NOISE = 10.0  # times its noise: an answer over half the MV's range that says enough of the MV
CALM_EIGENVALUE = 0.9  # largest closed-loop eigenvalue that a horizon is taken for at once
LONGEST_INVERSE_HORIZON, TRIED_HORIZONS = 200, 40  # periods: no horizon is longer; how many are tried
# runs to learn from, their horizons, and how many of these do not count
TRAINING_RUNS, RUN_HORIZONS, RUN_IN_HORIZONS = 300, 6, 2
WANDER, JUMP = 0.5, 0.4  # of half the MV's range: standard deviations of its course and of its jumps
INVERSE_SEED = 0  # of the training, and of the levels and noise that its samples come from
LEAST_PV_NOISE = 1e-4  # of a PV's range: a smaller estimate is taken for this
INVERSE_REST_PERIODS, INVERSE_STILL = 1000, 1e-6  # periods to a rest, and what the scaled state then moves in one
SLOPE_NUDGE = 1e-4  # of the scaled state, and of the MV's range: for slopes


@dataclass(frozen=True, slots=True, eq=False)
class HorizonChoice:
    """A horizon and an observed PV, by the linearization x+ = A x + B u, y = C x of the model at a rest.

    S_h is the answer of the CV after h periods of a unit step. The law knows the PVs alone: p'y + s u is the best
    prediction of the CV after h periods from them, see ``branches``. Its inverse, applied anew at every sample,
    gives the loop A - B p'C / s. The horizon is the shortest whose answer is clear, goes the way of the steady one,
    and whose loop is calm:

        |S_h| (range of the MV)/2 >= CLEAR_OVER_NOISE noise,   S_h S_end > 0,   spectral radius <= CALM_EIGENVALUE

    Where no loop is calm, it is the calmest of the horizons with such an answer. Observed is the PV whose answer
    within one period is the largest beside its noise.
    """

    horizon: int
    observed: int  # place among the PVs
    clearness: float  # of the answer over the horizon, in standard deviations of the noise
    radius: float  # of the loop
    ratios: Array  # (n_pv,) answers within a period, in standard deviations of the noise

    @classmethod
    def of(cls, model: Identified, signals: Signals, horizon: int | None, observed: int | None) -> Self:
        """The choice; what is given is taken as it is. Raises LawError for a model in which the MV moves no CV."""
        a, b = linearized(model, signals)
        mv = signals.mv[0]
        noise = (model.noise * model.y_scale).numpy()
        noise = np.maximum(noise, [LEAST_PV_NOISE * (s.high - s.low) for s in signals.pv])
        x = np.zeros(len(a))
        steps = np.array([(x := a @ x + b)[: model.n_y] for _ in range(LONGEST_INVERSE_HORIZON)])  # S_1 first
        answers = steps * model.y_scale.numpy() * (mv.high - mv.low) / 2
        clear = np.abs(answers[:, 0]) / noise[0]
        if not np.any(clear > 0):
            raise LawError(f"in the identified model {mv.name} does not move {signals.pv[0].name}; check the record")
        if horizon is None:
            onward = answers[:, 0] * answers[-1, 0] > 0
            informed = onward & (clear >= CLEAR_OVER_NOISE) if np.any(onward & (clear >= CLEAR_OVER_NOISE)) else onward
            horizon = _calm(a, b, model.n_y, [1 + int(i) for i in np.flatnonzero(informed)])
        ratios = np.abs(answers[0]) / noise
        place = int(ratios.argmax()) if observed is None else observed
        return cls(horizon, place, float(clear[horizon - 1]), _radius(a, b, model.n_y, horizon), ratios)

    def analysis(self, signals: Signals) -> Analysis:
        """The choice in words and figures, for the report."""
        cv, mv, pv = signals.sp[0].name, signals.mv[0].name, signals.pv[self.observed].name
        others = [f"{s.name} {r:.3g}" for s, r in zip(signals.pv, self.ratios, strict=True) if s.name != pv]
        note = (
            f"The law looks {self.horizon} periods ahead: after half the range of {mv}, {cv} has then answered by "
            f"{self.clearness:.3g} standard deviations of its noise, and the inverse over this horizon gives a loop "
            f"whose largest eigenvalue is {self.radius:.2f}. Disturbances are observed on {pv}, whose answer within "
            f"one period is {self.ratios[self.observed]:.3g} standard deviations of its noise"
            + (f" (the others: {', '.join(others)})." if others else ".")
        )
        return Analysis(
            {"horizon": float(self.horizon), "observed_answer": float(self.ratios[self.observed])}, {}, (note,)
        )


def _calm(a: Array, b: Array, n_pv: int, horizons: Sequence[int]) -> int:
    """The first horizon whose loop is calm, and of the first TRIED_HORIZONS the calmest where there is none."""
    radii = {}
    for h in horizons[:TRIED_HORIZONS]:
        radii[h] = _radius(a, b, n_pv, h)
        if radii[h] <= CALM_EIGENVALUE:
            break
    return min(radii, key=lambda h: radii[h]) if min(radii.values()) > CALM_EIGENVALUE else h


def _radius(a: Array, b: Array, n_pv: int, h: int) -> float:
    """Largest eigenvalue of A - B p' C / s, where p'y(k) + s u(k) predicts the CV in h periods (``HorizonChoice``)."""
    start = np.zeros((TRAINING_RUNS, len(a)))
    runs = branches(lambda x, u: x @ a.T + np.outer(u, b), start, h)
    known = np.column_stack([runs.x[:, :n_pv], runs.u])
    found = np.linalg.lstsq(known, runs.ahead[:, 0])[0]
    if not abs(found[-1]) > 0:
        return np.inf
    seen = np.append(found[:-1], np.zeros(len(a) - n_pv))
    return float(np.abs(np.linalg.eigvals(a - np.outer(b, seen) / found[-1])).max())


@dataclass(frozen=True, slots=True, eq=False)
class Branches:
    """States x (N, n_x), MVs u (N,) in half ranges from the middle, and the states after one and h periods of u."""

    x: Array
    u: Array
    following: Array
    ahead: Array


def branches(advance: Callable[[Array, Array], Array], start: Array, h: int) -> Branches:
    """Runs in which the MV wanders, and from several samples of each the MV jumps and stays for h periods.

    The way that the MV wanders is as slow as the horizon is long. Its course and its jumps are normal, as then what
    the PVs do not show of the past is a linear function of what they show: levels that last would let a network tell
    a settled plant from one in motion, which a closed loop never is. ``start`` (TRAINING_RUNS, n_x).
    """
    rng, keep = np.random.default_rng(INVERSE_SEED), float(np.exp(-1 / h))
    x, level = start, WANDER * rng.standard_normal(len(start))
    found = []
    for k in range(1, RUN_HORIZONS * h + 1):
        if k > RUN_IN_HORIZONS * h and k % h == 0:
            u = np.clip(level + JUMP * rng.standard_normal(len(level)), -1, 1)
            after = [advance(x, u)]
            for _ in range(h - 1):
                after.append(advance(after[-1], u))
            found.append((x, u, after[0], after[-1]))
        level = keep * level + np.sqrt(1 - keep**2) * WANDER * rng.standard_normal(len(level))
        x = advance(x, np.clip(level, -1, 1))
    return Branches(*(np.concatenate(part) for part in zip(*found, strict=True)))


def linearized(model: Identified, signals: Signals) -> tuple[Array, Array]:
    """A (n_x, n_x) and B (n_x,) [1/mv] of the scaled state, at the rest in the middle of the MV's range."""
    mv = signals.mv[0]
    v = torch.cat([torch.tensor([mv.middle], dtype=torch.float64), model.v_center[model.n_mv :]])
    with torch.no_grad():
        start = x = model.at_rest(torch.tensor([s.middle for s in signals.pv], dtype=torch.float64), v)
        for _ in range(INVERSE_REST_PERIODS):
            x = model(torch.cat([x, v]))
        away = float((model(torch.cat([x, v])) - x).abs().max())
        # An integrator does not settle: it is linearized where it was begun.
        at = torch.cat([x if away < INVERSE_STILL else start, v])[: model.n_x + 1]
        size = torch.diag(
            torch.tensor([SLOPE_NUDGE] * model.n_x + [SLOPE_NUDGE * (mv.high - mv.low)], dtype=torch.float64)
        )
        both = [torch.cat([at + sign * size, v[1:].expand(len(size), -1)], dim=-1) for sign in (1, -1)]
        slopes = ((model(both[0]) - model(both[1])).T / (2 * size.diagonal())).numpy()
    return slopes[:, :-1], slopes[:, -1]


# units, iterations, and the share of rows that a network is trained on
INVERSE_UNITS, INVERSE_ITERATIONS, INVERSE_TRAIN_SHARE = (10,), 60, 0.8
PARTITIONS = 10  # of the inverse


def learnt_parts(model: Identified, signals: Signals, choice: HorizonChoice) -> dict[str, Model]:
    """The parts ``forward``, ``observer`` and ``inverse``: of the CV over h, of the observed PV over one.

        forward(x(k), u) = y(k + h),   observer(x(k), u) = T(k + 1),   inverse(x, forward(x, u)) = u

    The MV wanders over its range, see ``branches``; measured disturbances stay at the centre of the record. Raises
    LawError where too few samples lie within the ranges of the PVs.
    """
    rows, ahead, following = _rows(model, signals, choice.horizon)
    target = following[:, choice.observed : choice.observed + 1]
    forward = _network(rows, ahead, residual=0)
    observer = _network(rows, target, residual=choice.observed)
    return {"forward": forward, "observer": observer, "inverse": _inverse(forward, rows)}


@torch.no_grad()
def _rows(model: Identified, signals: Signals, h: int) -> tuple[Array, Array, Array]:
    """[pv(k), mv(k)] (N, n_pv + 1), the CV after h periods (N, 1), and the PVs after one (N, n_pv)."""
    mv, n = signals.mv[0], model.n_y
    middle, half = (mv.low + mv.high) / 2, (mv.high - mv.low) / 2
    low, high = (np.array([getattr(s, end) for s in signals.pv]) for end in ("low", "high"))
    nominal = model.v_center[model.n_mv :].expand(TRAINING_RUNS, -1)

    def inputs(u: Array) -> Tensor:
        return torch.cat([torch.from_numpy(middle + half * u)[:, None], nominal], dim=-1)

    def advance(x: Array, u: Array) -> Array:
        after: Array = model(torch.cat([torch.from_numpy(x), inputs(u)], dim=-1)).numpy()
        return after

    levels = np.random.default_rng(INVERSE_SEED).uniform(low, high, (TRAINING_RUNS, n))
    runs = branches(advance, model.at_rest(torch.from_numpy(levels), inputs(np.zeros(TRAINING_RUNS))).numpy(), h)
    pv, following, ahead = (model.measured(torch.from_numpy(x)).numpy() for x in (runs.x, runs.following, runs.ahead))
    rows = np.column_stack([pv, middle + half * runs.u])
    good = np.isfinite(ahead).all(axis=1) & np.all((pv >= low) & (pv <= high), axis=1)
    if good.sum() < TRAINING_RUNS:
        raise LawError(
            f"{good.sum()} of {good.size} rows of the identified model's free runs lie within the ranges of the PVs; "
            "widen the ranges to what the plant visits, or choose law 'predictive'"
        )
    return rows[good], ahead[good, :1], following[good]


def _network(rows: Array, target: Array, residual: int) -> MLP:
    """A network of the change of one PV, the last lanes held out for stopping."""
    cut = round(INVERSE_TRAIN_SHARE * len(rows))
    model = MLP.scaled_to(rows, target, hidden=INVERSE_UNITS, residual=(residual,))
    train, held = Samples(rows[:cut], target[:cut]), Samples(rows[cut:], target[cut:])
    LevenbergMarquardt(iterations=INVERSE_ITERATIONS).fit(model, train, held, seed=INVERSE_SEED)
    return model.eval()


def _inverse(forward: Model, rows: Array) -> Model:
    """A radial basis function network [pv, w] -> mv, of w = forward(pv, mv) over the rows."""
    from loopwright.pipeline.models.static.fuzzy_means import (
        FuzzyMeansRBF,  # scikit-learn is slow to import, few need it
    )

    with torch.no_grad():
        w = forward(torch.from_numpy(rows)).numpy()
    return FuzzyMeansRBF(PARTITIONS).fit(np.hstack([rows[:, :-1], w]), rows[:, -1:]).to_torch()
