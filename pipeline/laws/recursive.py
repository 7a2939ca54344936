"""PIDs that adapt by a recursive linear model: gains by its gradient, and a self-tuning design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError, ModelError
from loopwright.pipeline.laws.adaptive import AdaptiveParams, AdaptivePid, move, signed_unit, target
from loopwright.pipeline.laws.base import (
    ControlLaw,
    OfRange,
    Stepped,
    hold_numbers,
    in_units,
    require_kind,
    require_single_loop,
)
from loopwright.pipeline.laws.gain_update import PidForm
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.lagged.lagged import ARX
from loopwright.pipeline.models.lagged.recursive_arx import RecursiveArx, RecursiveLeastSquares
from loopwright.pipeline.models.memory import Memory, Slot
from loopwright.pipeline.plants.simulator import Signals, Simulator


def require_arx(models: Mapping[str, Model], law: str) -> ARX:
    """Part ``arx`` of a model set; raises LawError that says what the law needs and what the set has."""
    model = require_kind(models, ARX, law)
    if model.n_mv != 1 or model.delay != 1:
        raise LawError(
            f"law {law!r} needs a part 'arx' (kind arx, one MV, delay 1); "
            f"the model set's has {model.n_mv} MVs and delay {model.delay}"
        )
    return model


def estimator(
    law: str, signals: Signals, model: ARX, unit: float, params: Any, prefilter: Sequence[float] = (), lags: int = 0
) -> RecursiveArx:
    """The model as a law learns it on, of at least ``lags`` of y, with ``unit`` [mv] from ``signed_unit``.

    Raises LawError for wrong numbers.
    """
    try:
        rls = RecursiveLeastSquares(params.forgetting, params.covariance)
    except ModelError as error:
        raise LawError(f"law {law!r}: {error}") from error
    return RecursiveArx(model, signals.sp[0], signals.mv[0], unit, rls, prefilter, max(lags, model.n_y))


class RecursivePid(AdaptivePid):
    """PID whose gains give, within bounds, the minimum-variance move of a recursively estimated ARX model.

        min_du  (r - y0 - b du)^2 + mu du^2   ->   v = b (r - y0)/c,   c = b^2 + mu
        y0 = theta' x(t+1) with u(t) = u(t-1), plus d;   d = (1 - alpha) d1 + alpha (y - theta' x(t))

    Recursive least squares with forgetting updates theta at this sample; part ``arx`` gives the
    first estimate. Parameters and covariance are in the state. The estimate follows recent data
    only, whereas ``linearized_pid`` has a model of the plant at the present operating point.

    Source: REC-LINPID of [chen2004, section 5], with eqs 16-28 as its control law.
    """

    name: ClassVar[str] = "recursive_pid"
    title: ClassVar[str] = "PID from a recursive linear model"
    parts: ClassVar[Mapping[str, str]] = {"arx": "kind arx"}

    @dataclass(frozen=True, slots=True)
    class Params(AdaptiveParams):
        """The settings of AdaptiveParams, and those of the estimator.

        ``forgetting``: in (0, 1]. ``covariance``: its first and largest value, for scaled parameters
        and signals. ``offset_filter``: alpha in [0, 1]; 0 means no offset d.
        """

        forgetting: float = 0.98
        covariance: float = 1.0
        offset_filter: float = 1.0

        def __post_init__(self) -> None:
            AdaptiveParams.__post_init__(self)
            if not 0 <= self.offset_filter <= 1:
                raise ValueError(f"offset_filter is {self.offset_filter}; it must lie in [0, 1]")

    params: Params
    penalty: Tensor  # (1,)
    alpha: Tensor  # (1,) [pv]

    def __init__(self, signals: Signals, model: ARX, params: Params) -> None:
        def model_for(unit: float) -> RecursiveArx:
            return estimator(self.name, signals, model, unit, params)

        more = {"offset": Slot(1, torch.zeros(1, dtype=torch.float64))}
        slopes = model.weight[: model.n_y], float(model.weight[model.n_y])
        super().__init__(signals, params, -slopes[0], slopes[1], model_for, more, ("offset",))
        hold_numbers(self, penalty=self.params.penalty, alpha=self.model.half_y * params.offset_filter)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law with part ``arx`` as its first estimate; raises LawError."""
        return cls(signals, require_arx(models, cls.name), params)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.memory.recall(sp, pv, mv_applied, state)
        # What this sample teaches, and how far the model was off it.
        sample = self.model.sample(p)
        estimate = self.model(p, sample)
        missed = sample.psi - self.model.output(sample.x, estimate.theta)
        offset = (1 - self.params.offset_filter) * p["offset"] + self.alpha * missed
        # The forecast without a move, and the move that brings it to the set point.
        y = self.model.middle_y + self.model.pv_unit * self.model.output(sample.x_ahead, estimate.theta) + offset
        slope = estimate.slope
        c = slope * slope + self.penalty
        best = slope * (target(p, self.params.preview) - y) / c
        # The gains that come nearest to it, if they are free to change.
        rho = self.gains.errors(p)
        free, loud = self.gains.free(p, slope)
        z, changed = self.gains.settled(p, self.gains.update(p, rho, best, c, free), free)
        mv = self.limited(p["u"] + move(rho, z) * self.gains.unit, p["u"])
        kept = {**estimate.kept, **loud, **changed, "offset": offset}
        return mv, self.memory.stored(p, kept), torch.cat([self.gains.info_of(z, slope, free), offset], dim=-1)


PREFILTER_TERMS = 3  # of F: more would be no PID


class SelfTuningPid(ControlLaw):
    """Implicit self-tuning control of generalized minimum variance, with the structure of a PID.

        P(z) y(t+1) = F(z) y(t) + G(z) u(t) + c,   P = 1 + p_1/z + p_2/z^2 + ..,   F = f_0 + f_1/z + f_2/z^2

    is the predictor of the prefiltered output, whose F and G recursive least squares estimates
    straight from the data. Minimum variance of P y(t+1) + Q u(t) - F(1) r(t), with the weight
    Q = (1 - 1/z)/nu - G, in which the predictor's G drops out, and with c left to the integral, is

        u(t) - u(t-1) = nu (F(1) r - F y)
                      = Ki (r - y) - kc (y - y1) - Kd (y - 2 y1 + y2)
        Ki = nu (f_0 + f_1 + f_2),   kc = -nu (f_1 + 2 f_2),   Kd = nu f_2

    a PID whose set point acts through the integral alone. F = z (P - A) for a plant A y = B u: the
    estimate moves the gains with the plant's dynamics, but not with its gain, which the integral
    action constant nu has to suit. Gains are held within bounds, and kept as they are where the
    estimated slope over the MV does not tell the way. The move is added to the applied MV.

    Source: Cameron and Seborg, A self-tuning controller with a PID structure, Int. J. Control 38
    (1983), 401; named as STPID in [chen2004, section 5.1], without its equations.
    """

    name: ClassVar[str] = "self_tuning_pid"
    title: ClassVar[str] = "Self-tuning PID"
    parts: ClassVar[Mapping[str, str]] = {"arx": "kind arx"}
    velocity_form: ClassVar[bool] = True
    looks_ahead: ClassVar[int | None] = 1

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params:
        """Numbers of the law; MVs count in units of half the MV's range, PVs in their own.

        Defaults in the PV's unit are shares of the range of its set point, see ``OfRange``.

        ``prefilter``: p_1, p_2, p_3 of P, fewer are followed by zeros; ``integral``: the integral action
        constant nu > 0 [1/pv]. ``forgetting`` in (0, 1] and ``covariance``, the first and largest one of
        parameters and signals scaled to the order of one, are the estimator's. ``gain_high``: upper bounds of
        kc, Ki = kc dt/tau_i and Kd = kc tau_d/dt [1/pv]; the lower are 0. ``plant_gain``: sign of dPV/dMV,
        ``auto`` takes that of part ``arx``. The estimate is acted on where its slope, in that sign, is above
        ``slope_min`` [pv]. ``mv_rate``: largest change of the MV a sample [mv]; None is unlimited.
        """

        prefilter: tuple[float, ...]
        integral: float
        forgetting: float
        covariance: float
        gain_high: tuple[float, float, float] = (OfRange(100.0, -1), OfRange(100.0, -1), OfRange(100.0, -1))
        plant_gain: Literal["auto", "positive", "negative"] = "auto"
        slope_min: float = OfRange(1e-4)
        mv_rate: float | None = None

        def __post_init__(self) -> None:
            if len(self.prefilter) > PREFILTER_TERMS:
                raise ValueError(
                    f"prefilter has {len(self.prefilter)} coefficients; a PID has room for {PREFILTER_TERMS}"
                )
            if not self.integral > 0:
                raise ValueError(f"integral is {self.integral}; it must be above 0")
            if not self.slope_min >= 0:
                raise ValueError(f"slope_min is {self.slope_min}; it must be 0 or above")
            if not min(self.gain_high) > 0:
                raise ValueError(f"gain_high is {list(self.gain_high)}; each must be above 0")

    unit: Tensor  # (1,) [mv]
    to_gains: Tensor  # (n, 3): theta -> kc, Ki, Kd
    slope_min: Tensor  # (1,)
    hi: Tensor  # (3,)
    by_unit: Tensor  # (1,) 1/unit

    def __init__(self, signals: Signals, model: ARX, params: Params) -> None:
        super().__init__(signals, params.mv_rate)
        require_single_loop(signals, self.name)
        params = in_units(params, signals, self.name)
        unit = signed_unit(signals, params.plant_gain, float(model.weight[model.n_y]))
        self.model = estimator(self.name, signals, model, unit, params, params.prefilter, PREFILTER_TERMS)
        n, nu = self.model.size, params.integral
        self.form = PidForm(signals.period_s, unit, params.gain_high)
        of_f = [[0.0, nu, 0.0], [-nu, nu, 0.0], [-2 * nu, nu, nu]]
        hold_numbers(
            self,
            unit=unit,
            to_gains=of_f + [[0.0] * 3] * (n - PREFILTER_TERMS),
            slope_min=params.slope_min,
            hi=params.gain_high,
            by_unit=1 / unit,
        )
        start = self._limited_gains(self.model.first)
        self.memory = Memory({**self.model.slots, "gains": Slot(3, start)})
        self.n_state = self.memory.n_state
        self.info = ("kc", "tau_i_s", "tau_d_s", "b1", "updated")

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law with part ``arx`` as its first estimate; raises LawError."""
        return cls(signals, require_arx(models, cls.name), params)

    def _limited_gains(self, theta: Tensor) -> Tensor:
        return torch.minimum(torch.relu(theta @ self.to_gains), self.hi)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.memory.recall(sp, pv, mv_applied, state)
        estimate = self.model(p, self.model.sample(p))
        slope = estimate.slope
        clear = slope > self.slope_min
        z = torch.where(clear, self._limited_gains(estimate.theta), p["gains"])
        y, y1, y2 = p["y"], p["y1"], p["ys"][..., :1]
        rho = torch.cat([y1 - y, p["r"] - y, 2 * y1 - y - y2], dim=-1)
        mv = self.limited(p["u"] + (rho * z).sum(dim=-1, keepdim=True) * self.unit, p["u"])
        info = torch.cat([self.form(z), slope * self.by_unit, clear.to(z.dtype)], dim=-1)
        return mv, self.memory.stored(p, {**estimate.kept, "gains": z}), info
