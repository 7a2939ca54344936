"""The course of set points over a predictive law's horizon: held, with its slope, or as it is known."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Signals

UNBOUNDED = 1e6  # scaled: no set point comes near


class SetPointCourse(nn.Module):
    """Set points r(k+1) .. r(k+N) from those of now and, with ``ramp``, of the two samples before.

        held:    r(k+i) = r(k)
        ramp:    r(k+i) = clip(r(k) + i s),   s = the smaller of r(k) - r(k-1) and r(k-1) - r(k-2)
        course:  r(k+i) = r(k) + a(i),        a(i) as it is given

    s is 0 where the two changes differ in their signs or one is 0: a step of the set point is no ramp, and the slope
    of a recipe is believed from its second sample on. ``bounds`` are the ends of the clip: the CVs' soft limits, as a
    set point beyond a limit counts as one at the limit, and with ``ramp`` the signals' ranges too.
    """

    low: Tensor | None  # (N n_cv,) scaled
    high: Tensor | None
    samples: Tensor | None  # (N n_cv,) i

    def __init__(self, horizon: int, n_cv: int, bounds: tuple[Tensor, Tensor] | None, *, ramp: bool) -> None:
        super().__init__()
        self.horizon, self.n_cv, self.ramp = horizon, n_cv, ramp
        low, high = (None, None) if bounds is None else (end.repeat(horizon) for end in bounds)
        samples = torch.arange(1, horizon + 1, dtype=torch.float64).repeat_interleave(n_cv) if ramp else None
        for name, values in {"low": low, "high": high, "samples": samples}.items():
            self.register_buffer(name, values)

    def forward(self, now: Tensor, past: list[Tensor], later: Tensor | None = None) -> Tensor:
        """The set points (..., 1, N n_cv), from ``now`` (..., 1, n_cv); ``past`` [r(k-1), r(k-2)] with ``ramp``.

        ``later`` (..., 1, N n_cv) a(1) .. a(N), where the course is given.
        """
        course = self._held(now)
        if self.samples is not None:
            last, older = past
            change, before = now - last, last - older
            slope = torch.minimum(torch.maximum(change, before.clamp(max=0.0)), before.clamp(min=0.0))
            course = course + self.samples * self._held(slope)
        if later is not None:
            course = course + later
        if self.low is not None and self.high is not None:
            course = torch.minimum(torch.maximum(course, self.low), self.high)
        return course

    def _held(self, values: Tensor) -> Tensor:
        """Each of (..., 1, n_cv) at every sample of the horizon."""
        return values.repeat(*(1 for _ in values.shape[:-1]), self.horizon)


def course_of(
    signals: Signals, model: Identified, horizon: int, n_o: int, limits: tuple[Tensor, Tensor] | None, *, ramp: bool
) -> SetPointCourse:
    """The course of ``n_o`` set points over ``horizon`` samples; a ramp ends at the signals' ranges.

    ``limits`` are the soft ones of the CVs, scaled, (n_cv,) each.
    """
    n_cv, bounds = len(signals.sp), limits
    if ramp:
        ends = torch.tensor([(s.low, s.high) for s in signals.sp], dtype=torch.float64)
        low, high = ((end - model.y_center[:n_cv]) / model.y_scale[:n_cv] for end in ends.T)
        if limits is not None:
            low, high = (torch.minimum(torch.maximum(end, limits[0]), limits[1]) for end in (low, high))
        others = torch.full((n_o - n_cv,), UNBOUNDED, dtype=torch.float64)  # outputs without a set point
        bounds = torch.cat([low, -others]), torch.cat([high, others])
    return SetPointCourse(horizon, n_o, bounds, ramp=ramp)
