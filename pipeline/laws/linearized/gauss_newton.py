"""Laws that relinearize an NNARX within the sample: PID gains, and the move itself without a PID around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from loopwright.pipeline.laws.adaptive import move, signed_unit, target, target_slots
from loopwright.pipeline.laws.base import ControlLaw, Stepped, hold_numbers, require_kind, require_single_loop
from loopwright.pipeline.laws.linearized.nnarx_law import NnarxParams, NnarxPid, central_model, next_output
from loopwright.pipeline.laws.scaled_defaults import OfRange, in_units
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.lagged.next_output import GaussNewton
from loopwright.pipeline.models.lagged.nnarx import NNARX
from loopwright.pipeline.models.memory import Memory
from loopwright.pipeline.plants.signals import Signals
from loopwright.pipeline.plants.simulator import Simulator


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
    class Params(NnarxParams):
        """Parameters of NnarxParams; ``relinearize`` is the number of linearizations, 1 or more."""

        relinearize: int = 5

        def __post_init__(self) -> None:
            NnarxParams.__post_init__(self)
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
    incremental: ClassVar[bool] = True
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
            if not 0 < self.offset_filter <= 1:
                raise ValueError(f"offset_filter is {self.offset_filter}; it must lie in (0, 1]")

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
