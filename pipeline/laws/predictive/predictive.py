"""Nonlinear model predictive control over an identified model, in one graph of fixed cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import LawError
from pipeline.laws.base import Analysis, ControlLaw, Stepped, require_kind
from pipeline.laws.predictive.horizon import horizon_of
from pipeline.laws.predictive.loads import Where, loads_of
from pipeline.laws.predictive.moves import Moves
from pipeline.laws.predictive.observer import Estimate, Noises, Observer, load_variance
from pipeline.laws.predictive.plan import Cost, Planner
from pipeline.laws.predictive.settling import horizon_for, refuse_unstable
from pipeline.laws.predictive.trials import Trials
from pipeline.laws.predictive.tuning import Candidate, searched
from pipeline.models.base import Model
from pipeline.models.identified.identified import Identified
from pipeline.models.memory import Named, Stage
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator


class Predictive(ControlLaw):
    """Model predictive control of several variables by several, free of offset.

        x, d <- Kalman filter (y, what acted over the last period)
        z    <- min sum_k sum_o q_o sqrt((y_o(k) - r_o)^2 + eps^2) + mu sum_j |z_j - z_{j-1}|^2,   |z| <= 1
        mv   =  the first move of z

    y(1) .. y(N) is the free run of the identified model from x under the plan z, with the estimated loads d and the
    measured disturbances as they are. The loads make the predictions right on average, so a constant error of the
    model or a load leaves no offset; a set point out of reach ends at the nearest output. The last plan, one sample
    on, is where the next one begins. The filter reads the MV that really acted: that is the anti-windup. Without a
    past it starts at the rest that fits the process variables and the applied MV.

    ``Observer``, ``Horizon`` and ``Planner`` hold the formulas and their sources.
    """

    name: ClassVar[str] = "predictive"
    title: ClassVar[str] = "Predictive control"
    estimates: ClassVar[bool] = True
    one_loop: ClassVar[bool] = False
    parts: ClassVar[Mapping[str, str]] = {"identified": "kind identified"}

    @dataclass(frozen=True, slots=True)
    class Params:
        """Two knobs, and the numbers behind them, which follow from the model where they are None.

        ``speed`` > 0: 2 moves as boldly as a quarter of ``move_weight``. ``caution`` > 0: 2 follows loads as slowly
        as a quarter of ``q_d``. ``horizon`` N samples, 8 or more; None: 90 % of the model's step responses settle
        within it, 12 to 50. ``moves`` of each MV in a plan; None: 8 of one MV, 5 of each of several.
        ``move_weight`` lambda > 0 of squared moves, mu = lambda (N - dead time)/10, MVs in units of half their range.
        ``eps`` > 0: errors smaller than this share of a PV's standard deviation count by their square, larger ones
        by their size. ``weights`` > 0 of the CVs in units of their standard deviation; None: all 1. ``q_x`` and
        ``q_d`` > 0: variance of the model's error and of the load's change a period, in units of the noise's; q_d
        None: 3e-5 over the noise. ``loads`` act on the ``mvs`` or the ``outputs``.
        ``passes`` of Gauss-Newton and ``sweeps`` of each QP, 1 or more; ``damping`` kappa of a pass, 0 or
        more; None: .5 of one MV, .25 of several.
        ``tuning``: ``given`` takes these numbers, ``search`` starts from them and chooses speed, caution
        and horizon in closed loops over the model with wrong gains and loads, drawn by ``seed``. ``mv_rate`` [mv]:
        largest MV change a sample, which the plan knows; None: unlimited.
        """

        speed: float = 1.0
        caution: float = 1.0
        horizon: int | None = None
        moves: int | None = None
        move_weight: float = 0.1
        eps: float = 0.1
        weights: tuple[float, ...] | None = None
        q_x: float = 0.01
        q_d: float | None = None
        loads: Where = "mvs"
        damping: float | None = None
        passes: int = 2
        sweeps: int = 4
        tuning: Literal["given", "search"] = "given"
        seed: int = 0
        mv_rate: float | None = None

        def __post_init__(self) -> None:
            for name in ("speed", "caution", "move_weight", "eps", "q_x", "q_d"):
                given = getattr(self, name)
                if given is not None and not 0 < given < np.inf:
                    raise ValueError(f"{name} is {given}; it must be above 0, and finite")
            if self.loads not in ("mvs", "outputs"):
                raise ValueError(f"loads is {self.loads!r}; allowed are mvs, outputs")
            if self.tuning not in ("given", "search"):
                raise ValueError(f"tuning is {self.tuning!r}; allowed are given, search")
            if self.damping is not None and not 0 <= self.damping < np.inf:
                raise ValueError(f"damping is {self.damping}; it must be 0 or above, and finite")
            for name, least in (("horizon", 8), ("moves", 1), ("passes", 1), ("sweeps", 1)):
                value = getattr(self, name)
                if value is not None and value < least:
                    raise ValueError(f"{name} is {value}; it must be at least {least}")
            if any(not 0 < w < np.inf for w in self.weights or ()):
                raise ValueError(f"weights are {list(self.weights or ())}; each must be above 0, and finite")

    tried: tuple[Candidate, ...] = ()  # of a search, the numbers that it started from first
    shift: Tensor  # (m, m) of a plan to the next sample
    upper: Tensor  # where the flat covariance's upper half stands
    whole: Tensor  # (n_a n_a,) the flat covariance's entries in its upper half
    mv_middle: Tensor  # (n_mv,)
    mv_half: Tensor  # (n_mv,)
    y_center: Tensor  # (n_cv,)
    y_scale: Tensor  # (n_cv,)
    load_scale: Tensor  # [mv] of loads at MVs, [pv a period] of loads at outputs; of a scaled load

    def __init__(self, signals: Signals, model: Identified, params: Params) -> None:
        super().__init__(signals, params.mv_rate)
        _check_sizes(signals, model)
        weights = _weights(signals, params)
        n_cv, n_mv = len(signals.sp), len(signals.mv)
        self.n_y, self.n_dv = model.n_y, model.n_dv
        middle, half = 0.5 * (self.high + self.low), 0.5 * (self.high - self.low)

        def mv_of(z: Tensor) -> Tensor:  # within -1..1 -> scaled as the model's
            return (middle + half * z - model.v_center[:n_mv]) / model.v_scale[:n_mv]

        horizon = horizon_for(model, mv_of) if params.horizon is None else params.horizon
        refuse_unstable(model)
        count = (8 if n_mv == 1 else 5) if params.moves is None else params.moves
        self.moves = Moves.over(horizon, count, n_mv, ramps=self.rate is not None)
        dead = min(float(model.dead.min()), horizon - 1.0)
        move = params.move_weight / params.speed**2 * (horizon - dead) / 10
        damping = (0.5 if n_mv == 1 else 0.25) if params.damping is None else params.damping
        cost = Cost(weights, move, params.eps, damping)
        loads = loads_of(model, params.loads, horizon)
        self.n_d = loads.count
        self.q_d = load_variance(model) if params.q_d is None else torch.full((model.n_y,), params.q_d).double()
        self.observer = Observer(model, loads, Noises(params.q_x, self.q_d / params.caution**2))
        rate = None if self.rate is None else self.rate / half
        run = horizon_of(model, loads, self.moves, mv_of, n_cv)
        self.planner = Planner(run, self.moves, cost, params.passes, params.sweeps, rate)
        at_mvs = loads.into_v[:n_mv].diagonal() * model.v_scale[:n_mv] if loads.at_mvs else model.y_scale[:n_cv]
        self.register_buffer("load_scale", at_mvs.clone())
        self._build_ends(model, n_cv, middle, half)
        self.info = (
            *(f"load_{s.name}" for s in (signals.mv if loads.at_mvs else signals.sp)),
            *(f"next_{s.name}" for s in signals.sp),
            *(f"boost_{s.name}" for s in signals.sp),
        )

    @torch.no_grad()
    def _build_ends(self, model: Identified, n_cv: int, middle: Tensor, half: Tensor) -> None:
        """Everything that is affine in the inputs, and the layout of the state."""
        n_a, n_y, n_dv = self.observer.n_a, model.n_y, model.n_dv
        y_center, y_scale, count = model.y_center, model.y_scale, self.moves.count
        upper = torch.triu_indices(n_a, n_a)
        whole = torch.zeros(n_a, n_a, dtype=torch.long)
        whole[upper[0], upper[1]] = whole[upper[1], upper[0]] = torch.arange(upper.shape[1])
        first = self.observer.first[upper[0], upper[1]]
        self.kept = {"mean": n_a, "covariance": len(first), "drift": n_y, "squares": 2 * n_y, "plan": count}
        self.n_state = 1 + sum(self.kept.values()) + n_dv

        def inputs(p: Named) -> Named:
            y = (p["pv"][..., :n_y] - y_center) / y_scale
            v = (torch.cat([p["mv"], p["dv"]], dim=-1) - model.v_center) / model.v_scale
            z = (p["mv"] - middle) / half
            one = torch.ones_like(z[..., :1])
            rest = torch.cat([y, v, one], dim=-1) @ model.rest[n_y:].T
            past = [
                y,
                rest,
                one * torch.zeros(self.n_d, dtype=torch.float64),
                one * first,
                0 * y,
                0 * y,
                0 * y,
                z.repeat(*(1 for _ in z.shape[:-1]), count // z.shape[-1]),
            ]
            sp = (p["sp"] - y_center[:n_cv]) / y_scale[:n_cv]
            return {"y": y, "sp": sp, "z": z, "v": v, "past": torch.cat(past, dim=-1), "one": one}

        signals = self.signals
        self.layout = {n: len(getattr(signals, n)) for n in ("sp", "pv", "dv", "mv")}
        self.inputs = Stage(self.layout, inputs)
        for name, values in {
            "upper": upper[0] * n_a + upper[1],
            "whole": whole.flatten(),
            "shift": torch.from_numpy(self.moves.shift),
            "mv_middle": middle,
            "mv_half": half,
            "y_scale": y_scale[:n_cv],
            "y_center": y_center[:n_cv],
        }.items():
            self.register_buffer(name, values.clone())

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over part ``identified``; raises LawError."""
        _refuse_discrete(signals)
        model = require_kind(models, Identified, cls.name, "")
        law = cls(signals, model, params)
        return law if params.tuning == "given" else law._searched(model, params)

    def _searched(self, model: Identified, params: Params) -> Self:
        """The law with the best numbers of a search that starts from this one's."""
        horizon = self.moves.horizon

        def law_of(n: Mapping[str, float]) -> Any:
            changed: Any = replace(params, speed=n["speed"], caution=n["caution"], horizon=int(n["horizon"]))
            return type(self)(self.signals, model, changed).eval()

        start = {n: float(getattr(params, n)) for n in ("speed", "caution")} | {"horizon": float(horizon)}
        best, tried = searched(Trials.draw(model, self.signals, horizon, params.seed), law_of, start)
        law: Self = law_of(best.numbers)
        law.tried = tuple(tried)
        return law

    def analysis(self, plant: Simulator | None) -> Analysis:
        """The numbers that a search chose, and its cost at first and at last; empty without one."""
        if not self.tried:
            return Analysis()
        best = min(self.tried, key=lambda c: c.cost)
        figures = {**best.numbers, "cost": best.cost, "cost_given": self.tried[0].cost, "tried": len(self.tried)}
        note = (
            f"{len(self.tried)} sets of numbers were tried in closed loops over the model with errors of gain, pace "
            f"and dead time, with loads and noise; the cost fell from {self.tried[0].cost:.3g} to {best.cost:.3g}, "
            "where 1 is the errors with the first numbers, and .1 a travel of 1 % of the MVs' range a sample."
        )
        return Analysis(figures, notes=(note,))

    @classmethod
    def check(cls, params: Any, models: Mapping[str, Model], plant: Simulator) -> None:
        """Raise LawError for a plant with discrete MVs, or for another number of weights than of set points."""
        _refuse_discrete(plant.signals)
        _weights(plant.signals, params)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        now = self.inputs(torch.cat([sp, pv, dv, mv_applied], dim=-1).unsqueeze(-2))
        mean, boost, kept, plan = self._estimated(now, state.unsqueeze(-2))
        measured = now["v"][..., now["z"].shape[-1] :]
        n_cv = sp.shape[-1]
        start = torch.cat([mean, measured], dim=-1)
        plan, ahead = self.planner(start, now["sp"], torch.clamp(now["z"], -1.0, 1.0), plan)
        mv = (self.mv_middle + self.mv_half * plan[..., : now["z"].shape[-1]]).squeeze(-2)
        info = [
            self.load_scale * mean[..., self.observer.n_x : self.observer.n_x + self.load_scale.shape[0]],
            self.y_center + self.y_scale * ahead,
            boost[..., :n_cv],
        ]
        state_next = torch.cat([now["one"], kept, plan, measured], dim=-1).squeeze(-2)
        return self.limited(mv, mv_applied), state_next, torch.cat(info, dim=-1).squeeze(-2)

    def _estimated(self, now: Named, state: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """[x, d], the boost, what of the estimate goes to the next state, and the plan to begin at."""
        sizes = [1, *self.kept.values(), self.n_dv] if self.n_dv else [1, *self.kept.values()]
        started, mean, packed, drift, squares, plan, *dv = torch.split(state, sizes, dim=-1)
        n_a, n_mv = self.observer.n_a, now["z"].shape[-1]
        square = packed.index_select(-1, self.whole).reshape(*packed.shape[:-2], n_a, n_a)
        acted = torch.cat([now["v"][..., :n_mv], *dv], dim=-1)
        seen, boost = self.observer(now["y"], acted, Estimate(mean, square, drift, squares))
        flat = seen.covariance.flatten(-2).index_select(-1, self.upper).unsqueeze(-2)
        known = torch.cat([seen.mean, flat, seen.drift, seen.squares, plan @ self.shift], dim=-1)
        past = torch.where(started > 0, known, now["past"])
        n_plan = self.moves.count
        return past[..., :n_a], started * boost, past[..., :-n_plan], past[..., -n_plan:]


def _refuse_discrete(signals: Signals) -> None:
    for s in signals.mv:
        if s.values:
            raise LawError(
                f"law 'predictive' moves its MVs continuously; {s.name} has only the values {list(s.values)}: "
                "leave out `values` of the signal, or choose a law for discrete MVs"
            )


def _weights(signals: Signals, params: Any) -> tuple[float, ...]:
    """One weight a set point; LawError for another number."""
    weights: tuple[float, ...] = tuple(params.weights or (1.0 for _ in signals.sp))
    if len(weights) != len(signals.sp):
        names = ", ".join(s.name for s in signals.sp)
        raise LawError(f"law 'predictive' has {len(weights)} weights; give one for each set point ({names})")
    return weights


def _check_sizes(signals: Signals, model: Identified) -> None:
    """LawError unless the model has the plant's MVs and measured disturbances, and all set points as outputs."""
    plant = (len(signals.mv), len(signals.dv))
    if (model.n_mv, model.n_dv) != plant or not len(signals.sp) <= model.n_y <= len(signals.pv):
        raise LawError(
            f"law 'predictive': the identified model has {model.n_y} outputs, {model.n_mv} MVs and {model.n_dv} "
            f"measured disturbances; the plant has {len(signals.sp)} set points among {len(signals.pv)} PVs, "
            f"{plant[0]} MVs and {plant[1]} measured disturbances: identify the model from this plant's record"
        )
