"""The minimum of a plan's quadratic problem within bounds, by a fixed number of changes of what lies at a bound."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from loopwright.pipeline.laws.base import hold_numbers
from loopwright.pipeline.laws.predictive.horizon import product

NEVER = 1e200  # over a pivot: an entry at a bound is not solved for
# The price of a step away from the present plan, of the curvature. With .001 a law with default ranges moves as one
# without `operate` whose sweeps come to their end, within .04 of half a range (24 random models); with .05 within .2.
# The evaporator of the benchmark of plants under ranges and costs earns 713 an hour with .001, 708 with .01 and 694
# with .05. With 1e-6 a file and its law part by 1e-8 where MVs do nearly the same.
PLAN_RIDGE = 0.001
AT_BOUND = 1e-9  # of half an entry's range: nearer to its end it lies there
LEAST_FORCE = 1e-12  # scaled: a force beyond a bound, or off it, that is smaller is rounding
TIE_BREAK = 1e-6  # of that force, an entry: of two that are the same, one is exchanged


class BoundedMinimum(nn.Module):
    """The minimum of z'Hz/2 - pull z within low..high, from a plan that is near it.

    Scaled to a diagonal of ones, x = (z - middle) sqrt(diag H), a free entry has its best beside the others where

        x_p = b_p + sum_q x_q N_qp,   N = (1 - rho) 1 - H',   b = pull' + rho x_0

    rho is the ``ridge``: a step away from the present plan x_0 costs that much of the curvature, so that plans which
    cost the same are not exchanged from sample to sample, and what rounding does stays small. Solving for p is one
    exchange of the tableau, N += N_p' N_p/(1 - N_pp), and -1 in place of 1 takes it back. All free entries are solved
    for, and then as many times as ``changes`` the entry is exchanged on which the force of its bound is farthest from
    the right side: a free one whose best lies beyond a bound, which it then keeps, or one at a bound whose best is
    inside. From sample to sample that set hardly differs, so that few changes reach the minimum. After a jump of a set
    point it does: with ``swept`` each entry first goes to its best within its bounds, from the last to the first.
    Whatever the changes miss, the plan lies within its bounds; it may then cost more than the one before. No branch,
    fixed cost.

    Source: principal pivoting of linear complementarity problems, Cottle, Pang and Stone, The Linear Complementarity
    Problem, chapter 4.
    """

    eye: Tensor  # (m, m)
    whole: Tensor  # (m, m) the identity less the ridge
    others: Tensor  # (m, m) 1/(1 + rho), and 0 on the diagonal
    columns: Tensor  # (m, m, m) ones in column p of matrix p
    apart: Tensor  # (1, m) just above 1, each its own
    ridge: Tensor  # (1,)
    share: Tensor  # (1,) 1/(1 + rho)
    never: Tensor  # (1,)
    one: Tensor  # (1,)
    zero: Tensor  # (1,)
    near: Tensor  # (1,) to a bound

    def __init__(self, m: int, changes: int, ridge: float = PLAN_RIDGE) -> None:
        super().__init__()
        self.m, self.changes = m, changes
        eye = torch.eye(m, dtype=torch.float64)
        self.register_buffer("eye", eye)
        self.register_buffer("whole", (1.0 - ridge) * eye)
        self.register_buffer("others", (1.0 - eye) / (1.0 + ridge))
        self.register_buffer("columns", eye.unsqueeze(-2).repeat(1, m, 1))
        self.register_buffer("apart", 1.0 + TIE_BREAK * torch.arange(m, dtype=torch.float64).unsqueeze(0))
        hold_numbers(self, ridge=ridge, share=1.0 / (1.0 + ridge), never=NEVER, one=1.0, zero=0.0, near=AT_BOUND)

    def forward(
        self, curvature: Tensor, pull: Tensor, plan: Tensor, low: Tensor, high: Tensor, *, swept: bool
    ) -> Tensor:
        """The plan (..., 1, m); H (..., m, m), pull, plan and bounds (..., 1, m)."""
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        scale = torch.sqrt((curvature * self.eye).sum(dim=-2, keepdim=True))
        column = (scale * self.eye).sum(dim=-1, keepdim=True)
        room = half * scale
        x = self._cut((plan - middle) * scale, room)
        table = self.whole - curvature / (column * scale)
        b = (pull - middle @ curvature) / scale + self.ridge * x
        if swept:
            x = self._swept(table, b, x, room)
        free = room - x.abs() > self.near * room
        side = torch.where(free, -self.one, self.one)
        pivots = torch.split(torch.where(free, self.one, self.never), 1, dim=-1)
        for p in range(self.m):
            row = table[..., p : p + 1, :]
            over = row / (pivots[p] - row[..., p : p + 1])
            table = product(row.transpose(-1, -2), over, table)
        own = (table * self.eye).sum(dim=-2, keepdim=True)
        for _ in range(self.changes):
            best, x = self._best(table, b, x, side, room)
            pivot = side - own
            gain = torch.sign(x) * (x - best) / pivot * self.apart
            most = torch.clamp(gain.amax(dim=-1, keepdim=True), min=LEAST_FORCE)
            change = torch.where(gain >= most, self.one, self.zero)
            row = change @ table
            over = row * (change / pivot).sum(dim=-1, keepdim=True)
            table = product(row.transpose(-1, -2), over, table)
            own = own + row * over
            side = side - 2.0 * change * side
        _, x = self._best(table, b, x, side, room)
        return middle + x / scale

    def _swept(self, table: Tensor, b: Tensor, x: Tensor, room: Tensor) -> Tensor:
        """Each entry (..., 1, m) at its best beside the others, the last one first.

        Written for the whole row that is x G_p + c_p, where only column p of G_p is not the identity's.
        """
        m = self.m
        g = self.eye - (self.eye - self.others * table).unsqueeze(-3) * self.columns
        into = torch.split(g.reshape(*g.shape[:-3], m * m, m), m, dim=-2)
        add = torch.split(self.eye * (self.share * b), 1, dim=-2)
        for p in reversed(range(m)):
            x = self._cut(product(x, into[p], add[p]), room)
        return x

    def _best(self, table: Tensor, b: Tensor, x: Tensor, side: Tensor, room: Tensor) -> tuple[Tensor, Tensor]:
        """The best of each entry beside those at a bound, and the plan that takes it for the free ones."""
        free = side < 0
        best = product(torch.where(free, b, x), table, b)
        return best, torch.where(free, self._cut(best, room), x)

    @staticmethod
    def _cut(x: Tensor, room: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(x, -room), room)
