"""Nonlinear model predictive control over an identified model, in one graph of fixed cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from loopwright.pipeline.laws.base import Analysis, ControlLaw, Stepped, require_kind
from loopwright.pipeline.laws.predictive.bounded_minimum import BoundedMinimum
from loopwright.pipeline.laws.predictive.cold_rest import bent_rest, cold_start, held_rest
from loopwright.pipeline.laws.predictive.disturbance_model import Loads, balanced, loads_of, recorded_changes
from loopwright.pipeline.laws.predictive.horizon import Moves, horizon_of
from loopwright.pipeline.laws.predictive.horizon_check import AnswerTimes, horizon_for, mvs_of, refuse_unstable
from loopwright.pipeline.laws.predictive.known_future import KnownFuture, ahead_of
from loopwright.pipeline.laws.predictive.observer import Noises, Observer, StateEstimate, load_variance
from loopwright.pipeline.laws.predictive.operating import OperateScales, Operation, entries_of
from loopwright.pipeline.laws.predictive.params import (
    USUAL_CHANGES,
    USUAL_SWEEPS,
    PredictiveParams,
    check_sizes,
    limits_of,
    loads_at,
    refuse_discrete,
    weights_of,
)
from loopwright.pipeline.laws.predictive.qp_solver import Cost, Planner, PlanProblem
from loopwright.pipeline.laws.predictive.set_point_course import course_of
from loopwright.pipeline.laws.predictive.soft_limits import PRICE, SoftLimits, scaled_limits
from loopwright.pipeline.laws.predictive.tuning import TriedNumbers, in_words, searched_params
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.memory import AffineMap, Named
from loopwright.pipeline.plants.noise import level_gain
from loopwright.pipeline.plants.simulator import Signals, Simulator
from loopwright.pipeline.tuning.calm_choice import calmest
from loopwright.serving.guard import READ_BACK_MARGIN


class Predictive(ControlLaw):
    """Model predictive control of several variables by several, free of offset.

        x, d <- Kalman filter (y, what acted over the last period)
        z    <- min sum_k sum_o q_o sqrt((y_o(k) - r_o(k))^2 + eps^2) + mu sum_j |z_j - z_{j-1}|^2,   |z| <= 1
        mv   =  the first move of z

    y(1) .. y(N) is the free run of the identified model from x under the plan z, with the estimated loads d and the
    measured disturbances as they are; of one with noise, with its level, which follows it by ``level_gain``. The loads
    make the predictions right on average, so a constant error of the model or a load leaves no offset; a set point out
    of reach ends at the nearest output. The last plan, one sample on, is where the next one begins. The filter reads
    the MV that really acted: that is the anti-windup. Without a past it starts at the rest that fits the process
    variables and the applied MV, under the loads that hold it there: on set point it asks for that MV. The set points r
    stay as they are, go on with their last slope, or change as ``ahead`` says, and so may the measured disturbances.
    CVs may have soft limits, whose cost is added. With ``operate`` operators give ranges, take signals out, and set
    priorities, resting values and costs while it runs.

    ``Observer``, ``LinearHorizon`` and ``NetworkHorizon``, ``Planner``, ``SetPointCourse`` and ``SoftLimits`` hold the
    formulas and their sources.
    """

    name: ClassVar[str] = "predictive"
    title: ClassVar[str] = "Predictive control"
    estimates: ClassVar[bool] = True
    one_loop: ClassVar[bool] = False
    parts: ClassVar[Mapping[str, str]] = {"identified": "kind identified"}
    Params: ClassVar[type[Any]] = PredictiveParams

    tried: tuple[TriedNumbers, ...] = ()  # of a search, the numbers that it started from first
    calmer: tuple[Identified, PredictiveParams] | None = None  # of a search: model and numbers of last resort
    remarks: tuple[str, ...] = ()  # on a horizon that is short for the model
    operation: Operation | None  # of a law that reads ``operate`` and ``fresh``
    known: KnownFuture | None  # of a law that reads ``ahead``
    operate_default: Tensor  # (n_operate,)
    same: Tensor  # (n_mv,) [mv] by which a read-back may be off the command
    variances: Tensor  # (n_o,) where the outputs' variances stand in the state's covariance
    shift: Tensor  # (m, m) of a plan to the next sample
    upper: Tensor  # where the flat covariance's upper half stands
    whole: Tensor  # (n_a n_a,) the flat covariance's entries in its upper half
    mv_middle: Tensor  # (n_mv,)
    mv_half: Tensor  # (n_mv,)
    y_center: Tensor  # (n_cv,)
    y_scale: Tensor  # (n_cv,)
    largest: Tensor  # (n_d,) scaled load of a rest
    bent: Tensor  # (BENDS, n_a) of a network's rests; empty without one
    follow: Tensor  # (n_dv,) of the level of each measured disturbance
    load_scale: Tensor  # [mv] of loads at MVs, [pv a period] of loads at outputs; of a scaled load

    def __init__(self, signals: Signals, model: Identified, params: PredictiveParams) -> None:
        super().__init__(signals, params.mv_rate)
        check_sizes(signals, model)
        weights = weights_of(signals, params)
        n_cv, n_mv = len(signals.sp), len(signals.mv)
        middle, half = 0.5 * (self.high + self.low), 0.5 * (self.high - self.low)
        mv_of = mvs_of(model, middle, half)
        horizon = horizon_for(model, mv_of) if params.horizon is None else params.horizon
        refuse_unstable(model)
        count = (8 if n_mv == 1 else 5) if params.moves is None else params.moves
        self.moves = Moves.over(horizon, count, n_mv, ramps=self.rate is not None)
        dead = min(float(model.dead.min()), horizon - 1.0)
        move = params.move_weight / params.speed**2 * (horizon - dead) / 10
        damping = (0.5 if n_mv == 1 else 0.25) if params.damping is None else params.damping
        cost = Cost(weights, move, params.eps, damping)
        where = loads_at(model, params)
        loads = loads_of(model, where, horizon)
        self.q_d = load_variance(model) if params.q_d is None else torch.full((model.n_y,), params.q_d).double()
        changes = recorded_changes(model) / params.caution**2 if where == "record" else None
        noises = Noises(params.q_x, self.q_d / params.caution**2, params.jumps, changes)
        self.observer = Observer(model, loads, noises)
        rate = None if self.rate is None else self.rate / half
        # With `operate` further PVs that the model has as outputs have ranges, too.
        n_o = n_cv if params.operate is None else model.n_y
        given = params.preview == "course"
        run = horizon_of(model, loads, self.moves, mv_of, n_o, forecasts=given)
        bounds = scaled_limits(signals, model, params) if params.operate is None else None
        walls = None if bounds is None else SoftLimits(*bounds, PRICE * max(weights), horizon)
        cost = replace(cost, weights=(*weights, *(0.0 for _ in range(n_o - n_cv))))
        most = USUAL_CHANGES if params.changes is None else params.changes
        bounded = None if params.operate is None else BoundedMinimum(self.moves.count, most)
        sweeps = USUAL_SWEEPS if params.sweeps is None else params.sweeps
        self.planner = Planner(run, self.moves, cost, params.passes, sweeps, rate, walls, bounded, valleys=n_mv > n_cv)
        self.wanted = course_of(signals, model, horizon, n_o, bounds, ramp=params.preview == "ramp")
        self.ahead = ahead_of(signals, horizon) if given else None
        self.known = None if self.ahead is None else KnownFuture(self.ahead, model, n_o)
        self.operation = None
        if params.operate is not None:
            self._build_operation(model, params, n_o, max(weights), middle, half)
        at_mvs = loads.into_v[:n_mv].diagonal() * model.v_scale[:n_mv] if loads.at_mvs else model.y_scale[:n_cv]
        self.register_buffer("load_scale", at_mvs.clone())
        self.register_buffer("largest", balanced(model, loads, 2 * half / model.v_scale[:n_mv], horizon))
        self._build_ends(model, loads, n_cv, middle, half)
        self.info = (
            *(f"load_{s.name}" for s in (signals.mv if loads.at_mvs else signals.sp)),
            *(f"next_{s.name}" for s in signals.sp),
            *(f"boost_{s.name}" for s in signals.sp),
        )

    def _build_operation(
        self, model: Identified, params: PredictiveParams, n_o: int, most_weight: float, middle: Tensor, half: Tensor
    ) -> None:
        """The entries of ``operate``, their defaults, and the way from them to a plan."""
        low, high = (getattr(params, end) or (None,) * len(self.signals.sp) for end in ("cv_low", "cv_high"))
        limits_of(self.signals, params)  # raises
        self.operate = entries_of(self.signals, n_o, low, high, params.operate or {}, params.mv_rate)
        scales = OperateScales(model.y_center[:n_o], model.y_scale[:n_o], middle, half)
        self.operation = Operation(self.operate, scales, self.moves, most_weight)
        self.register_buffer("same", 2 * READ_BACK_MARGIN * half)
        default = torch.tensor([entry.default for entry in self.operate], dtype=torch.float64)
        self.register_buffer("operate_default", default)
        rows, columns = torch.triu_indices(self.observer.n_a, self.observer.n_a)
        self.register_buffer("variances", torch.nonzero((rows == columns) & (rows < n_o)).flatten())

    @torch.no_grad()
    def _build_ends(self, model: Identified, loads: Loads, n_cv: int, middle: Tensor, half: Tensor) -> None:
        """Everything that is affine in the inputs, and the layout of the state."""
        n_a, n_y = self.observer.n_a, model.n_y
        y_center, y_scale, count = model.y_center, model.y_scale, self.moves.count
        upper = torch.triu_indices(n_a, n_a)
        whole = torch.zeros(n_a, n_a, dtype=torch.long)
        whole[upper[0], upper[1]] = whole[upper[1], upper[0]] = torch.arange(upper.shape[1])
        first = self.observer.first[upper[0], upper[1]]
        kept = {"started": 1, "mean": n_a, "covariance": len(first), "drift": n_y, "squares": 2 * n_y, "plan": count}
        follow = level_gain(model.dv_noise.numpy(), model.dv_change.numpy())
        levels = model.n_dv if (follow < 1).any() else 0
        older = {
            "dv": model.n_dv,
            "level": levels,
            "sp": n_cv if self.wanted.ramp else 0,
            "sp_before": n_cv if self.wanted.ramp else 0,
            "given": 0 if self.operation is None else len(half),
        }
        self.kept = kept | {name: n for name, n in older.items() if n}
        self.n_state = sum(self.kept.values())

        def inputs(p: Named) -> Named:
            y = (p["pv"][..., :n_y] - y_center) / y_scale
            v = (torch.cat([p["mv"], p["dv"]], dim=-1) - model.v_center) / model.v_scale
            z = (p["mv"] - middle) / half
            one = torch.ones_like(z[..., :1])
            given = torch.cat([y, v, one], dim=-1)
            past = [
                one * first,
                0 * y,
                0 * y,
                0 * y,
                z.repeat(*(1 for _ in z.shape[:-1]), count // z.shape[-1]),
            ]
            sp = (p["sp"] - y_center[:n_cv]) / y_scale[:n_cv]
            starts = {"held": given @ rest.T, "free": given @ free.T}
            if bent is not None:
                starts |= {"straight": given @ bent.straight.T, "bends": given @ bent.into.T}
            return {"y": y, "sp": sp, "z": z, "v": v, **starts, "past": torch.cat(past, dim=-1), "one": one}

        rest, free = held_rest(model, loads), torch.cat([model.rest, torch.zeros(loads.count, model.rest.shape[1])])
        for start in (rest, free):
            start[:n_y] = torch.eye(*start[:n_y].shape, dtype=torch.float64)  # rounding moves no output
        bent = None
        if self.observer.nonlinear:
            scale, centre = model.v_scale[: len(middle)], model.v_center[: len(middle)]
            reach = [(middle - half - centre) / scale, (middle + half - centre) / scale]
            bent = bent_rest(model, loads, rest, torch.stack(reach, dim=1))
        self.register_buffer("bent", torch.zeros(0, 0).double() if bent is None else bent.bent.T.contiguous())
        signals = self.signals
        self.layout = {n: len(getattr(signals, n)) for n in ("sp", "pv", "dv", "mv")}
        self.inputs = AffineMap(self.layout, inputs)
        for name, values in {
            "upper": upper[0] * n_a + upper[1],
            "whole": whole.flatten(),
            "shift": torch.from_numpy(self.moves.shift),
            "mv_middle": middle,
            "mv_half": half,
            "y_scale": y_scale[:n_cv],
            "y_center": y_center[:n_cv],
            "follow": torch.from_numpy(follow),
        }.items():
            self.register_buffer(name, values.clone())

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over part ``identified``; raises LawError."""
        refuse_discrete(signals)
        model = require_kind(models, Identified, cls.name, "")
        law = cls(signals, model, params)
        sight = AnswerTimes.of(model, mvs_of(model, law.mv_middle, law.mv_half), len(signals.sp))
        sight.require(law.moves.horizon)
        if params.tuning == "search":
            horizon = law.moves.horizon
            found = searched_params(lambda given: cls(signals, model, given).eval(), model, signals, params, horizon)
            law = cls(signals, model, found.params).eval()
            law.tried, law.calmer = found.tried, (model, found.calmer)
        law.remarks = sight.notes(law.moves.horizon)
        return law

    def calmed(self) -> Self | None:
        """The law of ``CALM_SPEED`` of the speed and ``CALM_JUMPS`` of the jumps; None without a search."""
        return None if self.calmer is None else type(self)(self.signals, *self.calmer)

    def analysis(self, plant: Simulator | None) -> Analysis:
        """The numbers that a search chose, and its cost at first and at last; nothing else without one."""
        if not self.tried:
            return Analysis(notes=self.remarks)
        best, damping = calmest(self.tried), float(self.planner.damping)
        first = self.tried[0].cost
        figures = {**best.numbers, "damping": damping, "cost": best.cost, "cost_given": first, "tried": len(self.tried)}
        rows = [c.row() | {"taken": float(c is best)} for c in sorted(self.tried, key=lambda c: c.cost)]
        return Analysis(figures, notes=(in_words(self.tried), *self.remarks), table=tuple(rows))

    @classmethod
    def check_settings(cls, params: Any, signals: Signals) -> None:
        """Raise LawError for a plant with discrete MVs, or for settings that do not fit its signals.

        These are weights, limits, rates, and the defaults of ``operate``; how many PVs the model has is not known yet.
        """
        refuse_discrete(signals)
        super().check_settings(params, signals)
        weights_of(signals, params)
        limits_of(signals, params)
        if params.operate is not None:
            ends = (params.cv_low or (), params.cv_high or ())
            entries_of(signals, len(signals.pv), *ends, params.operate, params.mv_rate)

    def forward(
        self,
        sp: Tensor,
        pv: Tensor,
        dv: Tensor,
        mv_applied: Tensor,
        state: Tensor,
        operate: Tensor | None = None,
        fresh: Tensor | None = None,
        ahead: Tensor | None = None,
    ) -> Stepped:
        """One step; shapes as in ControlLaw.

        ``operate`` (..., n_operate), ``fresh`` (..., n_pv), ``ahead`` (..., N n) of the set points and measured
        disturbances; None: by default.
        """
        problem = self.problem(sp, pv, dv, mv_applied, state, operate, fresh, ahead)
        return self.answer(problem, *self.planner(*problem.given))

    def problem(
        self,
        sp: Tensor,
        pv: Tensor,
        dv: Tensor,
        mv_applied: Tensor,
        state: Tensor,
        operate: Tensor | None = None,
        fresh: Tensor | None = None,
        ahead: Tensor | None = None,
    ) -> PlanProblem:
        """The problem of a step that the planner solves; arguments as of ``forward``."""
        now = self.inputs(torch.cat([sp, pv, dv, mv_applied], dim=-1).unsqueeze(-2))
        parts = torch.split(state.unsqueeze(-2), list(self.kept.values()), dim=-1)
        kept = dict(zip(self.kept, parts, strict=True))
        operated, seen, n_y = None, None, now["y"].shape[-1]
        applied, stands = torch.clamp(now["z"], -1.0, 1.0), mv_applied
        if self.operation is not None:
            stands = self._stands(mv_applied, kept)
            applied = torch.clamp((stands - self.mv_middle) / self.mv_half, -1.0, 1.0).unsqueeze(-2)
            given = self.operate_default.expand(*sp.shape[:-1], -1) if operate is None else operate
            seen = torch.ones_like(now["y"]) if fresh is None else fresh[..., :n_y].unsqueeze(-2)
            share = self.operation.load_share(given.unsqueeze(-2))
            mean, boost, estimate, plan = self._estimated(now, kept, seen, share)
            variance = estimate[..., mean.shape[-1] :].index_select(-1, self.variances)
            sd, off = torch.sqrt(torch.clamp(variance, min=0.0)), torch.clamp(now["z"], -1.0, 1.0) - applied
            moves = [of.repeat(*(1 for _ in of.shape[:-1]), len(self.moves.starts)) for of in (applied, off)]
            operated = self.operation(given.unsqueeze(-2), *moves, sd)
        else:
            mean, boost, estimate, plan = self._estimated(now, kept)
        measured = now["v"][..., now["z"].shape[-1] :]
        levels = [self._level(measured, kept)] if "level" in kept else []
        start = torch.cat([mean, *(levels or [measured])], dim=-1)
        past = [torch.where(kept["started"] > 0, kept[n], now["sp"]) for n in ("sp", "sp_before") if n in kept]
        later, forecast = self._later(ahead)
        wanted = self.wanted(self._of_outputs(now["sp"]), [self._of_outputs(p) for p in past], later)
        next_kept = {"one": now["one"], "estimate": estimate, "measured": measured}
        if levels:
            next_kept["level"] = levels[0]
        if past:
            next_kept |= {"sp": now["sp"], "sp_before": past[0]}
        asked = (start, wanted, applied, plan, operated, forecast)
        return PlanProblem(*asked, mean, now, kept, seen, boost, next_kept, stands, mv_applied)

    def answer(self, problem: PlanProblem, plan: Tensor, soon: Tensor) -> Stepped:
        """MV, next state and info of a step with its ``plan`` (..., 1, m) and next outputs ``soon`` (..., 1, n_o)."""
        now, stands = problem.now, problem.stands
        n_cv, mean = len(self.signals.sp), problem.mean
        mv = (self.mv_middle + self.mv_half * plan[..., : now["z"].shape[-1]]).squeeze(-2)
        if problem.operated is not None:
            # The plan is within them already; in engineering units it is so up to rounding.
            by = problem.operated
            low, high, most = (of.squeeze(-2) for of in (by.mv_low, by.mv_high, by.mv_move))
            mv = torch.minimum(torch.maximum(mv, low), high)
            mv = torch.minimum(torch.maximum(mv, stands - most), stands + most)
        mv = self.limited(mv, problem.mv_applied)
        info = [
            self.load_scale * mean[..., self.observer.n_x : self.observer.n_x + self.load_scale.shape[0]],
            self.y_center + self.y_scale * soon[..., :n_cv],
            problem.boost[..., :n_cv],
        ]
        one, estimate, *others = problem.next_kept.values()
        ordered = [mv.unsqueeze(-2)] if "given" in problem.kept else []
        state_next = torch.cat([one, estimate, plan, *others, *ordered], dim=-1).squeeze(-2)
        return mv, state_next, torch.cat(info, dim=-1).squeeze(-2)

    def _later(self, ahead: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """Changes by ``ahead`` of the set points over the horizon, and the horizon's offset under its disturbances."""
        if self.known is None or ahead is None:
            return None, None
        later, dv = self.known(ahead)
        return later, self.planner.horizon.forecast(dv) if dv.shape[-1] else None

    def _stands(self, mv_applied: Tensor, kept: Named) -> Tensor:
        """Where each MV goes on from (..., n_mv) [mv]: its last command, or the applied value where that is elsewhere.

        A read-back that is a little off would else be commanded, read off again, and so walk to the end of the range
        wherever nothing pulls: of an MV out of use, or of moves that no output shows.
        """
        given = kept["given"].squeeze(-2)
        near = (mv_applied - given).abs() <= self.same
        return torch.where(near & (kept["started"].squeeze(-2) > 0), given, mv_applied)

    def _of_outputs(self, sp: Tensor) -> Tensor:
        """Set points (..., 1, n_o), zeros for outputs that have a range alone."""
        others = self.wanted.n_cv - sp.shape[-1]
        return sp if not others else torch.cat([sp, *[torch.zeros_like(sp[..., :1])] * others], dim=-1)

    def _level(self, measured: Tensor, kept: Named) -> Tensor:
        """The level (..., 1, n_dv) of the measured disturbances, scaled; without a past, what is measured."""
        followed = kept["level"] + self.follow * (measured - kept["level"])
        return torch.where(kept["started"] > 0, followed, measured)

    def _estimated(
        self, now: Named, kept: Named, fresh: Tensor | None = None, load_share: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """[x, d], the boost, what of the estimate goes to the next state, and the plan to begin at."""
        n_a, n_mv = self.observer.n_a, now["z"].shape[-1]
        packed = kept["covariance"]
        square = packed.index_select(-1, self.whole).reshape(*packed.shape[:-2], n_a, n_a)
        acted = torch.cat([now["v"][..., :n_mv], *(kept[n] for n in ("dv",) if n in kept)], dim=-1)
        seen, boost = self.observer(
            now["y"],
            acted,
            StateEstimate(kept["mean"], square, kept["drift"], kept["squares"]),
            fresh,
            load_share,
        )
        flat = seen.covariance.flatten(-2).index_select(-1, self.upper).unsqueeze(-2)
        known = torch.cat([seen.mean, flat, seen.drift, seen.squares, kept["plan"] @ self.shift], dim=-1)
        first = torch.cat([cold_start(now, self.observer, self.largest, self.bent), now["past"]], dim=-1)
        past = torch.where(kept["started"] > 0, known, first)
        n_plan = self.moves.count
        return past[..., :n_a], kept["started"] * boost, past[..., :-n_plan], past[..., -n_plan:]
