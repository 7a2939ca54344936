"""Shared parts of the local controller networks: PIDs at operating points, blended by the plant's place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import (
    Analysis,
    ControlLaw,
    Stepped,
    hold_numbers,
    never_given,
    require_single_loop,
    stood_still,
)
from loopwright.pipeline.models.local_models import LocalModels
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.simulator import Array, Signals, Simulator
from loopwright.pipeline.tuning.stability import (
    FrozenLoops,
    Recovery,
    Starts,
    other_rests,
    pairwise_contraction,
    recover,
    spectral_radius,
)

LOCAL_BATCH = 500  # loops that run side by side in one piece
SAME_STATE = 1e-3  # relative difference of two states that count as one


@dataclass(frozen=True, slots=True)
class StabilityTest:
    """How the stability of a law is examined.

    ``between``: linear loops from one operating point to the next, both included. ``starts``: loops
    that begin anywhere between the states ``low`` and ``high`` (None: over the states' ranges; none
    where ``starts`` is 0), at any MV, their set points anywhere between the outer operating points;
    ``seed`` draws them. One has recovered when it stays within ``band`` [CV] (None: 1 % of the set
    point's range) for ``holding`` samples, before ``samples`` are over. The courses of the first
    ``watched`` are kept.
    """

    between: int = 9
    starts: int = 2_000
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    seed: int = 1
    band: float | None = None
    holding: int = 50
    samples: int = 1_000
    watched: int = 60

    def __post_init__(self) -> None:
        for name, least in (("between", 2), ("starts", 0), ("holding", 1), ("samples", 1), ("watched", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least}")
        if self.band is not None and not self.band > 0:
            raise ValueError(f"band is {self.band}; give the width in the CV's unit, above 0")
        low, high = self.low, self.high
        if low is None and high is None:
            return
        if low is None or high is None or len(low) != len(high) or any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(
                f"low is {low} and high is {high}; give both, a number of each for every state of the plant, each low "
                "below its high, or neither"
            )

    def box(self, plant: EquationPlant) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Least and largest states at which a loop starts, each (n_x,), in the plant's units."""
        low, high = zip(*((s.low, s.high) for s in plant.state_signals), strict=True)
        return self.low or low, self.high or high


def stability_analysis(law: ControlLaw, plant: EquationPlant, points: Sequence[float], test: StabilityTest) -> Analysis:
    """Frozen loops, Lyapunov functions of neighbouring points, and recoveries from many starts.

    ``points`` are the operating points [CV] that the law is blended over.
    """
    edges = np.sort(np.array(points))
    cvs = np.unique(np.concatenate([np.linspace(a, b, test.between) for a, b in pairwise(edges)]))
    loops = FrozenLoops.of(plant, law, law.n_state, cvs)
    matrices = loops.matrices()
    contraction = pairwise_contraction(matrices, cvs, list(edges))
    proven = ~np.isnan(contraction)
    sp = plant.sp_signals[0]
    # Beyond the outer points too, where one controller is alone.
    wide = np.linspace(sp.low, sp.high, 4 * len(cvs))[1:-1]
    radius = spectral_radius(FrozenLoops.of(plant, law, law.n_state, wide).matrices())
    figures = {
        "frozen_radius": float(spectral_radius(matrices).max()),
        "frozen_radius_over_range": float(radius.max()),
        "gain_margin": loops.gain_margin(),
        "lyapunov_pairs": float(proven.sum()),
        "neighbour_pairs": float(len(contraction)),
    }
    if proven.all():
        figures["lyapunov_contraction"] = float(contraction.max())
    arrays = {"frozen_cv": wide, "frozen_radius": radius, "points": edges, "contraction": contraction}
    notes = [_lyapunov_note(edges, proven)]
    if test.starts:
        recovered = _recoveries(law, plant, edges, test)
        figures, arrays = {**figures, **recovered.figures}, {**arrays, **recovered.arrays}
        notes += recovered.notes
    return Analysis(figures, arrays, tuple(notes))


def _lyapunov_note(edges: Array, proven: Array) -> str:
    words = (
        "A quadratic Lyapunov function shared by the linear loops from one operating point to the next, checked after "
        "the solver, proves that they stay stable however the operating point moves among them; it says nothing of "
        "steps so large that no linear loop describes them."
    )
    missing = [f"{a:.4g} to {b:.4g}" for a, b, ok in zip(edges, edges[1:], proven, strict=False) if not ok]
    return words + (f" None was found from {', '.join(missing)}." if missing else "")


def _batch(run: Callable[..., Recovery], item: tuple[Starts, int]) -> Recovery:
    starts, watched = item
    return run(starts, watched=watched)


def _recoveries(law: ControlLaw, plant: EquationPlant, edges: Array, test: StabilityTest) -> Analysis:
    rng, sp, mv = np.random.default_rng(test.seed), plant.sp_signals[0], plant.mv_signals[0]
    n, (low, high) = test.starts, test.box(plant)
    band = 0.01 * (sp.high - sp.low) if test.band is None else test.band
    starts = Starts(
        rng.uniform(low, high, (n, len(low))),
        rng.uniform(edges[0], edges[-1], (n, 1)),
        rng.uniform(mv.low, mv.high, (n, 1)),
    )

    run = partial(recover, plant, law, law.n_state, samples=test.samples, band=band, holding=test.holding)
    # The first batch has all whose courses are kept.
    batches = starts.batches(max(LOCAL_BATCH, test.watched))
    work = [(batch, test.watched if i == 0 else 0) for i, batch in enumerate(batches)]
    ended = Recovery.together(parallel_map(partial(_batch, run), work, f"{law.name}: loops from many starts"))
    minutes = plant.period_s / 60.0
    out = plant.measured(ended.end)[:, 0] > sp.high + 0.5 * (sp.high - sp.low)
    figures = {
        "starts": float(n),
        "recovered": float(ended.arrived.sum()),
        "left_range": float((out & ~ended.arrived).sum()),
    }
    if ended.arrived.any():
        figures["recovery_min"] = minutes * float(np.median(ended.samples[ended.arrived]))
    arrays = {
        "start": starts.x,
        "start_sp": starts.sp,
        "arrived": ended.arrived.astype(float),
        "end": ended.end,
        "courses": ended.courses,
    }
    rests = other_rests(plant)
    if not len(rests):
        return Analysis(figures, arrays)
    middle = 0.5 * (edges[0] + edges[-1])
    ends = np.full((len(rests), 1), middle), np.full((len(rests), 1), mv.low)
    back = run(Starts(rests, *ends), watched=len(rests))
    arrays |= {"other_rest": rests, "other_rest_courses": back.courses}
    arrays["other_rest_arrived"] = back.arrived.astype(float)
    # Several of them may lead to one: a reactor that has gone out rests elsewhere under another MV.
    kept: list[Array] = []
    cv = plant.measured(back.end)[:, 0]
    # What swings within the range does not arrive either, and yet came back.
    for state in back.end[~back.arrived & ((cv < sp.low) | (cv > sp.high))]:
        if all(np.abs(state / known - 1).max() > SAME_STATE for known in kept):
            kept.append(state)
    figures["states_of_no_return"] = float(len(kept))
    names = ", ".join(s.name for s in plant.state_signals)
    where = "; ".join(", ".join(f"{v:.4g}" for v in state) for state in kept)
    note = "Beyond the set point's range the plant has a state from which the law does not return"
    return Analysis(figures, arrays, (f"{note}: ({names}) = {where}.",) if kept else ())


# -------------------------------------------------------------------------------------------- PIDs at operating points
Blending = Literal["gains", "outputs", "velocity"]


@dataclass(frozen=True, slots=True)
class LocalPid:
    """Gains of one local controller, kp e + ki int(e) dt - kd dy/dt; kp may be 0 where ki is not."""

    kp: float  # [mv/pv]
    ki: float  # [mv/(pv s)]
    kd: float = 0.0  # [mv s/pv]


@dataclass(frozen=True, slots=True)
class BlendedParams:
    """Settings of any local controller network, however its local controllers are tuned.

    ``blending``: what is blended (``gains``, ``outputs`` or ``velocity``, see LocalControllers).
    ``derivative_limit`` is N of the derivative's filter, Tf = Td/N. ``stability`` says how the
    closed loop is examined. ``mv_rate`` [mv] is the largest change a sample, None unlimited.
    """

    blending: Blending = "gains"
    derivative_limit: float = 10.0
    stability: StabilityTest = field(default_factory=StabilityTest)
    mv_rate: float | None = None

    def __post_init__(self) -> None:
        if not self.derivative_limit > 0:
            raise ValueError(f"derivative_limit is {self.derivative_limit}; give N above 0, as 10")


class LocalControllers(ControlLaw):
    """PIDs for m operating points of one loop, blended by the validity functions of their models.

    With rho_i(y) the weights, e = r - y, h the period, and Kp, Ki, Kd, a their blended numbers
    sum_i rho_i(y) (.)_i, the three forms are

        gains      mv = Kp e + I - Kd v,                                     I += h Ki e
        outputs    mv = sum_i rho_i(y) [ u_i + Kp_i e + Ki_i J - Kd_i v ],   J += h e
        velocity   mv(k) = mv(k-1) + Kp (e(k) - e(k-1)) + h Ki e(k) - Kd (v(k) - v(k-1))

    v is the filtered slope of the measurement, v(k) = a v(k-1) + (1 - a) (y(k) - y(k-1))/h with
    a_i = Tf_i/(Tf_i + h) and Tf_i = Td_i/N. The forms differ in what happens while rho moves: with
    blended gains the integral stands in units of the MV, so at e = 0 nothing bumps; blended outputs
    weigh the one integral J, and the local biases u_i, anew with every move of rho; the velocity
    form has no memory of where it should be.

    Anti-windup: the integral keeps its value while the limited MV lies behind the request in the
    direction of the error. A cold start, and an actuator that someone else moved, set the integral
    to where the MV is, less the proportional part, so that taking over does not bump. Where the
    actuator stood still, a set point that moves to the process variable does not take back the
    proportional part that the actuator never received (``never_given``).

    Source: [gao2002, section III] (blended outputs, in words); blending the
    gains around one integrator is not in the paper.
    """

    velocity_form = True
    parts: ClassVar[Mapping[str, str]] = {"local_models": "kind local_models"}

    table: Tensor  # (m, 5): Kp_i, h Ki_i, Kd_i/h, a_i, u_i
    period: Tensor  # (1,) [s]
    near: Tensor  # [mv] an actuator this close to the limited request has followed it

    def __init__(
        self,
        signals: Signals,
        models: LocalModels,
        pids: Sequence[LocalPid],
        *,
        blending: Blending = "gains",
        derivative_limit: float = 10.0,
        stability: StabilityTest | None = None,
        mv_rate: float | None = None,
    ) -> None:
        super().__init__(signals, mv_rate)
        require_single_loop(signals, self.name)
        if len(pids) != models.n_models:
            raise LawError(
                f"law {self.name!r} got {len(pids)} local controllers for {models.n_models} local models; one each"
            )
        if blending not in ("gains", "outputs", "velocity"):
            raise LawError(f"law {self.name!r}: blending is {blending!r}; allowed are gains, outputs, velocity")
        h = signals.period_s
        rows = []
        for pid, bias in zip(pids, models.mv[:, 0].tolist(), strict=True):
            filter_s = pid.kd / pid.kp / derivative_limit if pid.kp else 0.0
            rows.append([pid.kp, h * pid.ki, pid.kd / h, filter_s / (filter_s + h), bias])
        hold_numbers(self, table=rows)
        self.register_buffer("near", 1e-3 * (self.high - self.low))
        hold_numbers(self, period=h)
        self.validity = models.validity()
        self.blending, self.pids = blending, tuple(pids)
        self.stability = stability or StabilityTest()
        self.points = tuple(float(v) for v in models.x[:, 0])  # [CV]
        # started, I or J/h, the proportional part before, y(k-1), v(k-1), the last MV given, mv_applied(k-1), r(k-1)
        self.n_state = 8
        self.info = ("kc", "tau_i_s", "tau_d_s", "mv_requested")

    @classmethod
    def blended(cls, params: BlendedParams, signals: Signals, models: LocalModels, pids: Sequence[LocalPid]) -> Self:
        """The law with these local controllers, the rest as ``params`` says; raises LawError."""
        given = models.n_x if params.stability.low is None else len(params.stability.low)
        if params.stability.starts and given != models.n_x:
            raise LawError(
                f"law {cls.name!r}: stability.low and stability.high have {given} numbers; the plant has "
                f"{models.n_x} states, give one of each for every state"
            )
        return cls(
            signals,
            models,
            pids,
            blending=params.blending,
            derivative_limit=params.derivative_limit,
            stability=params.stability,
            mv_rate=params.mv_rate,
        )

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        y = pv[..., :1]
        error = sp - y
        blended = self.validity(y) @ self.table
        kp, ki, kd, keep, bias = (blended[..., i : i + 1] for i in range(5))
        proportional = kp * error + bias if self.blending == "outputs" else kp * error
        nothing = torch.zeros_like(y)
        # The velocity form remembers e(k-1) where the others remember their proportional part.
        beside = error if self.blending == "velocity" else proportional
        # What one unit of the integral is in the MV's.
        unit = ki if self.blending == "outputs" else torch.ones_like(y)
        fresh = torch.cat([(mv_applied - beside) / unit, beside, y, nothing, mv_applied, mv_applied, sp], dim=-1)
        # Without a past the whole state is zero.
        past = state[..., 1:] + (1 - state[..., :1]) * fresh
        integral, beside1, y1, slope1, given, applied1, r1 = (past[..., i : i + 1] for i in range(7))
        followed = (mv_applied - given).abs() <= self.near
        # A derivative from the time when somebody else held the actuator would still fade in the MV.
        slope1 = torch.where(followed, slope1, nothing)
        still = stood_still(mv_applied, applied1, given, self.near)
        start = mv_applied + torch.where(still, kp * never_given(sp - r1, r1 - y1), nothing)
        slope = keep * slope1 + (1 - keep) * (y - y1)
        if self.blending == "velocity":
            requested = start + kp * (error - beside1) + ki * error - kd * (slope - slope1)
            mv = self.limited(requested, mv_applied)
            kept = nothing
        else:
            integral = torch.where(followed, integral, (start - beside1) / unit)
            grown = integral + ki / unit * error
            requested = proportional - kd * slope + unit * grown
            mv = self.limited(requested, mv_applied)
            kept = torch.where((requested - mv) * error > 0, integral, grown)
        info = torch.cat([kp, kp / ki * self.period, kd / kp * self.period, requested], dim=-1)
        return mv, torch.cat([torch.ones_like(y), kept, beside, y, slope, mv, mv_applied, sp], dim=-1), info

    def analysis(self, plant: Simulator | None) -> Analysis:
        """The stability of the loop along the operating points and from many starts, as ``stability`` asks for it."""
        return stability_analysis(
            self, equations(plant, f"the analysis of law {self.name!r}"), self.points, self.stability
        )
