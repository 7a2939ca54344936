"""The set points over a horizon: as they are now, or a known recipe whose slope goes on."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class SetPoints(nn.Module):
    """Set points r(k+1) .. r(k+N) from those of now and, with ``ramp``, of the two samples before.

        held:  r(k+i) = r(k)
        ramp:  r(k+i) = clip(r(k) + i s),   s = the smaller of r(k) - r(k-1) and r(k-1) - r(k-2)

    s is 0 where the two changes differ in their signs or one is 0: a step of the set point is no ramp, and the slope
    of a recipe is believed from its second sample on. ``bounds`` are the ends of the clip: the CVs' soft limits, as a
    set point beyond a limit counts as one at the limit, and with ``ramp`` the signals' ranges too.
    """

    low: Tensor | None  # (N n_cv,) scaled
    high: Tensor | None
    samples: Tensor | None  # (N n_cv,) i

    def __init__(self, horizon: int, n_cv: int, bounds: tuple[Tensor, Tensor] | None, *, ramp: bool) -> None:
        super().__init__()
        self.horizon, self.ramp = horizon, ramp
        low, high = (None, None) if bounds is None else (end.repeat(horizon) for end in bounds)
        samples = torch.arange(1, horizon + 1, dtype=torch.float64).repeat_interleave(n_cv) if ramp else None
        for name, values in {"low": low, "high": high, "samples": samples}.items():
            self.register_buffer(name, values)

    def forward(self, now: Tensor, past: list[Tensor]) -> Tensor:
        """The set points (..., 1, N n_cv), from ``now`` (..., 1, n_cv); ``past`` [r(k-1), r(k-2)] with ``ramp``."""
        course = self._held(now)
        if self.samples is not None:
            last, older = past
            change, before = now - last, last - older
            slope = torch.minimum(torch.maximum(change, before.clamp(max=0.0)), before.clamp(min=0.0))
            course = course + self.samples * self._held(slope)
        if self.low is not None and self.high is not None:
            course = torch.minimum(torch.maximum(course, self.low), self.high)
        return course

    def _held(self, values: Tensor) -> Tensor:
        """Each of (..., 1, n_cv) at every sample of the horizon."""
        return values.repeat(*(1 for _ in values.shape[:-1]), self.horizon)
