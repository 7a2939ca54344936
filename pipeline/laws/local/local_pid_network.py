"""The local controller network with its gains given: one PID an operating point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from pipeline.laws.base import require_kind
from pipeline.laws.local.local_controllers import BlendedParams, LocalControllers, LocalPid
from pipeline.models.base import Model
from pipeline.models.local.local_models import LocalModels
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator


class LocalPidNetwork(LocalControllers):
    """One PID an operating point, blended over the validity functions of the local models.

    Source: [gao2002, section IV.C].
    """

    name: ClassVar[str] = "local_pid_network"
    title: ClassVar[str] = "Local controller network, printed gains"

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
