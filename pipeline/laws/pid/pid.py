"""The PID controller, the baseline of the other laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Protocol, Self, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import LawError
from pipeline.laws.base import Analysis, ControlLaw, Stepped, require_single_loop
from pipeline.laws.stuck_actuator import never_given, stood_still
from pipeline.models.base import Model
from pipeline.plants.equations import EquationPlant, equations
from pipeline.plants.linearization import Linearization
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array, Simulator
from pipeline.tuning import rules as tuning
from pipeline.tuning.development import DevelopmentLoops
from pipeline.tuning.reduction import LagWithDeadTime, start_lag
from pipeline.tuning.rules import AllPole, PidSettings
from pipeline.tuning.stability import FrozenLoops, spectral_radius

EXAMINED = 40  # linear closed loops over a range of the CV


@runtime_checkable
class HoldsLinearization(Protocol):
    """A model that is a plant linearized at a steady state."""

    def linearization(self) -> Linearization:
        """The linearization, per second."""


class PID(ControlLaw):
    """Velocity-form PID for one loop, derivative on the measurement.

        mv(k) = mv(k-1) + Kc [ p(k) - p(k-1) + (h/Ti) (r - y) - (d(k) - d(k-1)) ],   p = b r - y
        d(k)  = (Tf d(k-1) + Td (y(k) - y(k-1))) / (Tf + h)
        mv(k-1) = mv_applied + (1 - h/Tt) (last request - last limited request)

    d is the filtered derivative, h the period. The law adds its move to the MV that the actuator
    holds. This is the anti-windup, and makes the transfer from manual to auto bumpless. The law keeps
    the part of a request beyond its limits; this part decays with the tracking time Tt. Without it
    (Tt = h, the plain velocity form) one saturated sample erases the proportional and derivative
    kicks, and their end then moves the MV in the wrong direction. If the actuator did not follow the
    limited request (manual, stuck), the law starts from the applied MV alone. If the actuator did not
    move and the set point then returns to the process variable, the law does not subtract a
    proportional action that the actuator never received (``never_given``).

    Source: the PID that [inverse_rbf, section 4.3] compares with; the tracking
    is that of Astrom and Hagglund, Advanced PID Control, section 3.5.
    """

    name: ClassVar[str] = "pid"
    title: ClassVar[str] = "PID"
    incremental: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True)
    class Params:
        """The tuning of the PID.

        ``tuning``: ``optimized`` chooses the IMC filter and the set-point weight in closed loop, by the
        ``criterion``, ``mae`` (mean absolute error) or ``itae`` (time-weighted); ``imc`` and ``simc`` use
        ``lambda_s`` [s] (None: a robust value); ``itae`` is the minimum-ITAE rule for a set-point step;
        ``manual`` uses ``kc`` [mv/pv], ``ti_s`` [s], ``td_s`` [s] and the derivative filter ``filter_s`` [s].
        ``tracking_s`` [s]: tracking time; None is sqrt(Ti Td). ``set_point_weight``: None is 1, or
        optimized with the filter. ``operating_cv`` [pv]: steady state of the linearization if the model
        set has no part ``linearized``; None is the middle of the set-point range.
        ``development_seeds``, ``development_set_points``, ``development_hold``: random set points for
        ``optimized``; each seed gives so many, each held for so many samples. ``sampling``: share of a
        period that ``itae`` counts as dead time; 0.5 is the textbook value, 1 is more cautious.
        ``examined_cv`` [pv]: range of the stability analysis; None: no analysis. ``mv_rate`` [mv]:
        largest MV change per sample; None: unlimited.
        """

        tuning: Literal["optimized", "imc", "simc", "itae", "manual"] = "optimized"
        criterion: Literal["mae", "itae"] = "mae"
        kc: float | None = None
        ti_s: float | None = None
        td_s: float = 0.0
        filter_s: float = 0.0
        tracking_s: float | None = None
        set_point_weight: float | None = None
        lambda_s: float | None = None
        operating_cv: float | None = None
        development_seeds: tuple[int, ...] = (1, 2, 3)
        development_set_points: int = 12
        development_hold: int = 100
        sampling: float = 0.5
        examined_cv: tuple[float, float] | None = None
        mv_rate: float | None = None

        def __post_init__(self) -> None:
            self.given()

        def given(self) -> PidSettings:
            """The settings that stand here, 1 for those that a tuning finds; raises LawError for wrong numbers."""
            kc, ti_s, weight = (1.0 if v is None else v for v in (self.kc, self.ti_s, self.set_point_weight))
            return PidSettings(kc, ti_s, self.td_s, self.filter_s, weight, self.tracking_s)

    kc: Tensor  # (..., 1)
    integral: Tensor  # h/Ti
    keep: Tensor  # Tf/(Tf + h)
    derivative: Tensor  # Td/(Tf + h)
    weight: Tensor  # b
    fade: Tensor  # 1 - h/Tt
    near: Tensor  # [mv] an actuator this close to the limited request has followed it

    examined_cv: tuple[float, float] | None = None

    def __init__(
        self, signals: Signals, settings: PidSettings | Sequence[PidSettings], mv_rate: float | None = None
    ) -> None:
        super().__init__(signals, mv_rate)
        require_single_loop(signals, self.name)
        # Several settings are candidates in one module: they broadcast over a leading dimension.
        rows = [settings] if isinstance(settings, PidSettings) else list(settings)
        h = signals.period_s
        numbers = {
            "kc": [s.kc for s in rows],
            "integral": [h / s.ti_s for s in rows],
            "keep": [s.filter_s / (s.filter_s + h) for s in rows],
            "derivative": [s.td_s / (s.filter_s + h) for s in rows],
            "weight": [s.set_point_weight for s in rows],
            "fade": [max(0.0, 1 - h / s.tracking_time_s) for s in rows],
        }
        shape = (1,) if isinstance(settings, PidSettings) else (len(rows), 1, 1)
        for name, values in numbers.items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64).reshape(shape))
        self.register_buffer("near", 1e-3 * (self.high - self.low))
        self.settings = rows[0]
        self.n_state = 7  # started, p(k-1), y(k-1), d(k-1), the last request, the same limited, mv_applied(k-1)
        self.info = ("mv_requested",)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The PID tuned as ``params`` says, on part ``linearized`` or on the plant; raises LawError."""
        law = cls._tuned(params, models, signals, plant)
        law.examined_cv = params.examined_cv
        return law

    @classmethod
    def check(cls, params: Any, models: Mapping[str, Model], plant: Simulator) -> None:
        """Raise LawError where the tuning does not apply to the linearized plant; no closed loop is run."""
        require_single_loop(plant.signals, cls.name)
        if params.tuning == "optimized":
            AllPole.near(_linearization(params, models, plant))
        else:
            cls._tuned(params, models, plant.signals, plant)

    @classmethod
    def _tuned(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        require_single_loop(signals, cls.name)
        p, given = params, params.given()
        if p.tuning == "manual":
            if p.kc is None or p.ti_s is None:
                raise LawError("PID tuning `manual` needs kc and ti_s; give both or take optimized, imc, simc or itae")
            return cls(signals, given, p.mv_rate)
        lin = _linearization(params, models, plant)
        if p.tuning == "itae":
            settings = tuning.itae_pid(LagWithDeadTime.of(lin), signals.period_s, p.sampling)
        elif p.tuning == "simc":
            settings = tuning.simc_pid(AllPole.of(lin), signals.period_s, p.lambda_s)
        elif p.tuning == "imc" and p.lambda_s is not None:
            settings = tuning.imc_pid(AllPole.of(lin), p.lambda_s)
        elif p.tuning == "imc":
            settings = tuning.robust_imc(lin, signals.period_s)
        elif p.tuning == "optimized":
            if plant is None:
                raise LawError("PID tuning `optimized` needs a simulator; take manual, imc, simc or itae")
            drawn = (p.development_seeds, p.development_set_points, p.development_hold)
            plants = [DevelopmentLoops.draw(variation, *drawn) for variation in plant.variations()]
            free = p.set_point_weight is None

            def cost(rows: Sequence[PidSettings]) -> Array:
                law = cls(signals, rows, p.mv_rate)
                weighted = p.criterion == "itae"
                each = [loops.error(law, law.n_state, len(rows), time_weighted=weighted) for loops in plants]
                return np.asarray(np.mean(each, axis=0))

            settings = tuning.optimized_imc(AllPole.near(lin), signals.period_s, cost, given, optimize_weight=free)
            return cls(signals, settings, p.mv_rate)
        else:
            raise LawError(f"PID tuning is {p.tuning!r}; allowed are optimized, imc, simc, itae, manual")
        rest = {name: getattr(given, name) for name in ("filter_s", "tracking_s", "set_point_weight")}
        return cls(signals, replace(settings, **rest), p.mv_rate)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        y = pv[..., :1]
        p = self.weight * sp - y
        fresh = torch.cat([p, y, torch.zeros_like(p), mv_applied, mv_applied, mv_applied], dim=-1)
        past = torch.where(state[..., :1] > 0, state[..., 1:], fresh)
        p1, y1, d1, requested1, limited1, applied1 = (past[..., i : i + 1] for i in range(6))
        # An actuator that is not at the limited request was moved by something else: no part is unmet.
        followed = (mv_applied - limited1).abs() <= self.near
        unmet = torch.where(followed, requested1 - limited1, torch.zeros_like(requested1))
        d = self.keep * d1 + self.derivative * (y - y1)
        still = stood_still(mv_applied, applied1, limited1, self.near)
        # The state holds no set point; b (r - r1) and b (r1 - y1) follow from p.
        spared = never_given(p - p1 + (y - y1), p1 + (1 - self.weight) * y1)
        move = p - p1 + torch.where(still, spared, torch.zeros_like(p)) + self.integral * (sp - y) - (d - d1)
        requested = mv_applied + self.fade * unmet + self.kc * move
        mv = self.limited(requested, mv_applied)
        return mv, torch.cat([torch.ones_like(p), p, y, d, requested, mv, mv_applied], dim=-1), requested

    def analysis(self, plant: Simulator | None) -> Analysis:
        """Stability and gain margin of the linear closed loops over ``examined_cv``; empty if that is None."""
        if self.examined_cv is None:
            return Analysis()
        known = equations(plant, "law 'pid' with `examined_cv`")
        loops = FrozenLoops.of(known, self, self.n_state, np.linspace(*self.examined_cv, EXAMINED))
        radius = spectral_radius(loops.matrices())
        figures = {"frozen_radius": float(radius.max()), "gain_margin": loops.gain_margin()}
        return Analysis(figures, {"frozen_cv": loops.cv, "frozen_radius": radius})


def _linearization(params: Any, models: Mapping[str, Model], plant: Simulator | None) -> Linearization:
    """The linearization of the part ``linearized`` if there is one, else of the plant at ``operating_cv``.

    A plant without equations is approximated by one or two lags near its start.
    """
    if "linearized" in models:
        part = models["linearized"]
        if not isinstance(part, HoldsLinearization):
            raise LawError(f"law 'pid' needs a part 'linearized' that is a linearization; got one of kind {part.kind}")
        return part.linearization()
    if plant is not None and params.operating_cv is None and not isinstance(plant, EquationPlant):
        return start_lag(plant)
    known = equations(plant, f"PID tuning {params.tuning!r} without a part `linearized`")
    sp = known.sp_signals[0]
    cv = 0.5 * (sp.low + sp.high) if params.operating_cv is None else params.operating_cv
    return known.linearize(*known.steady_state_at(cv))
