"""A plan over a horizon: Gauss-Newton passes, each with a quadratic problem within bounds, at fixed cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import hardtanh

from loopwright.pipeline.laws.base import hold_numbers
from loopwright.pipeline.laws.predictive.bounded_minimum import BoundedMinimum
from loopwright.pipeline.laws.predictive.horizon import LinearHorizon, Moves, NetworkHorizon, Prediction, product
from loopwright.pipeline.laws.predictive.soft_limits import EPS, SOFT, LimitCost, SoftLimits, limit_cost
from loopwright.pipeline.models.memory import Named

# The moves' cost grows by it where ranges are at odds with other outputs, for each sample of the horizon and unit of
# their force. A plan gains by moves for as long as two outputs pull against each other, and would go up and down by the
# largest move for ever: a tank of three valves does so without it, and with 8 moves a plan still with .3. With .4 it
# rests, with speeds of .5, 1 and 2, 5 and 8 moves, and twice the horizon; so does an exchanger of two ranges at odds.
CALM = 0.4
# The force, in units of an error's weight, from which on outputs count as at odds. Costs move set points with less:
# before ``MOST_ODDS`` a reactor whose feed is pushed had 12 % more error with 0, and 4 % with .5; with both 2.4 %.
ODDS_FROM = 0.5
# The largest force that counts, in the same units: a set point's own. Two ranges pull up to 3,000 times as hard. Else
# the tank's narrowed ranges were left for 4 % of the time in the end by two variables, with it for 0 and 2 %.
MOST_ODDS = 1.0


class OperatedPlan(NamedTuple):
    """Wishes of the operators for a plan, scaled: of outputs (..., 1, N n_o), of a plan's moves (..., 1, m)."""

    track: Tensor  # of a set point over its designed weight; 0 where none is followed
    low: Tensor  # of the outputs' ranges
    high: Tensor
    low_inside: Tensor  # where the price of leaving it begins
    high_inside: Tensor
    price: Tensor  # of what lies beyond a range; 0 out of use
    blurred: Tensor  # by what the price grows more slowly, where noise would throw an output in and out of its range
    y_cost: Tensor  # slope of the cost over the outputs
    stands: Tensor  # where the MV goes on from, at every move
    off: Tensor  # by how much the actuator stands off its command, at every move: it stays so
    z_low: Tensor  # of the moves
    z_high: Tensor
    reach: Tensor  # largest difference from the applied MV: as far as the rate brings it until then; 0 out of use
    rest: Tensor  # of the moves
    rest_weight: Tensor  # curvature of the cost of being away from it
    z_cost: Tensor  # slope of the cost over the moves
    stiffness: Tensor  # (..., 1, 1) of the moves' cost over the designed one
    mv_low: Tensor  # (..., 1, n_mv) [mv]
    mv_high: Tensor  # (..., 1, n_mv) [mv]
    mv_move: Tensor  # (..., 1, n_mv) [mv] a period; 0 of an MV out of use


class PlanProblem(NamedTuple):
    """A step's problem, scaled, as the planner takes it, and all that its answer needs beside the plan."""

    start: Tensor  # (..., 1, n_x + n_d + n_dv) [x, d, dv]
    wanted: Tensor  # (..., 1, N n_o) set points
    applied: Tensor  # (..., 1, n_mv) where the MVs go on from
    plan: Tensor  # (..., 1, m) to begin at
    operated: OperatedPlan | None
    forecast: Tensor | None  # of the horizon where measured disturbances change
    mean: Tensor  # (..., 1, n_x + n_d) [x, d]
    now: Named  # the inputs
    kept: Named  # the state
    fresh: Tensor | None  # (..., 1, n_y)
    boost: Tensor  # (..., 1, n_y)
    next_kept: Named  # what goes to the next state, in its order, the plan and the MVs apart
    stands: Tensor  # (..., n_mv) [mv] as ``applied``
    mv_applied: Tensor  # (..., n_mv) [mv]

    @property
    def given(self) -> tuple[Tensor, Tensor, Tensor, Tensor, OperatedPlan | None, Tensor | None]:
        """The planner's arguments."""
        return self.start, self.wanted, self.applied, self.plan, self.operated, self.forecast


class LastPass(NamedTuple):
    """The quadratic problem of the last pass, and the plan that it made of the one ``before``; scaled."""

    plan: Tensor  # (..., 1, m)
    before: Tensor  # (..., 1, m)
    run: Prediction  # under ``before``
    wanted: Tensor  # (..., 1, N n_o) set points within the outputs' ranges
    weight: Tensor  # (..., 1, N n_o) of the errors
    push: LimitCost  # of the ranges
    stiff: Tensor  # (..., m, m) curvature of the costs of moves and of being away from rests
    low: Tensor  # (..., 1, m) least value of each move
    high: Tensor


@dataclass(frozen=True, slots=True)
class Cost:
    """Numbers of the cost: ``weights`` q of the CVs, ``move`` mu of a squared change, ``eps``; and the ``damping``.

    All for outputs and MVs in scaled units.
    """

    weights: Sequence[float]
    move: float
    eps: float
    damping: float = 0.0


class Planner(nn.Module):
    """The plan z that is best over the horizon.

        min  sum_k sum_o q_o sqrt((y_o(k) - r_o(k))^2 + eps^2) + mu sum_j |z_j - z_{j-1}|^2,   |z| <= 1

    z_0 is the applied MV. Each pass takes the free run y and its slopes S at the present plan, the weights
    w = q/sqrt(e^2 + eps^2) of the errors e = y - r, and the plan that is best for the quadratic cost

        sum w (e + S dz)^2/2 + mu sum_j |z_j - z_{j-1}|^2 + kappa sum_p H_pp dz_p^2/2

    within its bounds, by ``sweeps`` rounds of coordinate descent, or, within operators' bounds, by ``bounded``; H_pp
    is the curvature of the other terms. A fixed point is a minimum of the cost itself, whatever the damping kappa.
    Without damping full steps over a strongly bent model can throw the plan from pass to pass, and the loop then
    amplifies rounding. An error counts by its size, not by its square: large ones do not decide alone. With ``rate``
    (n_mv,) each move differs from the one before by at most its length in samples times the rate; within operators'
    bounds each lies as near to the applied MV as the rate brings it until then. The cost of ``limits`` is added, by a
    quadratic of the same kind; no quadratic stands for a limit that the present plan keeps, so that it does not slow
    down the approach.

    Source: iteratively reweighted least squares, Huber, Robust Statistics, section 7.8; coordinate descent, Wright,
    Mathematical Programming 151 (2015) 3.
    """

    rate: Tensor | None  # (1, m) largest difference from the move before
    weights: Tensor  # (1, N n_cv)
    moved: Tensor  # (m, m) curvature of the moves' cost
    applied: Tensor  # (n_mv, m) slope of the moves' cost over the applied MV
    first: Tensor  # (n_mv, m)
    before: Tensor  # (m, m)
    columns: Tensor  # (m, m, m) ones in column p of matrix p
    eye: Tensor  # (m, m)
    stiff: Tensor  # (m, m) ones, and 1 + kappa on the diagonal
    damping: Tensor  # (1,) kappa
    calm: Tensor  # (1,) growth of the moves' cost where outputs are at odds
    odds_from: Tensor  # (1,) least force of it
    most_odds: Tensor  # (1,) largest force of it
    soft: Tensor  # (1,) of the price of a range
    blunt: Tensor  # (1,) of the price of a range

    def __init__(
        self,
        horizon: LinearHorizon | NetworkHorizon,
        moves: Moves,
        cost: Cost,
        passes: int,
        sweeps: int,
        rate: Tensor | None = None,
        limits: SoftLimits | None = None,
        bounded: BoundedMinimum | None = None,
        *,
        valleys: bool = False,
    ) -> None:
        super().__init__()
        self.valleys = valleys  # more MVs than set points: they may move together as no output shows
        self.bounded = bounded  # of a law with operators' bounds
        self.limits = limits
        self.horizon, self.passes, self.sweeps, self.m = horizon, passes, sweeps, moves.count
        self.n_cv = len(cost.weights)
        first, eye = torch.from_numpy(moves.first), torch.eye(moves.count, dtype=torch.float64)
        buffers = {
            "rate": None if rate is None else rate.repeat(len(moves.starts)) * torch.from_numpy(moves.lengths),
            "moved": 2 * cost.move * torch.from_numpy(moves.curvature),
            "applied": 2 * cost.move * first,
            "first": first,
            "before": torch.from_numpy(moves.before),
            "columns": eye.unsqueeze(-2).repeat(1, self.m, 1),
            "eye": eye,
            "stiff": 1.0 + cost.damping * eye,
        }
        for name, values in buffers.items():
            self.register_buffer(name, values)
        hold_numbers(self, weights=[list(cost.weights) * moves.horizon], eps_squared=cost.eps**2, damping=cost.damping)
        calm = CALM * moves.horizon / cost.move
        hold_numbers(self, calm=calm, odds_from=ODDS_FROM, most_odds=MOST_ODDS, soft=SOFT, blunt=EPS)

    def forward(
        self,
        start: Tensor,
        wanted: Tensor,
        applied: Tensor,
        plan: Tensor,
        operated: OperatedPlan | None = None,
        forecast: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The plan (..., 1, m), and the outputs (..., 1, n_cv) that it gives at the next sample.

        From ``start`` (..., 1, n_x + n_y + n_dv), with the set points ``wanted`` (..., 1, N n_cv) over the horizon,
        the ``applied`` MV (..., 1, n_mv) within -1..1, beginning at ``plan``; all scaled. With ``operated`` as
        operators have it, see ``_operated``. ``forecast`` is the horizon's offset where measured disturbances change.
        """
        if operated is not None:
            last = self.last_pass(start, wanted, applied, plan, operated, forecast)
            return last.plan, self.ahead(last)
        n_cv = self.n_cv
        held, at = applied @ self.applied, applied @ self.first
        for _ in range(self.passes):
            run = self.horizon(start, plan, forecast)
            error = run.y - wanted
            weight = self.weights / torch.sqrt(error * error + self.eps_squared)
            push = None if self.limits is None else self.limits(run.y)
            both = weight if push is None else weight + push.weight
            curvature = product(run.slopes * both, run.slopes_t, self.moved)
            moved = plan @ run.slopes
            back = weight * (moved - error) if push is None else both * moved - weight * error - push.slope
            pull = product(back, run.slopes_t, held)
            before = plan
            diagonal = (curvature * self.eye).sum(dim=-2, keepdim=True)
            plan = self.descended(curvature * self.stiff, pull + self.damping * diagonal * plan, plan, at)
        ahead = run.y[..., :n_cv] + (plan - before) @ run.slopes[..., :n_cv]
        return plan, ahead

    def ahead(self, last: LastPass) -> Tensor:
        """The outputs (..., 1, n_o) at the next sample."""
        return last.run.y[..., : self.n_cv] + (last.plan - last.before) @ last.run.slopes[..., : self.n_cv]

    def last_pass(
        self,
        start: Tensor,
        wanted: Tensor,
        applied: Tensor,
        plan: Tensor,
        by: OperatedPlan,
        forecast: Tensor | None = None,
    ) -> LastPass:
        """The plan that is best with ranges, priorities, resting values and costs, within the operators' bounds.

            sum_k sum_o  t_o q_o sqrt((y_o - r_o)^2 + eps^2) + p_o(b_o) + c_o y_o
            + (mu s + sigma N f) sum_j |z_j - z_{j-1}|^2 + sum_j w_j (z_j - rest)^2/2 + c_j z_j

        t is the weight of a set point over the designed one, 0 where none is followed, b_o what lies beyond the range
        of output o, p_o the cost of ``SoftLimits`` with its price by rank, s the stiffness, N the samples of the
        horizon, and sigma ``CALM``; delta and eps of a price are larger by ``blurred``. A set point outside its
        range counts as the end of it. f is the force by which ranges are at odds with other outputs at the end of the
        horizon, at the present plan: the lesser of all forces of ranges, and of all of ranges and set points without
        the largest, each less ``ODDS_FROM``; ``MOST_ODDS`` at most. It is 0 where a plan brings all outputs, or all but
        one, where they should be. Where it does not they pull for ever, so that moves must cost as much more.
        """
        away, going_on = by.rest_weight * self.eye, applied @ self.applied
        wanted, weights = torch.minimum(torch.maximum(wanted, by.low), by.high), self.weights * by.track
        # What the operators allow, as far as the MV gets until then; of an MV out of use where it stands.
        low, high = (
            torch.minimum(torch.maximum(end, by.stands - by.reach), by.stands + by.reach)
            for end in (by.z_low, by.z_high)
        )
        assert self.bounded is not None  # of a law with `operate`
        soft, blunt = self.soft + by.blurred, self.blunt + by.blurred
        for i in range(self.passes):
            run = self.horizon(start, plan + by.off, forecast)
            error = run.y - wanted
            weight = weights / torch.sqrt(error * error + self.eps_squared)
            push = limit_cost(run.y, by.low_inside, by.high_inside, by.price, soft, blunt * blunt)
            both = weight + push.weight
            back = both * (plan @ run.slopes) - weight * error - push.slope - by.y_cost
            ranges = torch.clamp(push.slope[..., -self.n_cv :].abs() - self.odds_from, min=0.0)
            force = ranges + torch.clamp((weight * error)[..., -self.n_cv :].abs() - self.odds_from, min=0.0)
            others = force.sum(dim=-1, keepdim=True) - force.amax(dim=-1, keepdim=True)
            at_odds = torch.clamp(torch.minimum(others, ranges.sum(dim=-1, keepdim=True)), max=self.most_odds)
            stiffness = by.stiffness + self.calm * at_odds
            stiff = stiffness * self.moved + away
            held = stiffness * going_on + by.rest_weight * by.rest - by.z_cost
            pull = product(back, run.slopes_t, held)
            before = plan
            curvature, pull = self._damped(run.slopes * both, run.slopes_t, stiff, pull, plan)
            plan = self.bounded(curvature, pull, plan, low, high, swept=i == 0)
        return LastPass(plan, before, run, wanted, weight, push, stiff, low, high)

    def _damped(
        self, weighed: Tensor, slopes_t: Tensor, stiff: Tensor, pull: Tensor, plan: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Curvature (..., m, m) and pull of a pass; a step away from ``plan`` costs kappa of the outputs' curvature.

        With as many MVs as set points it is its diagonal, as without ``operate``. With more, all of it: MVs may move
        together freely as far as no output shows it.
        """
        if not self.valleys:
            curvature = product(weighed, slopes_t, stiff)
            diagonal = (curvature * self.eye).sum(dim=-2, keepdim=True)
            return curvature * self.stiff, pull + self.damping * diagonal * plan
        seen = self.damping * (weighed @ slopes_t)
        return product(weighed, slopes_t, stiff) + seen, pull + plan @ seen

    def descended(self, curvature: Tensor, pull: Tensor, plan: Tensor, at: Tensor) -> Tensor:
        """The minimum of z'Hz/2 - pull z within -1..1, from ``plan``: H (..., m, m), the others (..., 1, m).

        Coordinate p is z_p = (pull_p - sum_{q != p} H_pq z_q)/H_pp, cut to its bounds. Written for the whole row
        that is z G_p + c_p, where only column p of G_p is not the identity's. With a rate each differs from the one
        before by at most that; the first from the applied MV, ``at`` (..., 1, m).
        """
        m = self.m
        diagonal = (curvature * self.eye).sum(dim=-2, keepdim=True)
        g = self.eye - (curvature / diagonal).unsqueeze(-3) * self.columns
        c = self.eye * (pull / diagonal)
        into = torch.split(g.reshape(*g.shape[:-3], m * m, m), m, dim=-2)
        add = torch.split(c, 1, dim=-2)
        for _ in range(self.sweeps):
            if self.rate is None:
                for p in range(m):
                    plan = hardtanh(product(plan, into[p], add[p]))
                continue
            middle = product(plan, self.before, at)
            low, high = (torch.clamp(middle + by, -1.0, 1.0) for by in (-self.rate, self.rate))
            for p in range(m):
                plan = torch.minimum(torch.maximum(product(plan, into[p], add[p]), low), high)
        return plan
