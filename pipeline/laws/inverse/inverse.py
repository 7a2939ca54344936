"""Direct inverse control: the network as the law, its applicability domain, and error correction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import inf
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import ControlLaw, Stepped, hold_numbers, require_part, require_single_loop
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.static.leverage_domain import DomainInterval, LeverageDomain
from loopwright.pipeline.plants.simulator import Signals, Simulator


class INC(ControlLaw):
    """Inverse neural controller: the MV that the network knows to lead from the state to the set point.

        mv(k) = RBF(x(k), w(k)),   x = pv (..., n_pv), w = sp (..., n_sp)

    Source: [inverse_rbf, eqs 11 and 12].
    """

    name: ClassVar[str] = "inc"
    title: ClassVar[str] = "Inverse neural controller"
    parts: ClassVar[Mapping[str, str]] = {"inverse": "a network of task inverse"}

    @dataclass(frozen=True, slots=True)
    class Params:
        """``mv_rate`` [mv]: largest change a sample; None is unlimited."""

        mv_rate: float | None = None

    def __init__(self, signals: Signals, inverse: Model, mv_rate: float | None = None) -> None:
        super().__init__(signals, mv_rate)
        self.inverse = inverse
        self.n_state = 0
        self.info = ("mv_requested",)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over part ``inverse``; raises LawError where it is missing or of another shape."""
        n_in = len(signals.pv) + len(signals.sp)
        return cls(signals, require_part(models, "inverse", cls.name, n_in, len(signals.mv)), params.mv_rate)

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        requested = self.inverse(torch.cat([pv, sp], dim=-1))
        return self.limited(requested, mv_applied), state, requested


class DomainLaw(ControlLaw):
    """A law over parts ``inverse`` and ``domain``: its requests have bounds, drawn together ``r`` times."""

    parts: ClassVar[Mapping[str, str]] = {"inverse": "a network of task inverse", "domain": "kind leverage_domain"}
    narrowing: Tensor  # (1,) r

    def __init__(
        self, signals: Signals, inverse: Model, domain: LeverageDomain, r: float, mv_rate: float | None = None
    ) -> None:
        super().__init__(signals, mv_rate)
        if not 1 <= r < inf:
            raise LawError(f"r is {r}; it divides the width of the domain and must be at least 1")
        self.inverse, self.domain = inverse, domain
        hold_numbers(self, narrowing=r)
        self.n_state = 0
        self.info = ("sp_requested", "sp_min", "sp_max", "leverage", "in_domain", "mv_requested")

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over parts ``inverse`` and ``domain``, both of [pv, set point]; raises LawError."""
        require_single_loop(signals, cls.name)
        n_in = len(signals.pv) + 1
        domain = require_part(models, "domain", cls.name, n_in, 1)
        if not isinstance(domain, LeverageDomain):
            raise LawError(f"law {cls.name!r} needs a part 'domain' of kind leverage_domain; got {domain.kind}")
        return cls(signals, require_part(models, "inverse", cls.name, n_in, 1), domain, **asdict(params))

    def within(self, sp: Tensor, pv: Tensor) -> tuple[DomainInterval, Tensor, Tensor, Tensor]:
        """The interval of requests at a state, its narrowed bounds, and the set point within them, (..., 1) each."""
        at = self.domain.interval(pv)
        low, high = self.domain.bounds(at, pv[..., :1], self.narrowing)
        return at, low, high, torch.minimum(torch.maximum(sp, low), high)

    def shown(self, at: DomainInterval, w: Tensor, low: Tensor, high: Tensor, *more: Tensor) -> Tensor:
        """Info of the request w (..., 1) that the network is given."""
        leverage = self.domain.leverage(at, w)
        return torch.cat([w, low, high, leverage, self.domain.inside(leverage), *more], dim=-1)


class INCAD(DomainLaw):
    """INC that requests no more than the training data can answer for.

        mv(k) = RBF(x(k), w_RE(k)),   w_RE = w limited to [w'_min, w'_max]

    The bounds are those of the leverage domain at x, drawn together r times. Where the state
    itself is outside the domain, w_RE is the measured output: the centre of bounds that do not
    exist, or the last request, can lock the loop. The narrowing does more than prevent
    extrapolation: it slows an inverse whose exact form rings, the sampled plant's zero being
    its closed-loop eigenvalue.

    Source: [inverse_rbf, eqs 15-20].
    """

    name: ClassVar[str] = "incad"
    title: ClassVar[str] = "Inverse neural controller with applicability domain"

    @dataclass(frozen=True, slots=True)
    class Params:
        """``r`` >= 1 is the narrowing; ``mv_rate`` [mv] the largest change a sample, None unlimited."""

        r: float
        mv_rate: float | None = None

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        at, w_min, w_max, w_re = self.within(sp, pv)
        requested = self.inverse(torch.cat([pv, w_re], dim=-1))
        info = self.shown(at, w_re, w_min, w_max, requested)
        return self.limited(requested, mv_applied), state, info


class INCADEC(DomainLaw):
    """INCAD with error correction of the request.

        w_EC(k) = w_RE(k) + e(k),   e(k) = w_EC(k-1) - y(k),   mv(k) = RBF(x(k), w_EC(k))

    with e = 0 on the first step. ``correction="as_printed"`` remembers w_EC; it integrates every
    request that the limited actuator cannot answer. ``correction="back_calculation"`` remembers
    w', the request that belongs to the MV which the plant really received:

        w' = w_EC + (w_a - w_EC) clip((mv_applied - m_EC)/(m_a - m_EC), 0, 1),   m = RBF(x(k-1), .)

    on the chord between w_EC and an anchor w_a, the centre of the domain (where the state is
    outside it: the output), near which the network asks for an MV well inside its range. Both
    points go through the network as one batch, in the step before, so that a step costs no
    second pass; an MV that was applied as asked gives w' = w_EC exactly.

    Source: [inverse_rbf, eqs 21-23]; the back-calculation is not in the paper.
    """

    name: ClassVar[str] = "incadec"
    title: ClassVar[str] = "Inverse neural controller with applicability domain and error correction"

    @dataclass(frozen=True, slots=True)
    class Params:
        """``r`` >= 1 is the narrowing; ``correction`` as in the class; ``mv_rate`` [mv] a sample, None unlimited."""

        r: float
        correction: Literal["as_printed", "back_calculation"]
        mv_rate: float | None = None

    flat: Tensor  # (1,) [mv^2] far below the square of a chord worth following

    def __init__(
        self,
        signals: Signals,
        inverse: Model,
        domain: LeverageDomain,
        r: float,
        correction: str,
        mv_rate: float | None = None,
    ) -> None:
        super().__init__(signals, inverse, domain, r, mv_rate)
        if correction not in {"as_printed", "back_calculation"}:
            raise LawError(f"correction is {correction!r}; allowed are 'as_printed' and 'back_calculation'")
        self.register_buffer("flat", ((self.high - self.low) * 1e-6) ** 2)
        self.back_calculation = correction == "back_calculation"
        # started, w_EC; for back-calculation also m_EC, w_a, m_a
        self.n_state = 5 if self.back_calculation else 2
        self.info = (*self.info[:-1], "error_correction", "mv_requested")

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        at, w_min, w_max, w_re = self.within(sp, pv)
        error = torch.where(state[..., :1] > 0, self._remembered(mv_applied, state) - pv[..., :1], 0 * w_re)
        w_ec = w_re + error
        started = torch.ones_like(w_ec)
        if self.back_calculation:
            anchor = 0.5 * (w_min + w_max)
            pair = torch.stack([torch.cat([pv, w_ec], dim=-1), torch.cat([pv, anchor], dim=-1)], dim=-2)
            both = self.inverse(pair)
            requested = both[..., 0, :]
            state_next = torch.cat([started, w_ec, requested, anchor, both[..., 1, :]], dim=-1)
        else:
            requested = self.inverse(torch.cat([pv, w_ec], dim=-1))
            state_next = torch.cat([started, w_ec], dim=-1)
        info = self.shown(at, w_ec, w_min, w_max, error, requested)
        return self.limited(requested, mv_applied), state_next, info

    def _remembered(self, mv_applied: Tensor, state: Tensor) -> Tensor:
        """w_EC(k-1), or the w' of the MV that was applied instead."""
        w_ec = state[..., 1:2]
        if not self.back_calculation:
            return w_ec
        m_ec, w_a, m_a = state[..., 2:3], state[..., 3:4], state[..., 4:5]
        chord = m_a - m_ec
        # Where both points ask for the same MV there is nothing to choose between: keep w_EC.
        share = (mv_applied - m_ec) * chord / (chord * chord + self.flat)
        return w_ec + (w_a - w_ec) * share.clamp(0.0, 1.0)
