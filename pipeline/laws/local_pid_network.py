"""The local controller network with its gains given: one PID an operating point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

from pipeline.errors import LawError
from pipeline.laws.base import LawSignals, require_kind
from pipeline.laws.local_controllers import Blending, LocalControllers, LocalPid
from pipeline.laws.local_stability import StabilityTest
from pipeline.models.base import Model
from pipeline.models.local_models import LocalModels
from pipeline.plants.base import Plant


class LocalPidNetwork(LocalControllers):
    """The paper's controllers, blended over the validity functions of the local models.

    Source: seed 004_643aaacd7e46828e.txt, section IV.C. Its settings are from a Ziegler-Nichols
    experiment and then corrected by hand; on these models, of relative degree two, proportional
    feedback in continuous time has no ultimate gain, so only the correction can have made them.
    """

    name: ClassVar[str] = "local_pid_network"
    title: ClassVar[str] = "Local controller network, printed gains"

    @dataclass(frozen=True, slots=True)
    class Params:
        """``kc`` [mv/pv], ``ti_s`` and ``td_s`` [s] of each local controller, in the order of the local models.

        ``blending``: what is blended (``gains``, ``outputs`` or ``velocity``, see LocalControllers).
        ``derivative_limit`` is N of the derivative's filter, Tf = Td/N. ``stability`` says how the
        closed loop is examined. ``mv_rate`` [mv] is the largest change a sample, None unlimited.
        The defaults are the printed settings.
        """

        kc: tuple[float, ...] = (2550.0, 331.0, 404.2, 2080.0, 20100.0)
        ti_s: tuple[float, ...] = (57.54, 30.72, 16.02, 26.04, 32.1)
        td_s: tuple[float, ...] = (13.2, 0.0, 0.0, 0.0, 0.0)
        blending: Blending = "gains"
        derivative_limit: float = 10.0
        stability: StabilityTest = field(default_factory=StabilityTest)
        mv_rate: float | None = None

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: LawSignals, plant: Plant) -> Self:
        """The law over the part ``local_models``; raises LawError."""
        p = params
        local = require_kind(models, LocalModels, cls.name)
        if not len(p.kc) == len(p.ti_s) == len(p.td_s) or not all(t > 0 for t in p.ti_s):
            raise LawError(
                f"law {cls.name!r} has {len(p.kc)} kc, {len(p.ti_s)} ti_s and {len(p.td_s)} td_s; give as many of "
                "each, every ti_s above 0"
            )
        pids = [LocalPid(k, k / ti, k * td) for k, ti, td in zip(p.kc, p.ti_s, p.td_s, strict=True)]
        return cls(
            signals,
            local,
            pids,
            blending=p.blending,
            derivative_limit=p.derivative_limit,
            stability=p.stability,
            mv_rate=p.mv_rate,
        )
