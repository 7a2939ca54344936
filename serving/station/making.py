"""The control loop that settings describe."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.serving.clock import Clock
from loopwright.serving.controller import Controller
from loopwright.serving.endpoint import Endpoint
from loopwright.serving.loop import WARM_LEAD_S, ControlLoop, Mode
from loopwright.serving.proof import require_accepted
from loopwright.serving.station.settings import Settings


def control_loop(
    settings: Settings,
    controller: Controller,
    endpoint: Endpoint | None = None,
    *,
    sp: Sequence[float] | None = None,
    mv: Sequence[float] | None = None,
    clock: Clock | None = None,
) -> ControlLoop:
    """A loop with the guards, the fallback and the transfer of its settings. LoopError where they do not fit.

    ``sp`` (n_sp,) are the set points that it begins with, the middle of their ranges unless given; ``mv`` (n_mv,) is
    the MV that the plant has, None where it is not known.
    """
    s, m = settings, controller.manifest
    if s.start == "AUTO":
        require_accepted(m, s.accept_unproven)
    return ControlLoop(
        controller,
        endpoint,
        sp=[signal.middle for signal in m.sp] if sp is None else sp,
        mv=mv,
        mode=Mode(s.start),
        guards=lambda manifest: s.guards.of(manifest, s.max_age_s(manifest.period_s)),
        recover_after=s.hold.recover_after or None,
        clock=clock,
        warm_lead_s=WARM_LEAD_S * s.speed,
        transfer_s=s.over_s(m.period_s),
        fallback=s.hold.fallback(m.mv),
    )
