"""Training of a controller through time: the loop over the plant's network shall follow the reference model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import Analysis, require_kind, require_single_loop
from loopwright.pipeline.laws.reference.reference_law import Loops, PlantNetwork, ReferenceParams, Training
from loopwright.pipeline.laws.reference.reference_networks import Trainable
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.state_space import StateSpace
from loopwright.pipeline.models.training.objectives import input_jacobian
from loopwright.pipeline.plants.simulator import Array, Signals
from loopwright.pipeline.tuning.reference_model import ReferenceModel

P = TypeVar("P", bound=Trainable)

DAMPING_TRIES = 8  # tries an iteration


class LoopSums(NamedTuple):
    """Mean squared residual of the loops, and J'J (P, P) and J'r (P,) for a step of Gauss and Newton."""

    cost: float
    tracking: float  # mean square of y_m - y alone [pv^2]
    square: Array
    slope: Array


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """Weights that were best on the validation loops, and the RMS distance from the reference model on the way [pv].

    ``history`` (iterations + 1, 2): training and validation, of the best restart; ``best`` is its row.
    """

    theta: Array
    history: Array
    best: int


def follow(
    policy: Trainable,
    theta: Array,
    plant: PlantNetwork,
    model: ReferenceModel,
    loops: Loops,
    move_weight: float,
    derivatives: bool = True,
) -> LoopSums:
    r"""Run the loops with forward sensitivities, dx/dtheta beside x.

        X(k+1) = f_x X(k) + f_u U(k),   U(k) = du/dtheta + u_y C X(k) + u_u U(k-1) + u_e E(k-1),   E = -C X

    with X = dx/dtheta, U = du/dtheta in all, E = de/dtheta, all zero at the start. Where the MV is at an end
    of its range, U is zero. The residuals are y_m - y, of the true y, and the weighted moves. Without
    ``derivatives`` the sums of the result stay zero.
    """
    signals = policy.signals
    mv, cv = signals.mv[0], signals.sp[0]
    weight = move_weight * (cv.high - cv.low) / (mv.high - mv.low)
    phi, gamma = model.sampled(signals.period_s)
    n, lanes = loops.sp.shape
    x, u, before = loops.x0.copy(), loops.u0.copy(), np.zeros(lanes)
    course = np.zeros((lanes, model.order))
    course[:, 0] = x[:, 0]
    sx, su = np.zeros((lanes, plant.n_x, policy.size)), np.zeros((lanes, policy.size))
    se = np.zeros_like(su)
    square, slope = np.zeros((policy.size, policy.size)), np.zeros(policy.size)
    tracking = moves = 0.0
    for k in range(n):
        distance = course[:, 0] - x[:, 0]
        tracking += float(distance @ distance)
        y = x[:, 0] + loops.noise[k]
        action = policy.act(theta, np.column_stack([loops.sp[k], y, u[:, 0], before, course]))
        before = course[:, 0] - y
        given = np.clip(action.mv, mv.low, mv.high)[:, None]
        change = weight * (given - u)[:, 0]
        moves += float(change @ change)
        u = given
        x, jac = plant.step(x, u)
        x += loops.load[k]
        if derivatives:
            cv_slope = sx[:, 0]
            square += cv_slope.T @ cv_slope
            slope += distance @ cv_slope
            free = (action.mv > mv.low) & (action.mv < mv.high)
            after = action.by_theta + action.by_cv[:, None] * cv_slope
            after += action.by_mv[:, None] * su
            after += action.by_before[:, None] * se
            after *= free[:, None]
            moved = weight * (after - su)
            square += moved.T @ moved
            slope -= change @ moved
            su, se = after, -cv_slope
            sx = np.matmul(jac[:, : plant.n_x].transpose(0, 2, 1), sx)
            sx += jac[:, plant.n_x][:, :, None] * su[:, None, :]
        course = course @ phi.T + loops.sp[k][:, None] * gamma[:, 0]
    count = n * lanes
    return LoopSums((tracking + moves) / count, tracking / count, square, slope)


def trained_policy(
    make: Callable[[float], P], params: ReferenceParams, models: Mapping[str, Model], signals: Signals, law: str
) -> tuple[ReferenceModel, P, Trained]:
    """The reference model, the controller that ``make`` gives for the sign of the plant's gain, and its weights.

    It is trained through part ``state_space``. Raises LawError without that part, and as ``train`` does.
    """
    require_single_loop(signals, law)
    plant, reference = require_kind(models, StateSpace, law), params.model(law)
    policy = make(gain_sign(plant, signals))
    return reference, policy, train(policy, plant, reference, params.training)


def train(policy: Trainable, model: StateSpace, reference: ReferenceModel, options: Training) -> Trained:
    """Levenberg-Marquardt on the loops of ``options``, stopped early by its validation loops; the best restart.

    Raises LawError where no restart gives a loop with finite states.
    """
    plant = PlantNetwork(model)
    held = [Loops.drawn(plant, policy.signals, options, np.random.default_rng([options.seed, i])) for i in range(2)]
    restarts = []
    for restart in range(options.restarts):
        start = policy.drawn(np.random.default_rng([options.seed, 2 + restart]))
        with np.errstate(all="ignore"):
            restarts.append(_descend(policy, start, plant, reference, held, options))
    best = min(restarts, key=lambda t: t.history[t.best, 1])
    if not np.isfinite(best.history[best.best, 1]):
        raise LawError("the training found no loop with finite states; check the plant's network, or its range")
    return best


def _descend(
    policy: Trainable,
    theta: Array,
    plant: PlantNetwork,
    reference: ReferenceModel,
    held: list[Loops],
    options: Training,
) -> Trained:
    start, cv = theta, policy.signals.sp[0]
    pull = (options.decay * (cv.high - cv.low)) ** 2

    def sums(at: Array, which: int) -> LoopSums:
        of_loops = follow(policy, at, plant, reference, held[which], options.move_weight, derivatives=which == 0)
        if which:
            return of_loops
        # Weights stay near those of a slow controller where the loops do not ask for others.
        count, moved = held[which].sp.size, at - start
        return of_loops._replace(
            cost=of_loops.cost + pull * float(moved @ moved),
            square=of_loops.square + count * pull * np.eye(policy.size),
            slope=of_loops.slope - count * pull * moved,
        )

    now, judged = sums(theta, 0), sums(theta, 1)
    rows = [(now.tracking, judged.tracking)]
    best, least, kept, damping = 0, _finite(judged.cost), theta, 1e-2
    for i in range(1, options.iterations + 1):
        for _ in range(DAMPING_TRIES):
            diagonal = np.diag(now.square)
            step = np.linalg.solve(now.square + damping * np.diag(diagonal + 1e-9 * diagonal.mean()), now.slope)
            tried = sums(theta + step, 0)
            if tried.cost < now.cost:
                break
            damping *= 4
        else:
            break
        theta, now, damping = theta + step, tried, max(damping / 3, 1e-9)
        judged = sums(theta, 1)
        rows.append((now.tracking, judged.tracking))
        if _finite(judged.cost) < (1 - 1e-3) * least:
            best, least, kept = i, judged.cost, theta
        elif i - best >= options.patience:
            break
    return Trained(kept, np.sqrt(rows), best)


def _finite(cost: float) -> float:
    return cost if np.isfinite(cost) else np.inf


def gain_sign(model: StateSpace, signals: Signals) -> float:
    """Sign of dy(k+1)/du(k) in the middle of all ranges: +1 or -1."""
    middle = torch.tensor([[(s.low + s.high) / 2 for s in (*signals.pv, *signals.mv)]], dtype=torch.float64)
    slope = float(input_jacobian(model.net, middle)[0, 0, model.n_pv])
    return 1.0 if slope > 0 else -1.0


def training_analysis(trained: Trained, signals: Signals) -> Analysis:
    """How a training went, for people and pictures."""
    training, validation = trained.history[trained.best]
    unit = signals.sp[0].unit
    figures = {"training_rms": training, "validation_rms": validation, "iterations": float(len(trained.history) - 1)}
    note = (
        f"The law is trained through the plant's network: {len(trained.history) - 1} iterations, the best is number "
        f"{trained.best}. The RMS distance from the reference model is {training:.3g} {unit} on the training loops "
        f"and {validation:.3g} {unit} on the validation loops. Both have noise and loads."
    )
    return Analysis(figures, {"history": trained.history, "best": np.array([float(trained.best)])}, (note,))
