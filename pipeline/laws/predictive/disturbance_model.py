"""Where unmeasured loads enter an identified model, at its outputs' rows or at its MVs, and how the record's moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from loopwright.pipeline.models.identified.identified import Identified

Where: TypeAlias = Literal["mvs", "outputs", "record"]
LOAD_GROWTH = 1 / 3  # scaled, a sample: largest growth of the outputs under a unit load at an MV
LARGEST_LOAD = 20.0  # scaled MV a scaled load: an MV that hardly moves anything has no larger load
LOAD_SHOWN = 0.05  # share of the effect after a horizon from which on a load is seen
LOAD_SURE_LATER = (0, 2)  # samples after that at which a filter of innovations is sure of it
REST_SAMPLES = 300  # samples to come to rest
RUNAWAY_STATE = 8.0  # scaled: a state this far off has run away


@dataclass(frozen=True, slots=True, eq=False)
class Loads:
    """Loads d (..., n_d) in x+ = f(x, v + V d) + X d, scaled.

    At the outputs, X d is added to the rows of the outputs. At the MVs, V d is added to the MVs: the model then knows
    how such a load goes on, with all its lags and dead times. A unit of it makes the outputs grow by at most a third a
    sample. ``share`` is the part of a load's effect, squared, that each output shows.

    When the outputs show a load, it has acted for a while: ``begun`` is what a step of one has made of the states by
    then, at L ages of it. A filter that takes the load for new would have to wait as long again for its effect.
    """

    into_x: Tensor  # (n_x, n_d) X
    into_v: Tensor  # (n_v, n_d) V
    share: Tensor  # (n_y, n_d), columns sum to 1
    begun: Tensor  # (L, n_x, n_d)

    @property
    def at_mvs(self) -> bool:
        """Whether they are added to the MVs."""
        return bool((self.into_v != 0).any())

    @property
    def count(self) -> int:
        """Number of loads."""
        return self.into_x.shape[1]


def loads_of(model: Identified, where: Where, horizon: int) -> Loads:
    """Loads at ``where``; at the outputs too where the MVs are not as many as the outputs, which then have offsets.

    Those of the record are at the outputs, as in the model's own fit.
    """
    n_y, n_mv, n_x = model.n_y, model.n_mv, model.n_x
    rows = torch.eye(n_x, n_y, dtype=torch.float64)
    if where != "mvs" or n_mv != n_y:
        no_v, own = torch.zeros(model.n_v, n_y, dtype=torch.float64), torch.eye(n_y, dtype=torch.float64)
        return Loads(rows, no_v, own, torch.zeros(1, n_x, n_y, dtype=torch.float64))
    a, b = slopes_at_rest(model)
    by_mv = answers(a, b[:, :n_mv], horizon)  # (N, n_x, n_mv)
    y = by_mv[:, :n_y]
    size, growth = y.norm(dim=1), torch.diff(y, dim=0, prepend=0 * y[:1]).norm(dim=1)  # (N, n_mv)
    scale = LOAD_GROWTH / torch.clamp(growth.amax(dim=0), min=LOAD_GROWTH / LARGEST_LOAD)
    into_v = torch.zeros(model.n_v, n_mv, dtype=torch.float64)
    into_v[:n_mv] = torch.diag(scale)
    shown = torch.where(size > LOAD_SHOWN * size[-1], 1.0, 0.0).argmax(dim=0)  # (n_mv,)
    ages = torch.clamp(torch.stack([shown + later for later in LOAD_SURE_LATER]), max=horizon - 1)  # (L, n_mv)
    begun = torch.stack([by_mv[ages[:, i], :, i] * scale[i] for i in range(n_mv)], dim=-1)
    share = y[-1].square() / torch.clamp(size[-1].square(), min=1e-12)
    return Loads(torch.zeros(n_x, n_mv, dtype=torch.float64), into_v, share, begun)


@torch.no_grad()
def recorded_changes(model: Identified) -> Tensor:
    """Variance (n_y,) of the loads' changes a period over the record, scaled: (1/n) sum_k (d(k+1) - d(k))^2.

    The filter of the model's fit foresees its loads d; the estimate of a random walk changes by as much, on average, as
    the walk does. Covariances are left out: errors of the model move several loads at once, too, and a filter that
    takes these for one load erred more on the evaporator of the benchmark of plants under ranges and costs (2.2 for
    1.6 % on day 901, which is not scored), a little more on the furnace and the column, and as much on two others.
    """
    return model.load_moves.square().sum(dim=0) / max(model.recorded, 1)


@torch.no_grad()
def balanced(model: Identified, loads: Loads, span: Tensor, horizon: int) -> Tensor:
    """The largest loads (n_d,) that MVs of ``span`` (n_mv,), scaled, can balance; under larger ones nothing rests.

    The largest load moves an output over the horizon as far as the MVs' whole ranges can.
    """
    a, b = slopes_at_rest(model)
    by_mv, by_load = (answers(a, into, horizon)[-1, : model.n_y] for into in (b[:, : model.n_mv], load_entry(b, loads)))
    most = by_load.abs().argmax(dim=0, keepdim=True)  # (1, n_d)
    reach = (by_mv.abs() @ span)[:, None].expand(-1, loads.count)
    return (reach.gather(0, most) / torch.clamp(by_load.abs().gather(0, most), min=1e-12))[0]


def load_entry(b: Tensor, loads: Loads) -> Tensor:
    """How the states (..., n_x, n_d) move under a unit of each load, by the inputs' slopes b (..., n_x, n_v)."""
    return b @ loads.into_v + loads.into_x


def slopes_of(model: Identified, x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes (..., n_x, n_x) and (..., n_x, n_v) of the model at x (..., n_x) and v (..., n_v), scaled."""
    bend = model.w2 * (1 - torch.tanh(torch.cat([x, v], dim=-1) @ model.w1.T + model.b1) ** 2)[..., None, :]
    return model.a + bend @ model.w1[:, : model.n_x], model.b + bend @ model.w1[:, model.n_x :]


@torch.no_grad()
def slopes_at_rest(model: Identified) -> tuple[Tensor, Tensor]:
    """Slopes (n_x, n_x) and (n_x, n_v) of the model, scaled, at the rest under the record's mean inputs.

    Where that runs away, as a level does, at the rest with the record's mean outputs.
    """
    x = start = model.at_rest(model.y_center, model.v_center)
    for _ in range(REST_SAMPLES):
        x = model(torch.cat([x, model.v_center]))
    x = x if bool((x.abs() < RUNAWAY_STATE).all()) else start
    return slopes_of(model, x, torch.zeros(model.n_v, dtype=torch.float64))


def answers(a: Tensor, into: Tensor, n: int) -> Tensor:
    """States (n, n_x, k) 1 to n samples after a constant input of one into each column of ``into`` (n_x, k), from 0."""
    x, found = torch.zeros_like(into), []
    for _ in range(n):
        x = a @ x + into
        found.append(x)
    return torch.stack(found)
