"""From a law's input ``ahead`` to set points and measured disturbances over its horizon."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.preview.ahead import AheadInput, AheadSignal


def ahead_of(signals: Signals, horizon: int) -> AheadInput:
    """The input of a law over these signals: all set points, then all measured disturbances, over N samples."""
    listed = [("sp", s) for s in signals.sp] + [("dv", s) for s in signals.dv]
    return AheadInput(
        horizon,
        signals.period_s,
        tuple(AheadSignal(group, s.name, s.unit, s.low, s.high) for group, s in listed),  # type: ignore[arg-type]
    )


class KnownFuture(nn.Module):
    """Set points and measured disturbances at the samples 1 .. N, as scaled differences from their present values.

        r(k+i) = r(k) + a_r(i)/y_scale,   v(k+i) = v(k) + a_v(i)/v_scale,   i = 1 .. N

    with ``ahead`` a in engineering units. Zeros leave both as they are, to the last bit: what is added is zero. The
    differences of a disturbance count from its level, where the law has one: noise of a reading is no forecast.
    """

    sp_at: Tensor  # (N n_o,) where the differences of the set points stand; anywhere for outputs without one
    by_y: Tensor  # (N n_o,) 1/y_scale; 0 of outputs without a set point
    dv_at: Tensor  # (N n_dv,)
    by_v: Tensor  # (N n_dv,) 1/v_scale

    def __init__(self, ahead: AheadInput, model: Identified, n_o: int) -> None:
        super().__init__()
        n_sp, n = sum(s.group == "sp" for s in ahead.signals), len(ahead.signals)
        rows = torch.arange(ahead.horizon).unsqueeze(-1) * n
        outputs = torch.arange(n_o)
        by_y = torch.where(outputs < n_sp, 1 / model.y_scale[:n_o], 0.0)
        self.register_buffer("sp_at", (rows + torch.clamp(outputs, max=n_sp - 1)).flatten())
        self.register_buffer("by_y", by_y.repeat(ahead.horizon))
        self.register_buffer("dv_at", (rows + n_sp + torch.arange(n - n_sp)).flatten())
        self.register_buffer("by_v", (1 / model.v_scale[model.n_mv :]).repeat(ahead.horizon))

    def forward(self, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """Differences (..., 1, N n_o) of set points and (..., 1, N n_dv) of disturbances, of ``ahead`` (..., N n)."""
        given = ahead.unsqueeze(-2)
        return given.index_select(-1, self.sp_at) * self.by_y, given.index_select(-1, self.dv_at) * self.by_v
