"""Direct inverse control: the network as the law, its applicability domain, and error correction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from pipeline.errors import LawError
from pipeline.laws.base import ControlLaw, require_part, require_single_loop
from pipeline.models.base import Model
from pipeline.models.static.leverage_domain import Interval, LeverageDomain
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator

REQUEST_INFO = ("sp_requested", "sp_min", "sp_max", "leverage", "in_domain")


def _parts(models: Mapping[str, Model], signals: Signals, law: str) -> tuple[Model, LeverageDomain]:
    """Parts ``inverse`` and ``domain`` of a model set over the inputs [pv, set point]; raises LawError."""
    require_single_loop(signals, law)
    n_in = len(signals.pv) + 1
    domain = require_part(models, "domain", law, n_in, 1)
    if not isinstance(domain, LeverageDomain):
        raise LawError(f"law {law!r} needs a part 'domain' of kind leverage_domain; got {domain.kind}")
    return require_part(models, "inverse", law, n_in, 1), domain


def _narrowing(r: float) -> Tensor:
    """The buffer of a narrowing parameter; raises LawError unless it is at least 1."""
    if not 1 <= r < float("inf"):
        raise LawError(f"r is {r}; it divides the width of the domain and must be at least 1")
    return torch.tensor([r], dtype=torch.float64)


def _bounds(domain: LeverageDomain, pv: Tensor, narrowing: Tensor) -> tuple[Interval, Tensor, Tensor]:
    """The interval of requests at a state, and its narrowed bounds (..., 1) each."""
    at = domain.interval(pv)
    return (at, *domain.bounds(at, pv[..., :1], narrowing))


def _request_info(domain: LeverageDomain, at: Interval, w: Tensor, w_min: Tensor, w_max: Tensor) -> list[Tensor]:
    """REQUEST_INFO of the request w that the network is given, (..., 1) each."""
    leverage = domain.leverage(at, w)
    return [w, w_min, w_max, leverage, domain.inside(leverage)]


class INC(ControlLaw):
    """Inverse neural controller: the MV that the network knows to lead from the state to the set point.

        mv(k) = RBF(x(k), w(k)),   x = pv (..., n_pv), w = sp (..., n_sp)

    Source: [inverse_rbf, eqs 11 and 12].
    """

    name: ClassVar[str] = "inc"
    title: ClassVar[str] = "Inverse neural controller"

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

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        requested = self.inverse(torch.cat([pv, sp], dim=-1))
        return self.limited(requested, mv_applied), state, requested


class INCAD(ControlLaw):
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

        r: float = 1.5
        mv_rate: float | None = None

    narrowing: Tensor  # (1,)

    def __init__(
        self,
        signals: Signals,
        inverse: Model,
        domain: LeverageDomain,
        r: float = 1.5,
        mv_rate: float | None = None,
    ) -> None:
        super().__init__(signals, mv_rate)
        self.inverse, self.domain = inverse, domain
        self.register_buffer("narrowing", _narrowing(r))
        self.n_state = 0
        self.info = (*REQUEST_INFO, "mv_requested")

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over parts ``inverse`` and ``domain``; raises LawError."""
        return cls(signals, *_parts(models, signals, cls.name), params.r, params.mv_rate)

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        at, w_min, w_max = _bounds(self.domain, pv, self.narrowing)
        w_re = torch.minimum(torch.maximum(sp, w_min), w_max)
        requested = self.inverse(torch.cat([pv, w_re], dim=-1))
        info = torch.cat([*_request_info(self.domain, at, w_re, w_min, w_max), requested], dim=-1)
        return self.limited(requested, mv_applied), state, info


class INCADEC(ControlLaw):
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

        r: float = 5.5
        correction: Literal["as_printed", "back_calculation"] = "as_printed"
        mv_rate: float | None = None

    narrowing: Tensor  # (1,)
    flat: Tensor  # (1,) [mv^2] far below the square of a chord worth following

    def __init__(
        self,
        signals: Signals,
        inverse: Model,
        domain: LeverageDomain,
        r: float = 5.5,
        correction: str = "as_printed",
        mv_rate: float | None = None,
    ) -> None:
        super().__init__(signals, mv_rate)
        if correction not in {"as_printed", "back_calculation"}:
            raise LawError(f"correction is {correction!r}; allowed are 'as_printed' and 'back_calculation'")
        self.inverse, self.domain = inverse, domain
        self.register_buffer("narrowing", _narrowing(r))
        self.register_buffer("flat", ((self.high - self.low) * 1e-6) ** 2)
        self.back_calculation = correction == "back_calculation"
        # started, w_EC; for back-calculation also m_EC, w_a, m_a
        self.n_state = 5 if self.back_calculation else 2
        self.info = (*REQUEST_INFO, "error_correction", "mv_requested")

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over parts ``inverse`` and ``domain``; raises LawError."""
        parts = _parts(models, signals, cls.name)
        return cls(signals, *parts, params.r, params.correction, params.mv_rate)

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        at, w_min, w_max = _bounds(self.domain, pv, self.narrowing)
        w_re = torch.minimum(torch.maximum(sp, w_min), w_max)
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
        info = torch.cat([*_request_info(self.domain, at, w_ec, w_min, w_max), error, requested], dim=-1)
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
