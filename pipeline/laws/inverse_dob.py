"""Offset-free inverse control: an inverse over several periods, a disturbance observer, a small integral."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from pipeline.errors import LawError
from pipeline.laws.base import ControlLaw, LawSignals, require_part, require_single_loop
from pipeline.models.base import Model
from pipeline.plants.base import Plant


def _column(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def _at(pv: Tensor, mv: Tensor) -> Tensor:
    """Model inputs (..., K, n_pv + 1) for K candidate MVs (..., K) at one state (..., n_pv)."""
    states = pv.unsqueeze(-2).expand(*mv.shape, pv.shape[-1])
    return torch.cat([states, mv.unsqueeze(-1)], dim=-1)


def _direction(forward: Model, signals: LawSignals) -> float:
    """Sign of the MV's effect on a forward model, over states all over the PVs' ranges."""
    rng = torch.Generator().manual_seed(0)
    low, high = (torch.tensor([getattr(s, end) for s in signals.pv], dtype=torch.float64) for end in ("low", "high"))
    states = low + (high - low) * torch.rand(1000, len(signals.pv), generator=rng, dtype=torch.float64)
    mv = signals.mv[0]
    ends = torch.tensor([mv.low, mv.high], dtype=torch.float64).expand(1000, 2)
    with torch.no_grad():
        at = forward(_at(states, ends)).squeeze(-1)
    return -1.0 if float((at[:, 1] - at[:, 0]).sum()) < 0 else 1.0


class ObserverLaw(ControlLaw):
    """What both forms share: everything but the inversion.

        mv(k) = v(k) - d(k),   v = inverse(x(k), w + I),

        T_hat(k) = f(x(k-1), mv_applied) + b d(k-1),   b = [f(x(k-1), mv_max) - f(x(k-1), mv_min)] / range
        d(k)     = d(k-1) + L (T(k) - T_hat(k)) / b
        I(k+1)   = I(k) + ki (w - y)   while the MV is not limited and |w - y| < band

    An exact inverse over one period puts a closed-loop eigenvalue on the sampled plant's zero, which
    may lie outside the unit circle; over several periods, applied anew at every sample, it does not.
    d [mv] is what the MV would have had to be more, over the last period, for the one-step model f
    to have predicted the observed variable T; it is fed the MV that the plant really received, so
    it knows no saturation and cannot wind up. The integral only takes the rest.

    Source: the remedy is not in the paper, seed 000_0a422d3e5d968dac.txt; eqs 12 and 21-23 are what it replaces.
    """

    @dataclass(frozen=True, slots=True)
    class Params:
        """Numbers of the law.

        ``observer_gain`` L in (0, 1]; ``integral_gain`` ki >= 0 a sample; ``band`` [cv] the error below
        which the integral acts; ``observed`` the name of the PV that part ``observer`` predicts, None for the
        last; ``mv_rate`` [mv] the largest change a sample, None unlimited.
        """

        observer_gain: float = 0.7
        integral_gain: float = 0.03
        band: float = 0.03
        observed: str | None = None
        mv_rate: float | None = None

        def __post_init__(self) -> None:
            if not 0 < self.observer_gain <= 1:
                raise ValueError(f"observer_gain is {self.observer_gain}; it must lie in (0, 1]")
            if self.integral_gain < 0 or not self.band > 0:
                raise ValueError(
                    f"integral_gain is {self.integral_gain} and band {self.band}; they must be >= 0 and > 0"
                )

    observer: Model
    gain: Tensor
    integral_gain: Tensor
    band: Tensor
    span: Tensor
    direction: Tensor  # (1,) sign of the MV's effect on the controlled variable
    least: Tensor  # (1,) [cv] a reach narrower than this tells nothing but the models' errors
    ends: Tensor  # (2,) least and greatest MV

    def __init__(self, signals: LawSignals, forward: Model, observer: Model, params: Params) -> None:
        super().__init__(signals, params.mv_rate)
        names = [s.name for s in signals.pv]
        if params.observed is not None and params.observed not in names:
            raise LawError(f"observed is {params.observed!r}; the process variables are {', '.join(names)}")
        self.observer = observer
        self.observed = len(names) - 1 if params.observed is None else names.index(params.observed)
        self.n_pv = len(names)
        self.register_buffer("gain", _column(params.observer_gain))
        self.register_buffer("integral_gain", _column(params.integral_gain))
        self.register_buffer("band", _column(params.band))
        self.register_buffer("span", self.high - self.low)
        self.register_buffer("ends", torch.cat([self.low, self.high]))
        self.register_buffer("direction", _column(_direction(forward, signals)))
        self.register_buffer("least", _column(1e-3 * (signals.sp[0].high - signals.sp[0].low)))
        self.n_state = self.n_pv + 3  # started, x(k-1), d, I
        self.info = ("sp_requested", "sp_min", "sp_max", "disturbance", "integral")

    @abstractmethod
    def invert(self, pv: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(v, w within reach, least and greatest reachable w), each (..., 1), for a request w (..., 1).

        v goes on beyond the MV's range, at the slope of the reach, for a request beyond it.
        """

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        disturbance = self._disturbance(pv, mv_applied, state)
        integral = state[..., -1:]
        v, w, w_min, w_max = self.invert(pv, sp + integral)
        wanted = v - disturbance
        mv = self.limited(wanted, mv_applied)
        error = sp - pv[..., :1]
        free = (mv == wanted).to(error.dtype) * (error.abs() < self.band).to(error.dtype)
        # The integral takes what the observer leaves: no more than the band in which it acts.
        integral_next = torch.minimum(
            torch.maximum(integral + self.integral_gain * error * free, -self.band), self.band
        )
        state_next = torch.cat([torch.ones_like(error), pv, disturbance, integral_next], dim=-1)
        return mv, state_next, torch.cat([w, w_min, w_max, disturbance, integral], dim=-1)

    def within_reach(self, w: Tensor, at_low: Tensor, at_high: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(w within reach, [mv] to go on beyond the MV's range, least and greatest reachable w), each (..., 1).

        ``at_low`` and ``at_high`` are the forward model's answers to the ends of the MV's range. Where the
        plant hardly answers, their difference is the model's error and may have the wrong sign: the push
        takes the sign from the plant as a whole, or the loop would lock at the wrong end.
        """
        w_min, w_max = torch.minimum(at_low, at_high), torch.maximum(at_low, at_high)
        within = torch.minimum(torch.maximum(w, w_min), w_max)
        push = (w - within) * self.direction * self.span / torch.maximum(w_max - w_min, self.least)
        return within, push, w_min, w_max

    def _disturbance(self, pv: Tensor, mv_applied: Tensor, state: Tensor) -> Tensor:
        """d(k) [mv], shape (..., 1); zero at the first step."""
        past, d = state[..., 1 : 1 + self.n_pv], state[..., 1 + self.n_pv : 2 + self.n_pv]
        ends = self.ends.expand(*past.shape[:-1], 2)
        rows = self.observer(_at(past, torch.cat([mv_applied, ends], dim=-1))).squeeze(-1)
        slope = (rows[..., 2:3] - rows[..., 1:2]) / self.span
        surprise = pv[..., self.observed : self.observed + 1] - rows[..., 0:1]
        found = d + self.gain * (surprise / slope - d)
        # More than the whole actuator can never be acted on, and a bad sample must not be remembered for long.
        found = torch.minimum(torch.maximum(found, -self.span), self.span)
        return torch.where(state[..., :1] > 0, found, torch.zeros_like(found))


class InverseDob(ObserverLaw):
    """The form with a learnt inverse: v = RBF(x, w) over h periods.

        v = RBF(x, w_c) + (w - w_c) range / (g(x, mv_max) - g(x, mv_min)),   w_c = w limited to g(x, [mv_min, mv_max])

    g is a forward model over the same h periods. The reach clip keeps the network off requests that
    no MV can meet, where it extrapolates and can lock the loop at an end; beyond reach the slope
    drives the MV to its limit, whatever the network would say.
    """

    name: ClassVar[str] = "inverse_dob"
    title: ClassVar[str] = "RBF inverse over several periods, disturbance observer, integral"

    inverse: Model
    model: Model

    def __init__(
        self, signals: LawSignals, inverse: Model, forward: Model, observer: Model, params: ObserverLaw.Params
    ) -> None:
        super().__init__(signals, forward, observer, params)
        self.inverse, self.model = inverse, forward

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: LawSignals, plant: Plant) -> Self:
        """The law over parts ``inverse``, ``forward`` and ``observer``; raises LawError."""
        require_single_loop(signals, cls.name)
        n = len(signals.pv) + 1
        inverse, forward, observer = (
            require_part(models, p, cls.name, n, 1) for p in ("inverse", "forward", "observer")
        )
        return cls(signals, inverse, forward, observer, params)

    def invert(self, pv: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As in ObserverLaw."""
        ends = self.model(_at(pv, self.ends.expand(*pv.shape[:-1], 2))).squeeze(-1)
        within, push, w_min, w_max = self.within_reach(w, ends[..., 0:1], ends[..., 1:2])
        return self.inverse(torch.cat([pv, within], dim=-1)) + push, within, w_min, w_max


class ForwardDob(ObserverLaw):
    """The form with a forward model g over h periods, inverted at every sample by sectioning.

    The MV's range is cut into ``SECTIONS`` equal parts, the one in which g crosses w is cut again,
    ``ROUNDS`` times in all (so many bisections at once), and the crossing taken on the chord of the
    last part. g must be monotone in the MV. Beyond reach v goes on at the slope of the whole range.
    """

    name: ClassVar[str] = "forward_dob"
    title: ClassVar[str] = "Forward network inverted online, disturbance observer, integral"
    SECTIONS: ClassVar[int] = 16
    ROUNDS: ClassVar[int] = 2

    model: Model
    cuts: Tensor  # (SECTIONS + 1,) 0 .. 1
    share: Tensor  # (1,) 1/SECTIONS
    flat: Tensor  # (1,) [cv] a rise below which a chord has no slope

    def __init__(self, signals: LawSignals, model: Model, observer: Model, params: ObserverLaw.Params) -> None:
        super().__init__(signals, model, observer, params)
        self.model = model
        self.register_buffer("cuts", torch.linspace(0.0, 1.0, self.SECTIONS + 1, dtype=torch.float64))
        self.register_buffer("share", _column(1.0 / self.SECTIONS))
        self.register_buffer("flat", _column(1e-12))

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: LawSignals, plant: Plant) -> Self:
        """The law over parts ``forward`` and ``observer``; raises LawError."""
        require_single_loop(signals, cls.name)
        n = len(signals.pv) + 1
        forward, observer = (require_part(models, p, cls.name, n, 1) for p in ("forward", "observer"))
        return cls(signals, forward, observer, params)

    def invert(self, pv: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As in ObserverLaw."""
        start, width = self.low, self.span
        for i in range(self.ROUNDS):
            g = self.model(_at(pv, (start + width * self.cuts).expand(*pv.shape[:-1], self.SECTIONS + 1))).squeeze(-1)
            if i == 0:
                within, push, w_min, w_max = self.within_reach(w, g[..., 0:1], g[..., -1:])
            # Inner cuts that the crossing lies beyond.
            beyond = ((within - g[..., 1:-1]) * self.direction > 0).to(g.dtype).sum(dim=-1, keepdim=True)
            width = width * self.share
            start = start + width * beyond
        ends = self.model(_at(pv, torch.cat([start, start + width], dim=-1))).squeeze(-1)
        rise = (ends[..., 1:2] - ends[..., 0:1]) * self.direction
        chord = (within - ends[..., 0:1]) * self.direction / torch.maximum(rise, self.flat)
        chord = torch.minimum(torch.maximum(chord, self.cuts[:1]), self.cuts[-1:])
        return start + width * chord + push, within, w_min, w_max
