"""Shared by the adaptive PID laws, which fit the gains at every sample to a linear one-step model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from scipy.special import chdtri
from torch import Tensor, nn

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import ControlLaw, OfRange, ascend, hold_numbers, in_units, require_single_loop
from loopwright.pipeline.laws.gain_update import PidForm, gain_update
from loopwright.pipeline.models.memory import Memory, Named, Slot
from loopwright.pipeline.plants.simulator import Signals

Three = tuple[float, float, float]
CONFIDENCE = 0.99  # of the update criterion: noise alone triggers it in 1 % of the samples


@dataclass(frozen=True, slots=True)
class AdaptiveParams:
    """Settings of an adaptive PID. Moves are in units of half the MV's range, errors in the PV's unit.

    Defaults in the PV's unit are shares of the range of its set point, see ``OfRange``.

    Parameters
    ----------
    penalty
        mu > 0, the weight of the move [pv^2].
    stiffness
        lambda > 0 [pv^4], the weight of a change of the gains; a small value only selects among equally good gains.
    weights
        How easily kc, Ki and Kd change.
    gain_low, gain_high
        Bounds of kc, Ki = kc dt/tau_i and Kd = kc tau_d/dt [1/pv], 0 <= low < high.
    gains
        First gains; None takes those of the model at the centre of its data.
    momentum
        gamma in [0, 1), the share of the last change in the next one.
    window, noise_variance
        The gains stay while noise of this variance [pv^2] explains the mean square of the last ``window`` errors.
        None: they always change.
    preview
        The assumed r(t+1): ``held``, equal to r(t); ``ramp``, r(t) plus its last change.
    plant_gain
        Sign of dPV/dMV; ``auto`` takes the model's sign at the centre of its data.
    slope_min
        The gains stay where the model's slope, in that sign, is not above this [pv].
    mv_rate
        Largest change of the MV per sample [mv]; None is unlimited.
    """

    penalty: float = OfRange(1e-3, 2)
    stiffness: float = OfRange(1e-9, 4)
    weights: Three = (1.0, 1.0, 1.0)
    gain_low: Three = (0.0, 0.0, 0.0)
    gain_high: Three = (OfRange(100.0, -1), OfRange(100.0, -1), OfRange(100.0, -1))
    gains: Three | None = None
    momentum: float = 0.0
    window: int | None = None
    noise_variance: float | None = None
    preview: Literal["held", "ramp"] = "held"
    plant_gain: Literal["auto", "positive", "negative"] = "auto"
    slope_min: float = OfRange(1e-4)
    mv_rate: float | None = None

    def __post_init__(self) -> None:
        for name in ("penalty", "stiffness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be above 0")
        if not self.slope_min >= 0:
            raise ValueError(f"slope_min is {self.slope_min}; it must be 0 or above, or the guard lets everything pass")
        if not min(self.weights) > 0:
            raise ValueError(f"weights is {list(self.weights)}; each must be above 0")
        if not all(low >= 0 and ascend(low, high) for low, high in zip(self.gain_low, self.gain_high, strict=True)):
            raise ValueError(
                f"gain_low is {list(self.gain_low)} and gain_high {list(self.gain_high)}; 0 <= low < high must hold"
            )
        if not 0 <= self.momentum < 1:
            raise ValueError(f"momentum is {self.momentum}; it must lie in [0, 1)")
        if self.window is not None and self.window < 1:
            raise ValueError(f"window is {self.window}; give a number of samples, or leave it out to update always")
        if (self.window is None) != (self.noise_variance is None):
            raise ValueError("window and noise_variance belong together; give both, or none to update always")
        if self.noise_variance is not None and not self.noise_variance > 0:
            raise ValueError(f"noise_variance is {self.noise_variance}; it must be above 0")


def signed_unit(signals: Signals, plant_gain: str, model_slope: float) -> float:
    """One unit of move [mv]: half the MV's range, in the direction that raises the controlled variable.

    ``model_slope`` is the model's dPV/dMV, which decides for ``auto``. Raises LawError where it is 0.
    """
    sign = {"positive": 1.0, "negative": -1.0}.get(plant_gain)
    if sign is None:
        if model_slope == 0 or model_slope != model_slope:
            raise LawError(
                f"the model's slope over the MV is {model_slope} at the centre of its data, which gives no "
                "direction of the move; give plant_gain: positive or negative"
            )
        sign = 1.0 if model_slope > 0 else -1.0
    mv = signals.mv[0]
    return sign * (mv.high - mv.low) / 2


def minimum_variance_gains(a: Tensor, slope: float, params: AdaptiveParams) -> Three:
    """Gains of the PID with the minimum-variance move of y(t) = -sum_i a_i y(t-i) + b u(t-1) + .. at a held set point.

        (b^2 + mu) du = b [r - y0(t+1)],   r - y0 = e - sum_i a_i (e(t+1-i) - e(t-i))

    which is a PID for n_y <= 2, with g = b/(b^2 + mu): Ki = g, kc = g (1/2 - sum a_i), Kd = g a_2.
    Longer lags add to Kd, and the bounds limit all gains. ``a`` (n_y,), ``slope`` b [pv].
    """
    g = slope / (slope**2 + params.penalty)
    later = sum(i * float(a_i) for i, a_i in enumerate(a))
    unbounded = (g * (0.5 - float(a.sum())), g, g * later)
    kc, ki, kd = (min(max(z, lo), hi) for z, lo, hi in zip(unbounded, params.gain_low, params.gain_high, strict=True))
    return kc, ki, kd


def target(p: Named, preview: str) -> Tensor:
    """The assumed set point r(t+1)."""
    return 2 * p["r"] - p["r1"] if preview == "ramp" else p["r"]


def target_slots(preview: str) -> dict[str, Slot]:
    """The memory of ``target``: the last set point for ``ramp``; at the first sample it is the present one."""
    return {"r1": Slot(1, lambda p: p["r"], lambda p: p["r"])} if preview == "ramp" else {}


class AdaptiveGains(nn.Module):
    """PID gains z = (kc, Ki, Kd) that follow a desired move v of curvature c, within bounds.

        du = rho'z,   rho = (e - e1, (e + e1)/2, e - 2 e1 + e2),   e = r - y
        z  = the nearest gains whose move is nearest to v, see ``gain_update``
        dz = gamma dz1 + (1 - gamma) (z - z1),   z = clip(z1 + dz)           with ``momentum``

    The gains stay and dz is 0 if the model's slope is too small (the guard), or if noise explains
    the mean square S of the last m errors: S <= var chi2(m, .99)/m. At the first sample
    e1 = e2 = e, so a start at the set point and a transfer from manual are bumpless. The law adds
    its move to the applied MV, which is the anti-windup.

    A law gives ``slots`` to its Memory and hands on what that recalls, ``p``. ``unit`` is one unit of
    move [mv] with its sign, see ``signed_unit``; ``start`` the gains without a past.

    Source: [chen2004, eqs 2-4, 19-28].
    """

    info: ClassVar[tuple[str, ...]] = ("kc", "tau_i_s", "tau_d_s", "b1", "updated")

    unit: Tensor  # (1,) [mv]
    lam: Tensor  # (1,)
    weights: Tensor  # (3,)
    lo: Tensor  # (3,)
    hi: Tensor  # (3,)
    gamma: Tensor  # (1,)
    fresh_share: Tensor  # (1,) 1 - gamma
    threshold: Tensor  # (1,) [pv^2] of the sum of the window's squared errors
    slope_min: Tensor  # (1,)
    by_unit: Tensor  # (1,) 1/unit

    def __init__(self, params: AdaptiveParams, signals: Signals, unit: float, start: Three) -> None:
        super().__init__()
        self.filtered = params.momentum > 0
        self.window = 0 if params.window is None else params.window
        m, variance = self.window, params.noise_variance or 0.0
        self.form = PidForm(signals.period_s, unit, params.gain_high)
        hold_numbers(
            self,
            unit=unit,
            lam=params.stiffness,
            weights=params.weights,
            lo=params.gain_low,
            hi=params.gain_high,
            gamma=params.momentum,
            fresh_share=1 - params.momentum,
            threshold=variance * float(chdtri(m, 1 - CONFIDENCE)) if m else 0.0,
            slope_min=params.slope_min,
            by_unit=1 / unit,
        )
        first = torch.tensor(start, dtype=torch.float64)
        if not ((first >= self.lo) & (first <= self.hi)).all():
            raise LawError(f"the first gains are {list(start)}; they must lie within gain_low and gain_high")
        self.slots = {
            "e1": Slot(1, _error, _error),
            "e2": Slot(1, _error, lambda p: p["e1"]),
            "gains": Slot(3, first),
        }
        if self.filtered:
            self.slots["change"] = Slot(3, torch.zeros(3, dtype=torch.float64))
        if m > 1:  # squared errors, the newest first; without a past there were none
            nothing = torch.zeros(m - 2, dtype=torch.float64)
            self.slots["squares"] = Slot(m - 2, nothing, lambda p: torch.cat([p["square"], p["squares"]], -1)[..., :-1])
            self.slots["square"] = Slot(1, torch.zeros(1, dtype=torch.float64))

    def errors(self, p: Named) -> Tensor:
        """Factors of the gains in the move: rho (..., 3)."""
        e, e1, e2 = _error(p), p["e1"], p["e2"]
        return torch.cat([e - e1, (e + e1) / 2, e - 2 * e1 + e2], dim=-1)

    def free(self, p: Named, slope: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """1 where the gains may change, else 0, (..., 1), for a slope [pv] in the plant's sign; and the next memory."""
        clear = slope > self.slope_min
        if not self.window:
            return clear.to(slope.dtype), {}
        square = _error(p) * _error(p)
        if self.window == 1:
            return (clear & (square > self.threshold)).to(slope.dtype), {}
        total = square + p["square"]
        if self.window > 2:
            total = total + p["squares"].sum(dim=-1, keepdim=True)
        return (clear & (total > self.threshold)).to(slope.dtype), {"square": square}

    def update(self, p: Named, rho: Tensor, v: Tensor, c: Tensor, free: Tensor) -> Tensor:
        """Gains (..., 3) for a desired move v and its curvature c, (..., 1) each; the last ones where not ``free``."""
        return gain_update(p["gains"], rho, v, c, self.lam, self.weights, self.lo, self.hi, free)

    def settled(self, p: Named, z: Tensor, free: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The gains (..., 3) after the filter, and the next memory."""
        if not self.filtered:
            return z, {"gains": z}
        change = free * (self.gamma * p["change"] + self.fresh_share * (z - p["gains"]))
        # A filtered change can leave the bounds even if both gains are within them.
        z = torch.minimum(torch.maximum(p["gains"] + change, self.lo), self.hi)
        return z, {"gains": z, "change": change}

    def info_of(self, z: Tensor, slope: Tensor, free: Tensor) -> Tensor:
        """``info``: kc [mv/pv], tau_i and tau_d [s], the slope [pv/mv], and 1 where the gains were free to change."""
        return torch.cat([self.form(z), slope * self.by_unit, free], dim=-1)


class AdaptivePid(ControlLaw):
    """A PID law whose gains follow a model: the memory of both. ``forward`` is the law's.

    Parameters
    ----------
    a, b
        The linear model at the centre of the data, as in ``minimum_variance_gains``, but b [pv/mv].
    model
        Returns the model, with its ``slots``, for one unit of move [mv].
    more, info
        The law's own slots; its info names after those of the gains.
    """

    velocity_form = True
    looks_ahead = 1
    model: Any

    def __init__(
        self,
        signals: Signals,
        params: AdaptiveParams,
        a: Tensor,
        b: float,
        model: Callable[[float], nn.Module],
        more: Mapping[str, Slot],
        info: tuple[str, ...],
    ) -> None:
        super().__init__(signals, params.mv_rate)
        require_single_loop(signals, self.name)
        params = in_units(params, signals, self.name)
        unit = signed_unit(signals, params.plant_gain, b)
        self.params, self.model = params, model(unit)
        self.gains = AdaptiveGains(params, signals, unit, params.gains or minimum_variance_gains(a, b * unit, params))
        self.memory = Memory({**target_slots(params.preview), **self.model.slots, **self.gains.slots, **more})
        self.n_state = self.memory.n_state
        self.info = (*AdaptiveGains.info, *info)


def move(rho: Tensor, z: Tensor) -> Tensor:
    """The PID's move du = rho'z in units, (..., 1), of gains (..., 3)."""
    return (rho * z).sum(dim=-1, keepdim=True)


def _error(p: Named) -> Tensor:
    return p["r"] - p["y"]
