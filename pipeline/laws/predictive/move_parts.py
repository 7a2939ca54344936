"""The next move of a predictive law in parts that sum to it, and the courses that it predicts and plans."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import hold_numbers
from loopwright.pipeline.laws.predictive.bounded_minimum import AT_BOUND
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.laws.predictive.qp_solver import LastPass, OperatedPlan, PlanProblem

TINY_EXCESS = 1e-12  # scaled: an output that is beyond its range by less owes it to nothing new


class Explained(NamedTuple):
    """Outputs of the explain graph, in this order; engineering units."""

    mv: Tensor  # (..., n_mv)
    state_next: Tensor  # (..., n_state)
    y: Tensor  # (..., N n_o) CVs over the horizon, sample by sample
    z: Tensor  # (..., J n_mv) MVs at the starts of the moves, move by move
    move: Tensor  # (..., n_mv)
    parts: Tensor  # (..., n_mv K) of each MV's move
    news: Tensor  # (..., n_dv + n_y) what the DVs changed by, and the readings are above the predicted ones


class ExplainedPredictive(nn.Module):
    """A step of a predictive law with ``operate``, and the parts of its moves.

    The last pass minimizes a quadratic cost over the move u = z - z_0 away from where the MVs stand. Let y be the free
    run with the MVs held, S its slopes, W = diag(w) the weights of the set points' errors, V those of the ranges where
    y leaves them by b, H = S (W + V) S' + M with the curvature M of moves and rests. Its minimum has

        H u = g + l,   g = - S W (y - r) - S V b + S f - S c_y - c_z - w_r (z_0 - rest)

    f are the forces at the new plan of ranges that the free run does not leave, and l those of the bounds, which are
    not 0 where a bound holds the plan. Every term of g is a sum of terms of one signal each. For MV j let F be the
    entries of the plan that no bound holds, and all of its own, and A the others. Then

        H_FF u_F = g_F + l_F - H_FA u_A

    and the part of a term in the move of MV j is that term's share in the first entry of it: of l_F what its own limits
    take, of H_FA u_A what it does because other MVs are at theirs. A step away from the last plan has its
    price: what is left is the part ``plan``, as far as the last plan had a move, and beyond that it is spread over the
    causes by their size. So the parts sum to the move.

    The free run is the one that was predicted at the last step, y_0, and what is new since: of each measured
    disturbance its change, of each reading the correction P h (y_m - y_p)/R of state and loads that it makes in the
    Kalman filter. A set point's own part is that of y_0 - r. A range's force goes to what is new as far as that has
    brought the free run beyond the range: its own part is what y_0 is beyond it already. These splits are exact for a
    linear model; in a network the changes are made one after another.
    """

    of_output: Tensor  # (n_o, N n_o) ones at the output's samples
    of_mv: Tensor  # (n_mv, m) ones at the MV's moves
    first: Tensor  # (n_mv, m) ones at the first moves
    same: Tensor  # (n_mv, 4 n_mv, 1) ones where a bound is the MV's own
    unit: Tensor  # (m, m)
    y_centre: Tensor  # (N n_o,) [pv]
    y_scale: Tensor  # (N n_o,) [pv]
    dv_scale: Tensor  # (n_dv,) [dv]
    known_to: Tensor  # (n_dv, N n_dv) ones of the measured disturbances up to one, at all samples
    near: Tensor  # (1,) to a bound
    tiny: Tensor  # (1,)
    zero: Tensor  # (1,)
    one: Tensor  # (1,)

    def __init__(self, law: Predictive) -> None:
        super().__init__()
        if law.operation is None:
            raise LawError(f"law {law.name!r} without `operate` explains nothing; design it with `operate: {{}}`")
        self.law, signals = law, law.signals
        self.name, self.n_state, self.operate, self.signals = law.name, law.n_state, law.operate, signals
        n_o, n_mv, horizon, m = law.planner.n_cv, len(signals.mv), law.moves.horizon, law.moves.count
        self.n_o, self.n_mv, self.n_y, self.n_dv = n_o, n_mv, law.observer.n_y, len(signals.dv)
        eye = torch.eye(m, dtype=torch.float64)
        self.register_buffer("of_output", torch.eye(n_o, dtype=torch.float64).repeat(1, horizon))
        self.register_buffer("of_mv", torch.eye(n_mv, dtype=torch.float64).repeat(1, m // n_mv))
        self.register_buffer("first", eye[:n_mv].contiguous())
        same = torch.eye(n_mv, dtype=torch.float64).repeat(1, 4).unsqueeze(-1)  # four kinds of bounds
        self.register_buffer("same", same)
        self.register_buffer("unit", eye)
        scales, at = law.operation.scales, list(law.inputs.sizes)
        self.register_buffer("y_centre", scales.y_center.repeat(horizon))
        self.register_buffer("y_scale", scales.y_scale.repeat(horizon))
        column = sum(law.inputs.sizes[name] for name in at[: at.index("v")]) + n_mv
        row = len(signals.sp) + len(signals.pv)
        slopes = law.inputs.matrix[row : row + self.n_dv, column : column + self.n_dv]
        self.register_buffer("dv_scale", 1 / slopes.diagonal())
        self.forecasts = law.known is not None and self.n_dv > 0
        self.register_buffer("known_to", torch.tril(torch.ones(self.n_dv, self.n_dv).double()).repeat(1, horizon))
        hold_numbers(self, near=AT_BOUND, tiny=TINY_EXCESS, zero=0.0, one=1.0)

    @property
    def parts(self) -> tuple[tuple[str, str], ...]:
        """Cause and signal of each part of a move, in the order of the output ``parts``."""
        signals = self.signals
        pv, dv, mv = ([s.name for s in of] for of in (signals.pv[: self.n_o], signals.dv, signals.mv))
        groups = (
            ("setpoint", pv), ("range_low", pv), ("range_high", pv), ("disturbance", dv),
            ("forecast", dv if self.forecasts else []), ("load", pv), ("cost", [*pv, *mv]), ("rest", mv),
            ("mv_low", mv), ("mv_high", mv), ("max_move", mv), ("not_in_use", mv), ("plan", [""]),
        )  # fmt: skip
        return tuple((cause, name) for cause, names in groups for name in names)

    def forward(
        self,
        sp: Tensor,
        pv: Tensor,
        dv: Tensor,
        mv_applied: Tensor,
        state: Tensor,
        operate: Tensor,
        fresh: Tensor,
        ahead: Tensor | None = None,
    ) -> Explained:
        """The explained step; shapes as of ``Predictive.forward``."""
        law = self.law
        problem = law.problem(sp, pv, dv, mv_applied, state, operate, fresh, ahead)
        by, forecast = problem.operated, problem.forecast
        assert by is not None  # a law with `operate`
        last = law.planner.last_pass(problem.start, problem.wanted, problem.applied, problem.plan, by, forecast)
        mv, state_next, _ = law.answer(problem, last.plan, law.planner.ahead(last))
        y = self.y_centre + self.y_scale * law.planner.horizon(problem.start, last.plan + by.off, forecast).y
        z = law.mv_middle + law.mv_half * last.plan.reshape(*last.plan.shape[:-2], -1, self.n_mv)
        runs, news = self._runs(problem, last, by, ahead)
        move = mv - problem.stands
        parts = self._parts(problem, last, by, self._pulls(last, by, runs))
        parts = self._finished(parts, problem, by, move).flatten(-2)
        return Explained(mv, state_next, y.squeeze(-2), z.flatten(-2), move, parts, news)

    def _runs(
        self, problem: PlanProblem, last: LastPass, by: OperatedPlan, ahead: Tensor | None
    ) -> tuple[list[Tensor], Tensor]:
        """The free runs (..., 1, N n_o) with the MVs held, and the news.

        The first run is the predicted one; then each has one measured disturbance more as it is now, then one more with
        its forecast, where the law reads them, and then the correction by one reading more; the last is that of the
        step.
        """
        observer, kept, n_a = self.law.observer, problem.kept, self.law.observer.n_a
        started = kept["started"]
        measured = problem.start[..., n_a:]
        acted = torch.cat([problem.now["v"][..., : self.n_mv], *(kept[n] for n in ("dv",) if n in kept)], dim=-1)
        predicted = torch.where(started > 0, observer.ahead(kept["mean"], acted), problem.mean)
        held = torch.where(started > 0, kept["level"] if "level" in kept else kept.get("dv", measured), measured)
        surprise = problem.now["y"] - predicted[..., : self.n_o]
        surprise = surprise if problem.fresh is None else surprise * problem.fresh
        flat = problem.next_kept["estimate"][..., n_a:].index_select(-1, self.law.whole)
        covariance = flat.reshape(*flat.shape[:-2], n_a, n_a)
        gains = covariance[..., : self.n_o, :] / observer.r[: self.n_o].unsqueeze(-1)  # (..., n_y, n_a)
        starts = [torch.cat([predicted, held], dim=-1)]
        for i in range(self.n_dv):
            now = torch.cat([held[..., :0], measured[..., : i + 1], held[..., i + 1 :]], dim=-1)
            starts.append(torch.cat([predicted, now], dim=-1))
        offsets = self._forecasts(ahead)
        starts += [starts[-1]] * len(offsets)
        for o in range(self.n_o - 1):
            predicted = predicted + surprise[..., o : o + 1] * gains[..., o : o + 1, :]
            starts.append(torch.cat([predicted, measured], dim=-1))
        every = torch.stack(starts)  # (runs, ..., 1, n_start)
        plan = (last.before + by.off).expand(*every.shape[:-1], -1)
        horizon, offset = self.law.planner.horizon, None
        if offsets:
            held_offset = horizon.run.offset.expand_as(offsets[0])
            offset = torch.stack([*[held_offset] * (1 + self.n_dv), *offsets, *[offsets[-1]] * (self.n_o - 1)])
        free = horizon(every, plan, offset).y
        found = [*(y.squeeze(0) for y in torch.split(free, 1)), last.run.y]
        moved = (by.stands - last.before) @ last.run.slopes
        news = torch.cat([self.dv_scale * (measured - held), self.y_scale[: self.n_o] * surprise], dim=-1)
        return [y + moved for y in found], news.squeeze(-2)

    def _forecasts(self, ahead: Tensor | None) -> list[Tensor]:
        """The horizon's offset with the forecast of one measured disturbance, of two, and so on; none without them."""
        if not self.forecasts or self.law.known is None or ahead is None:
            return []
        _, later = self.law.known(ahead)
        return [self.law.planner.horizon.forecast(later * self.known_to[i]) for i in range(self.n_dv)]

    def _pulls(self, last: LastPass, by: OperatedPlan, runs: list[Tensor]) -> tuple[Tensor, Tensor]:
        """The terms (..., K, m) of the minimum, one a part, and the curvature H (..., m, m)."""
        high = last.push.slope > 0
        beyond = [torch.clamp(torch.where(high, y - by.high_inside, by.low_inside - y), min=0.0) for y in runs]
        # Ranges that the free run leaves pull it back; others hold with the force that they have at the new plan.
        outside = beyond[-1] > 0
        bound = torch.where(high, by.high_inside, by.low_inside)
        ahead = (last.plan - last.before) @ last.run.slopes
        holding = last.push.slope + last.push.weight * ahead
        force = -torch.where(outside, last.push.weight * (runs[-1] - bound), holding)
        weight = last.weight + torch.where(outside, last.push.weight, self.zero)
        curvature = (last.run.slopes * weight) @ last.run.slopes_t + last.stiff
        grown = [torch.clamp(b - a, min=0.0) for a, b in pairwise(beyond)]
        whole = beyond[0] + sum(grown)
        new = [torch.where(whole > self.tiny, g / torch.maximum(whole, self.tiny), self.zero) for g in grown]
        own = force * (1.0 - sum(new))
        each = self.of_output
        rows = [
            each * (-last.weight * (runs[0] - last.wanted)),
            each * torch.where(high, self.zero, own),
            each * torch.where(high, own, self.zero),
            *(force * share - last.weight * (b - a) for share, a, b in zip(new, runs, runs[1:], strict=False)),
            each * -by.y_cost,
        ]
        outputs = torch.cat(rows, dim=-2) @ last.run.slopes_t
        moves = [self.of_mv * -by.z_cost, self.of_mv * (by.rest_weight * (by.rest - by.stands))]
        return torch.cat([outputs, *moves], dim=-2), curvature

    def _held(self, last: LastPass, by: OperatedPlan, rest: Tensor) -> list[Tensor]:
        """Entries (..., 1, m) of the plan that are held: at a low limit, a high one, by speed, and not in use.

        A bound holds an entry that lies at it where the ``rest`` (..., 1, m) of the minimum's equation pulls back.
        """
        low, high, plan, near = last.low, last.high, last.plan, self.near
        used = by.reach > 0
        upper, lower = (plan >= high - near) & (rest < 0) & used, (plan <= low + near) & (rest > 0) & used
        at_high, at_low = upper & (by.z_high <= high + near), lower & (by.z_low >= low - near)
        return [at_low, at_high, (upper & ~at_high) | (lower & ~at_low), ~used]

    def _parts(self, problem: PlanProblem, last: LastPass, by: OperatedPlan, terms: tuple[Tensor, Tensor]) -> Tensor:
        """The parts (..., n_mv, K) of the first moves, but for what is left of the last plan; scaled."""
        pulls, curvature = terms
        moved = last.plan - by.stands
        rest = moved @ curvature - pulls.sum(dim=-2, keepdim=True)
        held = [torch.where(h, self.one, self.zero) for h in self._held(last, by, rest)]
        free = 1.0 - torch.cat(held, dim=-2).sum(dim=-2, keepdim=True)
        own = torch.cat([self.of_mv * (h * rest) for h in held], dim=-2)
        others = torch.cat([-(self.of_mv * (h * moved)) @ curvature for h in held], dim=-2)
        limits = self.same * own.unsqueeze(-3) + (1.0 - self.same) * others.unsqueeze(-3)
        # Its own bounds are let go, to see what they take; an MV out of use has no part but that.
        own_too = torch.maximum(free, self.of_mv * (1.0 - held[-1]))  # (..., n_mv, m)
        into = self._solved(curvature.unsqueeze(-3), own_too.unsqueeze(-1), self.first.unsqueeze(-1)).transpose(-1, -2)
        return torch.cat([(pulls.unsqueeze(-3) * into).sum(dim=-1), (limits * into).sum(dim=-1)], dim=-1)

    def _solved(self, curvature: Tensor, free: Tensor, right: Tensor) -> Tensor:
        """H_FF^-1 times ``right`` (..., m, n) in the rows of F, and 0 in the others; ``free`` (..., m, 1) is 1 in F."""
        m = self.law.moves.count
        inner = free * curvature * free.transpose(-1, -2)
        inner = inner + self.unit * (1.0 - free)
        found = torch.cat([inner, (right * free).expand(*inner.shape[:-1], right.shape[-1])], dim=-1)
        for p in range(m):  # Gauss and Jordan: positive definite, so that no row changes its place
            row = found[..., p : p + 1, :] / found[..., p : p + 1, p : p + 1]
            found = found - (found[..., p : p + 1] - self.unit[:, p : p + 1]) * row
        return found[..., m:] * free

    def _finished(self, parts: Tensor, problem: PlanProblem, by: OperatedPlan, move: Tensor) -> Tensor:
        """All parts (..., n_mv, K) [mv] of the moves (..., n_mv), with those of the last plan.

        The last plan carries over no more than it had planned. All that is left beyond that is spread over the
        causes by their size.
        """
        law, n_mv, stands = self.law, self.n_mv, problem.stands
        # Where an MV stands outside its range, the step begins at the end of it.
        begins = (torch.minimum(torch.maximum(stands, law.low), law.high) - stands).unsqueeze(-2)
        eye = self.unit[:n_mv, :n_mv]
        outside = torch.cat([torch.clamp(begins, min=0.0) * eye, torch.clamp(begins, max=0.0) * eye], dim=-1)
        known, limits, others = torch.split(
            parts * law.mv_half.unsqueeze(-1), [parts.shape[-1] - 4 * n_mv, 2 * n_mv, 2 * n_mv], dim=-1
        )
        found = torch.cat([known, limits + outside, others], dim=-1)
        left = move.unsqueeze(-1) - found.sum(dim=-1, keepdim=True)
        most = (law.mv_half * (problem.plan - by.stands)[..., :n_mv].abs()).transpose(-1, -2)
        spread = left - torch.minimum(torch.maximum(left, -most), most)
        size = found.abs()
        found = found + spread * size / torch.maximum(size.sum(dim=-1, keepdim=True), self.tiny)
        return torch.cat([found, move.unsqueeze(-1) - found.sum(dim=-1, keepdim=True)], dim=-1)
