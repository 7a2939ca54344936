"""What the laws share that adapt PID gains at every sample to a linear model of the next one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from scipy.special import chdtri
from torch import Tensor, nn

from pipeline.errors import LawError
from pipeline.laws.gain_update import PidForm, gain_update
from pipeline.models.memory import Named, Slot, constant
from pipeline.plants.signals import Signals

Three = tuple[float, float, float]
CONFIDENCE = 0.99  # of the update criterion: noise alone trips it in one sample of a hundred


@dataclass(frozen=True, slots=True)
class AdaptiveParams:
    """Numbers of an adaptive PID; MVs count in units of half the MV's range, PVs in their own.

    Parameters
    ----------
    penalty
        Penalty mu > 0 of the move [pv^2].
    stiffness
        lambda > 0: what a change of the gains costs; small, it only tells equally good gains apart.
    weights
        How easily kc, Ki and Kd give way.
    gain_low, gain_high
        Bounds of kc, Ki = kc dt/tau_i and Kd = kc tau_d/dt [1/pv], 0 <= low < high.
    gains
        Where they start; None takes those of the model at the centre of its data.
    momentum
        gamma in [0, 1): share of the last change in the next one.
    window, noise_variance
        The gains stay as long as the mean square of the last ``window`` errors is what noise of this
        variance [pv^2] explains; None always updates.
    preview
        What is known of r(t+1): ``held``, as now; ``ramp``, as far on as it came with this sample.
    plant_gain
        Sign of dPV/dMV; ``auto`` takes the model's at the centre of its data.
    slope_min
        The model is acted on where its slope, in that sign, is above this [pv].
    mv_rate
        Largest change of the MV a sample [mv]; None is unlimited.
    """

    penalty: float = 1.0
    stiffness: float = 1e-3
    weights: Three = (1.0, 1.0, 1.0)
    gain_low: Three = (0.0, 0.0, 0.0)
    gain_high: Three = (10.0, 10.0, 10.0)
    gains: Three | None = None
    momentum: float = 0.0
    window: int | None = None
    noise_variance: float | None = None
    preview: Literal["held", "ramp"] = "held"
    plant_gain: Literal["auto", "positive", "negative"] = "auto"
    slope_min: float = 1e-3
    mv_rate: float | None = None

    def __post_init__(self) -> None:
        for name in ("penalty", "stiffness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be above 0")
        if not self.slope_min >= 0:
            raise ValueError(f"slope_min is {self.slope_min}; it must be 0 or above, or the guard lets everything pass")
        if not min(self.weights) > 0:
            raise ValueError(f"weights is {list(self.weights)}; each must be above 0")
        if not all(0 <= low < high for low, high in zip(self.gain_low, self.gain_high, strict=True)):
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
                f"the model's slope over the MV is {model_slope} at the centre of its data, so that it does not tell "
                "which way to move; give plant_gain: positive or negative"
            )
        sign = 1.0 if model_slope > 0 else -1.0
    mv = signals.mv[0]
    return sign * (mv.high - mv.low) / 2


def minimum_variance_gains(a: Tensor, slope: float, params: AdaptiveParams) -> Three:
    """The PID that moves as a linear model y(t) = -sum_i a_i y(t-i) + b u(t-1) + .. asks for at a held set point.

        (b^2 + mu) du = b [r - y0(t+1)],   r - y0 = e - sum_i a_i (e(t+1-i) - e(t-i))

    which is a PID for n_y <= 2, with g = b/(b^2 + mu): Ki = g, kc = g (1/2 - sum a_i), Kd = g a_2.
    Longer lags are gathered in Kd, and all is taken within the bounds. ``a`` (n_y,), ``slope`` b [pv].
    """
    g = slope / (slope**2 + params.penalty)
    later = sum(i * float(a_i) for i, a_i in enumerate(a))
    wanted = (g * (0.5 - float(a.sum())), g, g * later)
    kc, ki, kd = (min(max(z, lo), hi) for z, lo, hi in zip(wanted, params.gain_low, params.gain_high, strict=True))
    return kc, ki, kd


def target(p: Named, preview: str) -> Tensor:
    """The formula of r(t+1), as far as it is known."""
    return 2 * p["r"] - p["r1"] if preview == "ramp" else p["r"]


def target_slots(preview: str) -> dict[str, Slot]:
    """What ``target`` remembers: the last set point, where it must; the first sample holds."""
    return {"r1": Slot(1, lambda p: p["r"], lambda p: p["r"])} if preview == "ramp" else {}


class AdaptiveGains(nn.Module):
    """PID gains z = (kc, Ki, Kd) that follow a wanted move v of curvature c, within bounds.

        du = rho'z,   rho = (e - e1, (e + e1)/2, e - 2 e1 + e2),   e = r - y
        z  = the nearest gains whose move is nearest to v, see ``gain_update``
        dz = gamma dz1 + (1 - gamma) (z - z1),   z = clip(z1 + dz)           with ``momentum``

    The gains stay, and dz is forgotten, where the model's slope does not tell the way (the guard) or
    the mean square S of the last m errors is within noise: S <= var chi2(m, .99)/m. At the first
    sample e1 = e2 = e, so that a controller that starts on its set point, or takes over, does not
    kick. Moves are added to the MV that was applied, which is the anti-windup.

    A law gives ``slots`` to its Memory and ``terms`` to its Stage, and then calls ``update``,
    ``free``, ``settled`` and ``move`` in this order with the stage's results.

    Source: [chen2004, eqs 2-4, 19-28].

    Parameters
    ----------
    params, unit
        The numbers; one unit of move [mv] with its sign, see ``signed_unit``.
    start
        Gains without a past.
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
        numbers = {
            "unit": [unit],
            "lam": [params.stiffness],
            "weights": params.weights,
            "lo": params.gain_low,
            "hi": params.gain_high,
            "gamma": [params.momentum],
            "fresh_share": [1 - params.momentum],
            "threshold": [variance * float(chdtri(m, 1 - CONFIDENCE)) if m else 0.0],
            "slope_min": [params.slope_min],
            "by_unit": [1 / unit],
        }
        for name, values in numbers.items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64))
        first = torch.tensor(start, dtype=torch.float64)
        if not ((first >= self.lo) & (first <= self.hi)).all():
            raise LawError(f"the first gains are {list(start)}; they must lie within gain_low and gain_high")
        self.slots = {
            "e1": Slot(1, _error, _error),
            "e2": Slot(1, _error, lambda p: p["e1"]),
            "gains": Slot(3, constant(first)),
        }
        if self.filtered:
            self.slots["change"] = Slot(3, constant(torch.zeros(3, dtype=torch.float64)))
        if m > 1:  # squared errors, the newest first; without a past there were none
            nothing = constant(torch.zeros(m - 2, dtype=torch.float64))
            self.slots["squares"] = Slot(m - 2, nothing, lambda p: torch.cat([p["square"], p["squares"]], -1)[..., :-1])
            self.slots["square"] = Slot(1, constant(torch.zeros(1, dtype=torch.float64)))

    def terms(self, p: Named) -> dict[str, Tensor]:
        """Formulas of what the gains need of the past and the sample."""
        e = _error(p)
        found = {
            "rho": torch.cat([e - p["e1"], (e + p["e1"]) / 2, e - 2 * p["e1"] + p["e2"]], dim=-1),
            "gains": p["gains"],
            "mv": p["u"],
        }
        if self.filtered:
            found["change"] = self.gamma * p["change"]
        if self.window:
            found["error"] = e
        if self.window > 1:
            found["quiet"] = self.threshold - p["square"] - p["squares"].sum(dim=-1, keepdim=True)
        return found

    def update(self, now: Named, v: Tensor, c: Tensor) -> Tensor:
        """Gains (..., 3) for a wanted move v and its curvature c, (..., 1) each."""
        return gain_update(now["gains"], now["rho"], v, c, self.lam, self.weights, self.lo, self.hi)

    def free(self, now: Named, slope: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Whether the gains may change (..., 1), for a slope [pv] in the plant's sign; and what is remembered of it."""
        told = slope > self.slope_min
        if not self.window:
            return told, {}
        square = now["error"] * now["error"]
        loud = square > (now["quiet"] if self.window > 1 else self.threshold)
        return told & loud, {"square": square} if self.window > 1 else {}

    def settled(self, now: Named, z: Tensor, free: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The gains (..., 3) after filter and guard, and what is remembered of them."""
        if not self.filtered:
            z = torch.where(free, z, now["gains"])
            return z, {"gains": z}
        change = now["change"] + self.fresh_share * (z - now["gains"])
        change = torch.where(free, change, torch.zeros_like(change))
        # Filtered changes may lead out of the bounds although neither gains do.
        z = torch.minimum(torch.maximum(now["gains"] + change, self.lo), self.hi)
        return z, {"gains": z, "change": change}

    def step(self, now: Named, z: Tensor) -> Tensor:
        """The move du = rho'z in units, (..., 1), of gains (..., 3)."""
        return (now["rho"] * z).sum(dim=-1, keepdim=True)

    def told(self, z: Tensor, slope: Tensor, free: Tensor) -> Tensor:
        """``info``: kc [mv/pv], tau_i and tau_d [s], the slope [pv/mv], and whether the gains were free to change."""
        return torch.cat([self.form(z), slope * self.by_unit, free.to(z.dtype)], dim=-1)


def _error(p: Named) -> Tensor:
    return p["r"] - p["y"]
