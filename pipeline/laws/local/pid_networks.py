"""Local controller networks: with given gains, and tuned from their models by one knob."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import require_kind
from loopwright.pipeline.laws.local.local_controllers import BlendedParams, LocalControllers, LocalPid
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.local_models import LocalModels
from loopwright.pipeline.plants.simulator import Signals, Simulator
from loopwright.pipeline.plants.steady import Linearization
from loopwright.pipeline.tuning.rules import AllPole

DAMPING = 2.6  # of the triple of closed-loop poles: s^3 + 2.6 wc s^2 + 2.6 wc^2 s + wc^3
LEAST_DAMPING = 2.56  # 4 zeta^2 with zeta = 0.8, where a PI alone bounds the damping


class LocalPidNetwork(LocalControllers):
    """One PID an operating point, blended over the validity functions of the local models.

    Source: [gao2002, section IV.C].
    """

    name: ClassVar[str] = "local_pid_network"
    title: ClassVar[str] = "Local controller network, given gains"

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params(BlendedParams):
        """``kc`` [mv/pv], ``ti_s`` and ``td_s`` [s] of each local controller, in the order of the local models."""

        kc: tuple[float, ...]
        ti_s: tuple[float, ...]
        td_s: tuple[float, ...]

        def __post_init__(self) -> None:
            BlendedParams.__post_init__(self)
            if not len(self.kc) == len(self.ti_s) == len(self.td_s):
                raise ValueError(
                    f"there are {len(self.kc)} kc, {len(self.ti_s)} ti_s and {len(self.td_s)} td_s; give as many of "
                    "each as there are local models"
                )
            if not all(abs(k) > 0 for k in self.kc):
                raise ValueError(f"kc is {list(self.kc)}; none may be 0, or its controller would not act")
            if not all(t > 0 for t in self.ti_s):
                raise ValueError(f"ti_s is {list(self.ti_s)}; each must be above 0 s")
            if not all(t >= 0 for t in self.td_s):
                raise ValueError(f"td_s is {list(self.td_s)}; each must be 0 s or above, 0 for a PI")

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over the part ``local_models``; raises LawError."""
        local = require_kind(models, LocalModels, cls.name)
        settings = zip(params.kc, params.ti_s, params.td_s, strict=True)
        return cls.blended(params, signals, local, [LocalPid(k, k / ti, k * td) for k, ti, td in settings])


def one_knob(model: Linearization, wc: float) -> LocalPid:
    """The controller for a local model b/(s^2 + a1 s + a0) and a wanted speed ``wc`` [rad/s].

    Where the wanted damping exceeds the model's own (2.6 wc > a1), a PID places the three poles:

        Kd = (2.6 wc - a1)/b,   Kp = (2.6 wc^2 - a0)/b,   Ki = wc^3/b

    else the model is damped enough for a PI that cancels its slower pole p1 <= p2:

        Ti = 1/p1,   b Kp = min(w, p2^2/2.56),   w = wc (p2 - wc), or p2^2/4 where p2 <= 2 wc

    Raises LawError for a model that is not of this form, or a ``wc`` too slow for it.
    """
    process = AllPole.of(model)
    if len(process.poles) != 2 or not process.b0 > 0:
        raise LawError(
            f"one_knob tunes models b/(s^2 + a1 s + a0) with b > 0; got {len(process.poles)} poles "
            f"and b = {process.b0:.3g}"
        )
    a1, a0 = float(-process.poles.sum().real), float(process.poles.prod().real)
    if DAMPING * wc > a1:
        kp, ki, kd = DAMPING * wc**2 - a0, wc**3, DAMPING * wc - a1
        if not kp > 0:
            raise LawError(
                f"wc is {wc:.4g} rad/s, slower than a model that swings by itself at {np.sqrt(a0):.4g} rad/s can be "
                f"held: take more than {np.sqrt(a0 / DAMPING):.4g} rad/s"
            )
        return LocalPid(kp / process.b0, ki / process.b0, kd / process.b0)
    p2, p1 = np.sort(process.poles.real)  # both negative, the faster first
    if np.abs(process.poles.imag).max() > 0 or not p1 < 0:
        raise LawError(
            f"wc is {wc:.4g} rad/s, too slow for poles that swing or grow; take more than {a1 / DAMPING:.4g}"
        )
    slow, fast = -float(p1), -float(p2)
    wanted = fast**2 / 4 if fast <= 2 * wc else wc * (fast - wc)
    kp = min(wanted, fast**2 / LEAST_DAMPING) / process.b0
    return LocalPid(kp, kp * slow)


class AutoPidNetwork(LocalControllers):
    """A local controller network whose settings follow from its local models and one wanted speed.

    Source: what [gao2002, section V] leaves as further work; pole placement for
    a second-order model, after Astrom and Hagglund, Advanced PID Control, section 6.4.
    """

    name: ClassVar[str] = "auto_pid_network"
    title: ClassVar[str] = "Local controller network, one knob"

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params(BlendedParams):
        """``wc`` [rad/min] is the one knob: how fast the closed loop shall be at every operating point."""

        wc: float

        def __post_init__(self) -> None:
            BlendedParams.__post_init__(self)
            if not self.wc > 0:
                raise ValueError(f"wc is {self.wc}; give the wanted speed in rad/min, above 0")

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over the part ``local_models``; raises LawError."""
        local = require_kind(models, LocalModels, cls.name)
        pids = [one_knob(replace(lin, c=lin.c[:1]), params.wc / 60.0) for lin in local.linearizations()]
        return cls.blended(params, signals, local, pids)
