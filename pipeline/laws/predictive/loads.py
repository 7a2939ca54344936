"""Where unmeasured loads enter an identified model: at its outputs' rows, or at its MVs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from pipeline.models.identified.identified import Identified

Where: TypeAlias = Literal["mvs", "outputs"]
GROWTH = 1 / 3  # scaled, a sample: largest growth of the outputs under a unit load at an MV
LARGEST = 20.0  # scaled MV a scaled load: an MV that hardly moves anything has no larger load
SHOWN = 0.05  # share of the effect after a horizon from which on a load is seen
LATER = (0, 2)  # samples after that at which a filter of innovations is sure of it
SETTLE = 300  # samples to come to rest
AWAY = 8.0  # scaled: a state this far off has run away


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
    """Loads at ``where``; at the outputs too where the MVs are not as many as the outputs, which then have offsets."""
    n_y, n_mv, n_x = model.n_y, model.n_mv, model.n_x
    rows = torch.eye(n_x, n_y, dtype=torch.float64)
    if where == "outputs" or n_mv != n_y:
        no_v, own = torch.zeros(model.n_v, n_y, dtype=torch.float64), torch.eye(n_y, dtype=torch.float64)
        return Loads(rows, no_v, own, torch.zeros(1, n_x, n_y, dtype=torch.float64))
    a, b = slopes_at_rest(model)
    by_mv = answers(a, b[:, :n_mv], horizon)  # (N, n_x, n_mv)
    y = by_mv[:, :n_y]
    size, growth = y.norm(dim=1), torch.diff(y, dim=0, prepend=0 * y[:1]).norm(dim=1)  # (N, n_mv)
    scale = GROWTH / torch.clamp(growth.amax(dim=0), min=GROWTH / LARGEST)
    into_v = torch.zeros(model.n_v, n_mv, dtype=torch.float64)
    into_v[:n_mv] = torch.diag(scale)
    shown = torch.where(size > SHOWN * size[-1], 1.0, 0.0).argmax(dim=0)  # (n_mv,)
    ages = torch.clamp(torch.stack([shown + later for later in LATER]), max=horizon - 1)  # (L, n_mv)
    begun = torch.stack([by_mv[ages[:, i], :, i] * scale[i] for i in range(n_mv)], dim=-1)
    share = y[-1].square() / torch.clamp(size[-1].square(), min=1e-12)
    return Loads(torch.zeros(n_x, n_mv, dtype=torch.float64), into_v, share, begun)


@torch.no_grad()
def slopes_at_rest(model: Identified) -> tuple[Tensor, Tensor]:
    """Slopes (n_x, n_x) and (n_x, n_v) of the model, scaled, at the rest under the record's mean inputs.

    Where that runs away, as a level does, at the rest with the record's mean outputs.
    """
    x = start = model.at_rest(model.y_center, model.v_center)
    for _ in range(SETTLE):
        x = model(torch.cat([x, model.v_center]))
    x = x if bool((x.abs() < AWAY).all()) else start
    bend = model.w2 * (1 - torch.tanh(model.w1[:, : model.n_x] @ x + model.b1) ** 2)
    return model.a + bend @ model.w1[:, : model.n_x], model.b + bend @ model.w1[:, model.n_x :]


def answers(a: Tensor, into: Tensor, n: int) -> Tensor:
    """States (n, n_x, k) 1 to n samples after a constant input of one into each column of ``into`` (n_x, k), from 0."""
    x, found = torch.zeros_like(into), []
    for _ in range(n):
        x = a @ x + into
        found.append(x)
    return torch.stack(found)
