"""PIDs that adapt by a network of the plant: along its linearization, and by Gauss-Newton steps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError, ModelError
from loopwright.pipeline.laws.adaptive import AdaptiveParams, AdaptivePid, move, signed_unit, target, target_slots
from loopwright.pipeline.laws.base import (
    ControlLaw,
    OfRange,
    Stepped,
    ascend,
    hold_numbers,
    in_units,
    require_kind,
    require_single_loop,
)
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.lagged.instantaneous import Ahead, Arx, GaussNewton, NextOutput, arx
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.memory import Memory, Named, Slot
from loopwright.pipeline.plants.simulator import Signals, Simulator


def require_share(name: str, value: float) -> None:
    """ValueError unless a parameter of ``NextOutput`` lies in (0, 1]."""
    if not 0 < value <= 1:
        raise ValueError(f"{name} is {value}; it must lie in (0, 1], 1 to believe every sample")


def central_model(model: NNARX) -> Arx:
    """The linear model at the centre of the training data."""
    return arx(model, model.net.x_center)


def next_output(law: str, model: NNARX, unit: float, offset_filter: float, trust: float = 1.0) -> NextOutput:
    """The predictor of a law; raises LawError for a model whose newest MV does not act at once."""
    try:
        return NextOutput(model, unit, offset_filter, trust)
    except ModelError as error:
        raise LawError(f"law {law!r}: {error}") from error


class NnarxPid(AdaptivePid):
    """A PID law over part ``nnarx``.

    ``params`` are those of an adaptive PID with ``offset_filter`` and ``trust``; ``more`` slots of the law's own,
    ``info`` the names of its own info.
    """

    parts: ClassVar[Mapping[str, str]] = {"nnarx": "kind nnarx"}
    params: AdaptiveParams

    def __init__(
        self,
        signals: Signals,
        model: NNARX,
        params: Any,
        more: Mapping[str, Slot] | None = None,
        info: tuple[str, ...] = (),
    ) -> None:
        def predictor(unit: float) -> NextOutput:
            return next_output(self.name, model, unit, params.offset_filter, params.trust)

        centre = central_model(model)
        super().__init__(signals, params, centre.a, float(centre.b[0]), predictor, more or {}, ("offset", *info))

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over part ``nnarx``; raises LawError."""
        return cls(signals, require_kind(models, NNARX, cls.name), params)

    def commanded(self, p: Named, move: Tensor) -> tuple[Tensor, Tensor]:
        """The MV (..., 1) after a move in units, within its limits, and the move that they leave, in units."""
        mv = self.limited(p["u"] + move * self.gains.unit, p["u"])
        return mv, (mv - p["u"]) * self.gains.by_unit

    def linearization_error(self, ahead: Ahead, move: Tensor) -> Tensor:
        """|NN - linear| of y(t+1), (..., 1), at a move in units."""
        y, _ = self.model.moved(ahead, move)
        return (y - ahead.y - ahead.slope * move).abs()


PENALTY_DOUBLINGS = 12  # most doublings of the penalty within a sample: candidates of 1 to 2^12 times


class LinearizedPid(NnarxPid):
    """PID whose gains give, within bounds, the minimum-variance move of the linearized network.

        min_du  (r - y0 - b du)^2 + mu du^2   ->   v = b (r - y0)/c,   c = b^2 + mu

    y0 is the network's y(t+1) without a move, offset included, b its slope over the move. With
    ``adaptive`` the penalty is doubled within the sample until the network agrees with its
    linearization at the move, |NN - linear| <= eps_high (at most 12 times), and halved once for the
    next sample, down to ``penalty_low``, where it agrees to eps_low already. All doublings are
    computed at once, as candidates, so that a step costs the same whatever it finds.

    Source: [chen2004, eqs 16-29 and section 4]; see ``NextOutput``,
    ``AdaptiveGains`` and ``gain_update`` for where this departs from it and why.
    """

    name: ClassVar[str] = "linearized_pid"
    title: ClassVar[str] = "PID from the linearized NNARX"

    @dataclass(frozen=True, slots=True)
    class Params(AdaptiveParams):
        """Parameters of AdaptiveParams, and the penalty that ``adaptive`` puts in the place of ``penalty``.

        ``offset_filter`` alpha and ``trust``, both in (0, 1], as in ``NextOutput``; 1 is as the paper.
        ``penalty_start`` and ``penalty_low`` [pv^2]: its first and its least value, None as ``penalty``;
        ``eps_high`` and ``eps_low`` [pv]: linearization errors above which it doubles and below which it
        halves; ``adaptive`` needs an ``eps_high`` above 0.
        """

        offset_filter: float = 1.0
        trust: float = 1.0
        adaptive: bool = False
        penalty_start: float | None = None
        penalty_low: float | None = None
        eps_high: float = 0.0
        eps_low: float = 0.0

        def __post_init__(self) -> None:
            AdaptiveParams.__post_init__(self)
            require_share("offset_filter", self.offset_filter)
            require_share("trust", self.trust)
            start, low = self.penalties
            if not (low > 0 and (low == start or ascend(low, start))):
                raise ValueError(f"penalty_low is {low} and penalty_start {start}; give 0 < low <= start")
            if not (0 <= self.eps_low < self.eps_high or (self.eps_low == self.eps_high == 0 and not self.adaptive)):
                raise ValueError(f"eps_low is {self.eps_low} and eps_high {self.eps_high}; give 0 <= low < high")

        @property
        def penalties(self) -> tuple[float, float]:
            """The first and the least penalty."""
            start = self.penalty if self.penalty_start is None else self.penalty_start
            return start, self.penalty if self.penalty_low is None else self.penalty_low

    params: Params
    penalty: Tensor  # (1,) fixed
    doubled: Tensor  # (PENALTY_DOUBLINGS + 1, 1) 1, 2, 4, ..
    allowed: Tensor  # (PENALTY_DOUBLINGS + 1, 1) linearization error of each; the last candidate has no choice
    penalty_low: Tensor  # (1,)
    eps_low: Tensor  # (1,)
    none: Tensor  # (1,) larger than any penalty

    def __init__(self, signals: Signals, model: NNARX, params: Params) -> None:
        params = in_units(params, signals, self.name)
        start, low = params.penalties
        more = {"penalty": Slot(1, torch.tensor([start], dtype=torch.float64))} if params.adaptive else {}
        super().__init__(signals, model, params, more, ("linearization_error", *more))
        self.adaptive = params.adaptive
        hold_numbers(
            self,
            penalty=params.penalty,
            doubled=[[2.0**j] for j in range(PENALTY_DOUBLINGS + 1)],
            penalty_low=low,
            allowed=[[params.eps_high]] * PENALTY_DOUBLINGS + [[math.inf]],
            eps_low=params.eps_low,
            none=math.inf,
        )

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.memory.recall(sp, pv, mv_applied, state)
        if self.adaptive:
            p = {name: value.unsqueeze(-2) for name, value in p.items()}  # candidates are rows
        ahead, rho = self.model(p), self.gains.errors(p)
        gap = target(p, self.params.preview) - ahead.y
        free, loud = self.gains.free(p, ahead.slope)
        if self.adaptive:
            z, error, penalty, following = self._searched(p, rho, ahead, gap, free)
        else:
            z = self._gains(p, rho, ahead.slope, gap, self.penalty, free)
        z, changed = self.gains.settled(p, z, free)
        mv, moved = self.commanded(p, move(rho, z))
        shown = [self.gains.info_of(z, ahead.slope, free), ahead.offset]
        given = {**ahead.kept, **loud, **changed}
        if self.adaptive:
            shown, given = [*shown, error, penalty], {**given, "penalty": following}
        else:
            shown.append(self.linearization_error(ahead, moved))
        state_next, info = self.memory.stored(p, given), torch.cat(shown, dim=-1)
        if self.adaptive:
            return mv.squeeze(-2), state_next.squeeze(-2), info.squeeze(-2)
        return mv, state_next, info

    def _gains(self, p: Named, rho: Tensor, slope: Tensor, gap: Tensor, penalty: Tensor, free: Tensor) -> Tensor:
        """Gains (..., 3) for a penalty (..., 1)."""
        c = slope * slope + penalty
        return self.gains.update(p, rho, slope * gap / c, c, free)

    def _searched(
        self, p: Named, rho: Tensor, ahead: Ahead, gap: Tensor, free: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gains, linearization error and penalty of the first candidate that agrees, and the next sample's penalty."""
        penalties = p["penalty"] * self.doubled
        z = self._gains(p, rho, ahead.slope, gap, penalties, free)
        error = self.linearization_error(ahead, move(rho, z))
        penalty = torch.where(error <= self.allowed, penalties, self.none).amin(dim=-2, keepdim=True)
        first, nothing = penalties == penalty, torch.zeros_like(penalty)
        z, error = (torch.where(first, t, nothing).sum(dim=-2, keepdim=True) for t in (z, error))
        penalty = torch.where(free > 0, penalty, p["penalty"])
        easy = (free > 0) & (error < self.eps_low)
        following = torch.where(easy, torch.maximum(0.5 * penalty, self.penalty_low), penalty)
        return z, error, penalty, following


def room(law: ControlLaw, u: Tensor, unit: Tensor, *, turned: bool) -> tuple[Tensor, Tensor]:
    """The least and the largest move from u that the actuator can make, in units; ``turned``: the unit is negative."""
    to_low, to_high = (law.low - u) / unit, (law.high - u) / unit
    return (to_high, to_low) if turned else (to_low, to_high)


class GaussNewtonPid(NnarxPid):
    """PID whose gains give, within bounds, the minimum-variance move of the network itself.

        min_du  (r - y(t+1))^2 + mu du^2,   y(t+1) by the network

    solved by a few Gauss-Newton steps, each a linearization at the move so far, and limited to what
    the actuator can do; the gains are then updated towards that move. Where a single linearization
    needs a large penalty not to overshoot a curved plant, this needs next to none.

    Source: not in [chen2004], which linearizes once and adapts the penalty instead
    (eqs 16-29).
    """

    name: ClassVar[str] = "gauss_newton_pid"
    title: ClassVar[str] = "PID from the NNARX, relinearized within the sample"

    @dataclass(frozen=True, slots=True)
    class Params(AdaptiveParams):
        """Parameters of AdaptiveParams; ``relinearize`` is the number of linearizations, 1 or more.

        ``offset_filter`` alpha and ``trust``, both in (0, 1], as in ``NextOutput``; 1 is as the paper.
        """

        offset_filter: float = 1.0
        trust: float = 1.0
        relinearize: int = 5

        def __post_init__(self) -> None:
            AdaptiveParams.__post_init__(self)
            require_share("offset_filter", self.offset_filter)
            require_share("trust", self.trust)
            if self.relinearize < 1:
                raise ValueError(f"relinearize is {self.relinearize}; give 1 or more linearizations a sample")

    def __init__(self, signals: Signals, model: NNARX, params: Params) -> None:
        super().__init__(signals, model, params, info=("linearization_error",))
        self.search = GaussNewton(self.model, params.relinearize, self.params.penalty, self.params.slope_min)
        self.turned = bool(self.gains.unit < 0)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.memory.recall(sp, pv, mv_applied, state)
        # The network's forecast without a move, and the move that would be best.
        ahead = self.model(p)
        down, up = room(self, p["u"], self.gains.unit, turned=self.turned)
        best, curvature = self.search(ahead, target(p, self.params.preview), down, up)
        # The gains that come nearest to it, if they are free to change.
        rho = self.gains.errors(p)
        free, loud = self.gains.free(p, ahead.slope)
        z, changed = self.gains.settled(p, self.gains.update(p, rho, best, curvature, free), free)
        # The PID's own move, within the limits.
        mv, moved = self.commanded(p, move(rho, z))
        info = [self.gains.info_of(z, ahead.slope, free), ahead.offset, self.linearization_error(ahead, moved)]
        return mv, self.memory.stored(p, {**ahead.kept, **loud, **changed}), torch.cat(info, dim=-1)


class MinimumVariance(ControlLaw):
    """One-step-ahead control by an NNARX, free of offset.

        min_du  (r - y(t+1))^2 + mu du^2,   y(t+1) = NN(phi(t+1)) + d(t),   mv(t) = mv(t-1) + du

    by Gauss-Newton steps within the actuator's range; one of them is the minimum-variance law of
    the linearized network. Beside ``GaussNewtonPid`` it shows what the PID's structure costs.

    Source: [chen2004, eqs 16 and 17], without the PID form of du.
    """

    name: ClassVar[str] = "minimum_variance"
    title: ClassVar[str] = "Minimum variance by the NNARX, no PID"
    parts: ClassVar[Mapping[str, str]] = {"nnarx": "kind nnarx"}
    velocity_form: ClassVar[bool] = True
    looks_ahead: ClassVar[int | None] = 1

    @dataclass(frozen=True, slots=True)
    class Params:
        """Numbers of the law; the MV counts in units of half its range. Defaults in pv are shares of its range.

        ``penalty`` mu > 0 of the move [pv^2]; ``relinearize`` the linearizations a sample, 1 or more;
        ``preview`` of r(t+1) and ``plant_gain`` as in AdaptiveParams; ``slope_min`` [pv] a slope
        below which this one is taken; ``offset_filter`` alpha in (0, 1] as in NextOutput;
        ``mv_rate`` [mv] the largest change a sample, None unlimited.
        """

        penalty: float = OfRange(1e-3, 2)
        relinearize: int = 5
        preview: Literal["held", "ramp"] = "held"
        plant_gain: Literal["auto", "positive", "negative"] = "auto"
        slope_min: float = OfRange(1e-4)
        offset_filter: float = 1.0
        mv_rate: float | None = None

        def __post_init__(self) -> None:
            if not self.penalty > 0:
                raise ValueError(f"penalty is {self.penalty}; it must be above 0")
            if self.relinearize < 1:
                raise ValueError(f"relinearize is {self.relinearize}; give 1 or more linearizations a sample")
            require_share("offset_filter", self.offset_filter)

    unit: Tensor  # (1,) [mv]

    def __init__(self, signals: Signals, model: NNARX, params: Params) -> None:
        super().__init__(signals, params.mv_rate)
        require_single_loop(signals, self.name)
        params = in_units(params, signals, self.name)
        unit = signed_unit(signals, params.plant_gain, float(central_model(model).b[0]))
        self.model = next_output(self.name, model, unit, params.offset_filter)
        self.search = GaussNewton(self.model, params.relinearize, params.penalty, params.slope_min)
        hold_numbers(self, unit=unit, by_unit=1 / unit)
        self.memory = Memory({**target_slots(params.preview), **self.model.slots})
        self.preview, self.turned = params.preview, unit < 0
        self.n_state = self.memory.n_state
        self.info = ("b1", "offset", "mv_requested")

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over part ``nnarx``; raises LawError."""
        return cls(signals, require_kind(models, NNARX, cls.name), params)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        p = self.memory.recall(sp, pv, mv_applied, state)
        ahead = self.model(p)
        down, up = room(self, p["u"], self.unit, turned=self.turned)
        best, _ = self.search(ahead, target(p, self.preview), down, up)
        requested = p["u"] + best * self.unit
        info = torch.cat([ahead.slope * self.by_unit, ahead.offset, requested], dim=-1)
        return self.limited(requested, p["u"]), self.memory.stored(p, ahead.kept), info
