"""Shared parts of the local controller networks: PIDs at operating points, blended by the plant's place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, Self

import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import Analysis, ControlLaw, Stepped, hold_numbers, require_single_loop
from loopwright.pipeline.laws.local.local_stability import StabilityTest, stability_analysis
from loopwright.pipeline.laws.stuck_actuator import never_given, stood_still
from loopwright.pipeline.models.local.local_models import LocalModels
from loopwright.pipeline.plants.equations import equations
from loopwright.pipeline.plants.signals import Signals
from loopwright.pipeline.plants.simulator import Simulator

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

    incremental = True
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
