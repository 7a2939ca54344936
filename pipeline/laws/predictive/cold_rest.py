"""The rest that a cold law begins at: the plant's state, and the loads that hold it where it was found.

A law without a past sees the outputs, the MVs and the measured disturbances of one sample. It takes the plant for at
rest there. A linear map gives that rest exactly where the model is linear. A network has other slopes at each rest, so
that its map is fitted to rests that were found beforehand.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from loopwright.pipeline.laws.predictive.disturbance_model import (
    REST_SAMPLES,
    RUNAWAY_STATE,
    Loads,
    load_entry,
    slopes_of,
)
from loopwright.pipeline.laws.predictive.horizon import product
from loopwright.pipeline.laws.predictive.observer import Observer
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.memory import Named

MEAN_REST_STEPS = 10  # steps to the rest at the record's means
LEAST_SHOWN = 1e-3  # scaled, a sample: of a load that moves the states by less a rest says nothing


@torch.no_grad()
def held_rest(model: Identified, loads: Loads) -> Tensor:
    """From [y, v, 1] to [x, d] (n_x + n_d, n_y + n_v + 1), scaled: where the plant rests, the loads that hold it there.

        x = f(x, v + V d) + X d,      x[:n_y] = y

    in the slopes of f where its mean outputs rest under the mean inputs. A model of a record whose loads wander need
    not rest there by itself, and its law would move the MVs at the first sample. A load that shows in no output is
    small.
    """
    n_y, n_x, n_v = model.n_y, model.n_x, model.n_v
    n_d, none = loads.count, torch.zeros(n_y, 1, dtype=torch.float64)
    z = best = torch.cat([model.at_rest(model.y_center, model.v_center), torch.zeros(n_d, dtype=torch.float64)])
    least = torch.inf
    for _ in range(MEAN_REST_STEPS):
        x, d = z[:n_x], z[n_x:]
        v = model.v_center + model.v_scale * (loads.into_v @ d)
        left = model(torch.cat([x, v])) + loads.into_x @ d - x
        if not float(left.norm()) < least:  # a model that bends much may have no such rest
            break
        least, best = float(left.norm()), z
        z = z + _resting(*slopes_of(model, x, loads.into_v @ d), loads, torch.cat([left[:, None], none]))[:, 0]
    x, d = best[:n_x], best[n_x:]
    a, b = slopes_of(model, x, loads.into_v @ d)
    given = torch.cat([torch.zeros(n_x, n_y).double(), b], dim=1)
    outputs = torch.cat([torch.eye(n_y, dtype=torch.float64), torch.zeros(n_y, n_v).double()], dim=1)
    slope = _resting(a, b, loads, torch.cat([given, outputs]))
    middle = torch.cat([x, d]) - slope[:, :n_y] @ x[:n_y]
    return torch.cat([slope, middle[:, None]], dim=1)


def _resting(a: Tensor, b: Tensor, loads: Loads, given: Tensor) -> Tensor:
    """Small changes of [x, d] (n_x + n_d, k) that balance what is ``given`` (n_x + n_y, k): to states, and of outputs.

    (I - A) x - (B V + X) d = given[:n_x],  x[:n_y] = given[n_x:], by least squares with a small price of the loads.
    """
    n_x, n_d, n_y = len(a), loads.count, len(given) - len(a)
    eye = torch.eye(n_x, dtype=torch.float64)
    states = torch.cat([eye - a, -load_entry(b, loads)], dim=1)
    outputs = torch.cat([eye[:n_y], torch.zeros(n_y, n_d).double()], dim=1)
    price = LEAST_SHOWN * torch.eye(n_x + n_d, dtype=torch.float64)[n_x:]
    wanted = torch.cat([given, torch.zeros(n_d, given.shape[1]).double()])
    return torch.linalg.pinv(torch.cat([states, outputs, price])) @ wanted


# ------------------------------------------------------------------------------------------- the rests of a network
SOUGHT_COLD_RESTS = 1500  # drawn, of which those that are found are fitted
REST_STEPS, LONGEST_STEP = 10, 1.0  # steps to each rest, and the farthest that one goes [scaled]
FOUND_REST = 1e-6  # scaled: what a sample changes at a rest that was found
FARTHEST_REST = (
    80.0  # scaled: hidden states and loads of a rest; one that is farther off would weigh more than all others
)
LOADED_REST = 1.0  # scaled: largest standard deviation of what loads have moved the outputs by; each rest draws its own
BENDS = 150  # tanh features of the map: twice as many halve its error at most, and a step takes them all
REST_RIDGE = 1e-9  # share of the largest eigenvalue that keeps the fit solvable


class BentRest(NamedTuple):
    """A map from g = [y, v, 1] to [x, d], scaled:  z = L g + T tanh(W g)."""

    straight: Tensor  # (n_x + n_d, n_g) L
    bent: Tensor  # (n_x + n_d, BENDS) T
    into: Tensor  # (BENDS, n_g) W


@torch.no_grad()
def bent_rest(model: Identified, loads: Loads, held: Tensor, reach: Tensor, seed: int = 0) -> BentRest | None:
    """The map of a network's rests under loads, by least squares; None where too few are found.

    ``reach`` (n_mv, 2) are the ends of the MVs, scaled; ``held`` the map of a linear model, where each search begins.
    Inputs are drawn over their ranges, outputs about those that the inputs hold by themselves, as far off as loads of
    a record move them. Newton's method finds the states and loads of each:

        x = f(x, v + V d) + X d,      x[:n_y] = y

    The features are drawn and stay as they are (an extreme learning machine; Huang, Zhu and Siew, Neurocomputing 70
    (2006) 489), so that the fit is linear.
    """
    rng = torch.Generator().manual_seed(seed)
    n, n_y, n_x, n_mv = SOUGHT_COLD_RESTS, model.n_y, model.n_x, model.n_mv

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    low, high = reach.T
    mv = low + (high - low) * torch.rand(n, n_mv, generator=rng, dtype=torch.float64)
    v = torch.cat([mv, normal(n, model.n_dv)], dim=1)
    engineering = v * model.v_scale + model.v_center
    x = model.at_rest(model.y_center, model.v_center).expand(n, -1)
    for _ in range(REST_SAMPLES):
        x = torch.clamp(model(torch.cat([x, engineering], dim=1)), -RUNAWAY_STATE, RUNAWAY_STATE)
    y = x[:, :n_y] + LOADED_REST * torch.rand(n, 1, generator=rng, dtype=torch.float64) * normal(n, n_y)
    given = torch.cat([y, v, torch.ones(n, 1, dtype=torch.float64)], dim=1)
    begun = given @ held.T
    rests = (x[:, n_y:].abs() < RUNAWAY_STATE).all(dim=1, keepdim=True)
    z = torch.cat([y, torch.where(rests, x[:, n_y:], begun[:, n_y:n_x]), begun[:, n_x:]], dim=1)
    for _ in range(REST_STEPS):
        left, slope = _left(model, loads, z, v)
        step = torch.nan_to_num(torch.linalg.solve_ex(slope, left).result, 0.0, 0.0, 0.0)
        size = torch.clamp(step.abs().amax(dim=1, keepdim=True) / LONGEST_STEP, min=1.0)
        z = torch.cat([y, z[:, n_y:] + step / size], dim=1)
    left, _ = _left(model, loads, z, v)
    good = (left.abs().amax(dim=1) < FOUND_REST) & (z.abs().amax(dim=1) < FARTHEST_REST)
    into = normal(BENDS, given.shape[1])
    features = torch.cat([given, torch.tanh(given @ into.T)], dim=1)[good]
    if len(features) < 2 * features.shape[1]:
        return None
    gram = features.T @ features
    gram += REST_RIDGE * torch.linalg.eigvalsh(gram)[-1] * torch.eye(len(gram), dtype=torch.float64)
    table = torch.linalg.solve(gram, features.T @ z[good]).T
    straight, bent = table.split([given.shape[1], BENDS], dim=1)
    return BentRest(straight.contiguous(), bent.contiguous(), into)


def _left(model: Identified, loads: Loads, z: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Changes (n, n_x) in a sample at [x, d] (n, n_x + n_d), and how [x[n_y:], d] take it back (n, n_x, ...)."""
    x, d = z[:, : model.n_x], z[:, model.n_x :]
    acting = v + d @ loads.into_v.T
    ahead = model(torch.cat([x, model.v_center + model.v_scale * acting], dim=1)) + d @ loads.into_x.T
    a, b = slopes_of(model, x, acting)
    eye = torch.eye(model.n_x, dtype=torch.float64)
    return ahead - x, torch.cat([(eye - a)[..., model.n_y :], -load_entry(b, loads)], dim=-1)


def cold_start(now: Named, observer: Observer, largest: Tensor, bent: Tensor) -> Tensor:
    """[x, d] (..., 1, n_a) of a law without a past: of the rests on offer the one that moves least by itself.

    A rest under the loads that the slopes in the middle of the record give, one without loads, and of a network
    the one of ``bent_rest``: a network that bends much has other slopes elsewhere, and where it hardly rests the
    others serve. ``now`` has them as ``held``, ``free``, ``straight`` and ``bends``; ``bent`` (BENDS, n_a) is empty
    where the last is not there. Loads are at most ``largest`` (n_d,), such that MVs can balance them.
    """
    offered = [_within(now["held"], observer.n_x, largest)]
    if not observer.nonlinear:
        return offered[0]
    offered.append(now["free"])
    if len(bent):
        found = product(torch.tanh(now["bends"]), bent, now["straight"])
        rest = torch.cat([now["y"], found[..., observer.n_y :]], dim=-1)
        offered.append(_within(rest, observer.n_x, largest))
    best, least = offered[0], _moves_by(observer, offered[0], now["v"])
    for other in offered[1:]:
        moves = _moves_by(observer, other, now["v"])
        best, least = torch.where(moves < least, other, best), torch.minimum(moves, least)
    return best


def _within(start: Tensor, n_x: int, largest: Tensor) -> Tensor:
    """[x, d] with loads that MVs can balance."""
    loads = torch.minimum(torch.maximum(start[..., n_x:], -largest), largest)
    return torch.cat([start[..., :n_x], loads], dim=-1)


def _moves_by(observer: Observer, start: Tensor, v: Tensor) -> Tensor:
    """Sum of squares (..., 1, 1) by which the states of [x, d] change in a sample under v."""
    moved = (observer.ahead(start, v) - start)[..., : observer.n_x]
    return (moved * moved).sum(-1, keepdim=True)
