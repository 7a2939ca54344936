"""Offset-free inverse control: an inverse over several periods, a disturbance observer, a small integral."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import (
    Analysis,
    ControlLaw,
    OfRange,
    Stepped,
    hold_numbers,
    in_units,
    require_kind,
    require_part,
    require_single_loop,
)
from loopwright.pipeline.laws.inverse.from_identified import LONGEST_INVERSE_HORIZON, HorizonChoice, learnt_parts
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.plants.simulator import Signals, Simulator


def candidates(model: Model, x: Tensor, u: Tensor) -> Tensor:
    """Predictions (..., K) of a model over [x, u] at one state x (..., n) for candidates u (..., K)."""
    if isinstance(model, MLP):
        return model.sections(x, u.unsqueeze(-1)).squeeze(-1)
    states = x.unsqueeze(-2).expand(*u.shape, x.shape[-1])
    y: Tensor = model(torch.cat([states, u.unsqueeze(-1)], dim=-1))
    return y.squeeze(-1)


# ------------------------------------------------------------------------------------------------------------- the law
# Share of the MV's range within which the plant's MV counts as the law's own: readings are rounded.
OWN_MV_BAND = 1e-3
OWN_CHOICE = ("identified",)  # parts of a set from which a law chooses and learns its networks itself
ONE_PERIOD = "a network of task forward over one period, its target the observed PV"


def _rising(forward: Model, signals: Signals) -> bool:
    """Whether more MV means more of the controlled variable, over states all over the PVs' ranges."""
    rng = torch.Generator().manual_seed(0)
    low, high = (torch.tensor([getattr(s, end) for s in signals.pv], dtype=torch.float64) for end in ("low", "high"))
    states = low + (high - low) * torch.rand(1000, len(signals.pv), generator=rng, dtype=torch.float64)
    mv = signals.mv[0]
    ends = torch.tensor([mv.low, mv.high], dtype=torch.float64).expand(1000, 2)
    with torch.no_grad():
        at = candidates(forward, states, ends)
    return float((at[:, 1] - at[:, 0]).sum()) >= 0


def _place(observed: str | None, signals: Signals) -> int | None:
    names = [s.name for s in signals.pv]
    if observed is not None and observed not in names:
        raise LawError(f"observed is {observed!r}; the process variables are {', '.join(names)}")
    return None if observed is None else names.index(observed)


def _model_of_all(models: Mapping[str, Model], signals: Signals, law: str) -> Identified:
    model = require_kind(models, Identified, law, " of all PVs")
    if model.n_y != len(signals.pv):
        raise LawError(f"law {law!r} needs a model of all {len(signals.pv)} PVs; part 'identified' has {model.n_y}")
    return model


class ObserverLaw(ControlLaw):
    """Base of both forms: everything but the inversion.

        mv(k) = v(k) - d(k),   v = inverse(x(k), w + I),

        T_hat(k) = f(x(k-1), mv_applied) + b d(k-1),   b = [f(x(k-1), mv_max) - f(x(k-1), mv_min)] / range
        d(k)     = d(k-1) + L (T(k) - T_hat(k)) / b
        I(k+1)   = I(k) + ki (w - y)   while |w - y| < band, the MV is not limited, and the last one was applied

    An exact inverse over one period puts a closed-loop eigenvalue on the sampled plant's zero, which
    may lie outside the unit circle; over several periods, applied anew at every sample, it does not.
    d [mv] is what the MV would have had to be more, over the last period, for the one-step model f
    to have predicted the observed variable T; it is fed the MV that the plant really received, so
    it knows no saturation and cannot wind up. The integral only takes the rest.

    Source: the remedy is ours; it replaces [inverse_rbf, eqs 12 and 21-23].
    """

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params:
        """Numbers of the law.

        ``observer_gain`` L in (0, 1]; ``integral_gain`` ki >= 0 a sample; ``band`` [cv] the error below
        which the integral acts; ``horizon`` h in periods and ``observed``, the name of a PV: None lets the law
        choose from the part ``identified`` (``HorizonChoice``). Where the set has parts of the law's own, these state
        their horizon, and ``observed`` is the PV that part ``observer`` predicts, None for the last; ``mv_rate``
        [mv] the largest change a sample, None unlimited.
        """

        observer_gain: float
        integral_gain: float
        band: float = OfRange(0.02)
        horizon: int | None = None
        observed: str | None = None
        mv_rate: float | None = None

        def __post_init__(self) -> None:
            if not 0 < self.observer_gain <= 1:
                raise ValueError(f"observer_gain is {self.observer_gain}; it must lie in (0, 1]")
            if self.integral_gain < 0 or not self.band > 0:
                raise ValueError(
                    f"integral_gain is {self.integral_gain} and band {self.band}; they must be >= 0 and > 0"
                )
            if self.horizon is not None and not 1 <= self.horizon <= LONGEST_INVERSE_HORIZON:
                raise ValueError(
                    f"horizon is {self.horizon}; give 1 to {LONGEST_INVERSE_HORIZON} periods, or leave it out"
                )

    observes_within: ClassVar[int | None] = 1
    choice: HorizonChoice | None = None
    # In the order of the constructor's arguments.
    parts: ClassVar[Mapping[str, str]] = {"forward": "a network of task forward", "observer": ONE_PERIOD}
    span: Tensor
    band: Tensor
    grid: Tensor  # (n_grid,) [mv] over the whole range
    least: Tensor  # (1,) share of the set point's range below which a reach is nothing but the models' errors

    def __init__(self, signals: Signals, forward: Model, observer: Model, params: Params, sections: int = 1) -> None:
        super().__init__(signals, params.mv_rate)
        params = in_units(params, signals, self.name)
        names = [s.name for s in signals.pv]
        place = _place(params.observed, signals)
        self.params, self.observed = params, len(names) - 1 if place is None else place
        self.n_pv = n = len(names)
        self.n_state = n + 4  # started, x(k-1), d, I, mv(k-1)
        self.info = ("sp_requested", "sp_min", "sp_max", "disturbance", "integral")
        self.rising = _rising(forward, signals)
        self.register_buffer("span", self.high - self.low)
        hold_numbers(self, band=params.band)
        self.register_buffer("least", 1e-3 * (signals.sp[0].high - signals.sp[0].low) / self.span)
        grid = self.low + self.span * torch.linspace(0, 1, sections + 1, dtype=torch.float64)
        self.register_buffer("grid", grid)
        self.reach, self.observer = forward, observer

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over its ``parts``, each of the PVs and one more input, or over ``identified``; raises LawError."""
        require_single_loop(signals, cls.name)
        choice = None
        if cls.needs(params, models) == OWN_CHOICE:
            model = _model_of_all(models, signals, cls.name)
            choice = HorizonChoice.of(model, signals, params.horizon, _place(params.observed, signals))
            models = learnt_parts(model, signals, choice)
            params = replace(params, observed=signals.pv[choice.observed].name)
        elif params.horizon is not None:
            raise LawError(
                f"law {cls.name!r}: horizon is {params.horizon}, but the set has parts of the law's own; give "
                "`horizon` to its parts 'forward' and 'inverse', or leave these parts out"
            )
        networks = [require_part(models, part, cls.name, len(signals.pv) + 1, 1) for part in cls.parts]
        final: Any = cls  # with as many networks as it has parts
        law: Self = final(signals, *networks, params)
        law.choice = choice
        return law

    @classmethod
    def needs(cls, params: Any, given: Collection[str] = ()) -> tuple[str, ...]:
        """Its ``parts``; the identified model alone, for a set that has one and no network of the law's own."""
        return OWN_CHOICE if set(given) & {"identified", *cls.parts} == {"identified"} else tuple(cls.parts)

    def analysis(self, plant: Simulator | None) -> Analysis:
        """The law's own choices; empty where its parts were given."""
        return Analysis() if self.choice is None else self.choice.analysis(self.signals)

    @abstractmethod
    def invert(self, pv: Tensor, w: Tensor, g: Tensor) -> Tensor:
        """The MV v (..., 1) for a request w (..., 1) within reach, given g (..., n_grid) over the grid."""

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        started, x1, d1, integral, mv1 = torch.split(state, [1, self.n_pv, 1, 1, 1], dim=-1)
        params, i = self.params, self.observed
        # What the last period's disturbance was, as an MV: what the observer did not expect, by its slope.
        ends = torch.cat([self.low, self.high]).expand(*mv_applied.shape[:-1], 2)
        f = candidates(self.observer, x1, torch.cat([mv_applied, ends], dim=-1))
        surprise = pv[..., i : i + 1] - f[..., :1]
        slope = (f[..., 2:] - f[..., 1:2]) / self.span
        d = (1 - params.observer_gain) * d1 + params.observer_gain * surprise / slope
        # More than the whole actuator can never be acted on, and a bad sample must not be remembered for long.
        d = started * torch.minimum(torch.maximum(d, -self.span), self.span)
        # What the MV can reach, and the request within it.
        g = candidates(self.reach, pv, self.grid.expand(*pv.shape[:-1], len(self.grid)))
        w_min, w_max = (g[..., :1], g[..., -1:]) if self.rising else (g[..., -1:], g[..., :1])
        request = sp + integral
        within = torch.minimum(torch.maximum(request, w_min), w_max)
        # Where the plant hardly answers, the reach is the model's error and may have the wrong sign: the way to
        # go on comes from the plant as a whole, or the loop would lock at the wrong end.
        width = torch.maximum((w_max - w_min) / self.span, self.least)
        beyond = (request - within if self.rising else within - request) / width
        requested = self.invert(pv, within, g) + beyond - d
        mv = self.limited(requested, mv_applied)
        # Acting on an error that someone else's MV leaves would be winding up, in manual as at a limit.
        error = sp - pv[..., :1]
        acts = torch.cat([error / params.band, (mv_applied - mv1) / (OWN_MV_BAND * self.span)], dim=-1)
        free = (mv == requested) & (acts.abs().amax(dim=-1, keepdim=True) < 1)
        # The integral takes what the observer leaves: no more than the band in which it acts.
        moved = integral + params.integral_gain * error
        integral_next = torch.where(free, torch.minimum(torch.maximum(moved, -self.band), self.band), integral)
        state_next = torch.cat([torch.ones_like(integral), pv, d, integral_next, mv], dim=-1)
        return mv, state_next, torch.cat([within, w_min, w_max, d, integral], dim=-1)


class InverseDob(ObserverLaw):
    """The form with a learnt inverse: v = RBF(x, w) over h periods.

        v = RBF(x, w_c) + (w - w_c) range / (g(x, mv_max) - g(x, mv_min)),   w_c = w limited to g(x, [mv_min, mv_max])

    g is a forward model over the same h periods. The reach clip keeps the network off requests that
    no MV can meet, where it extrapolates and can lock the loop at an end; beyond reach the slope
    drives the MV to its limit, whatever the network would say.
    """

    name: ClassVar[str] = "inverse_dob"
    title: ClassVar[str] = "RBF inverse over several periods, disturbance observer, integral"
    parts: ClassVar[Mapping[str, str]] = {"inverse": "a network of task inverse", **ObserverLaw.parts}

    def __init__(
        self, signals: Signals, inverse: Model, forward: Model, observer: Model, params: ObserverLaw.Params
    ) -> None:
        super().__init__(signals, forward, observer, params)
        self.inverse = inverse

    def invert(self, pv: Tensor, w: Tensor, g: Tensor) -> Tensor:
        """The same as in ObserverLaw."""
        v: Tensor = self.inverse(torch.cat([pv, w], dim=-1))
        return v


class ForwardDob(ObserverLaw):
    """The form with a forward model g over h periods, inverted at every sample by sectioning.

    The MV's range is cut into ``SECTIONS`` equal parts, the one in which g crosses w is cut again
    (so many bisections at once), and the crossing taken on the chord of the last part. g must be
    monotone in the MV. Beyond reach v goes on at the slope of the whole range.
    """

    name: ClassVar[str] = "forward_dob"
    title: ClassVar[str] = "Forward network inverted online, disturbance observer, integral"
    SECTIONS: ClassVar[int] = 16

    cuts: Tensor  # (SECTIONS + 1,) [mv] cuts of one part, from its start
    part: Tensor  # (1,) [mv] width of one part of the range
    chord: Tensor  # (1,) [mv] width of one part of a part
    flat: Tensor  # (1,) [cv] a rise below which a chord has no slope

    def __init__(self, signals: Signals, model: Model, observer: Model, params: ObserverLaw.Params) -> None:
        super().__init__(signals, model, observer, params, sections=self.SECTIONS)
        self.model = model
        self.register_buffer("part", self.span / self.SECTIONS)
        self.register_buffer("chord", self.part / self.SECTIONS)
        self.register_buffer("cuts", self.part * torch.linspace(0, 1, self.SECTIONS + 1, dtype=torch.float64))
        hold_numbers(self, flat=1e-12 * (signals.sp[0].high - signals.sp[0].low))

    def invert(self, pv: Tensor, w: Tensor, g: Tensor) -> Tensor:
        """The same as in ObserverLaw."""
        start = self.low + self.part * self._before(w, g)
        g = candidates(self.model, pv, start + self.cuts)
        inside = self._before(w, g)
        # The chord of the part in which the crossing lies: its ends are the two cuts around it.
        at = start + self.chord * inside
        ends = candidates(self.model, pv, torch.cat([at, at + self.chord], dim=-1))
        rise = ends[..., 1:] - ends[..., :1]
        flat = self.flat if self.rising else -self.flat
        steep = torch.maximum(rise, flat) if self.rising else torch.minimum(rise, flat)
        share = ((w - ends[..., :1]) / steep).clamp(0, 1)
        return at + self.chord * share

    def _before(self, w: Tensor, g: Tensor) -> Tensor:
        """Number (..., 1) of inner cuts before the crossing of g (..., SECTIONS + 1) with w."""
        inner = g[..., 1:-1]
        before = inner < w if self.rising else inner > w
        return before.to(w.dtype).sum(dim=-1, keepdim=True)
