"""The monitor's figures, by name."""

from __future__ import annotations

from math import inf, isfinite
from typing import TYPE_CHECKING

from loopwright.serving.monitor.residual import Foresight

if TYPE_CHECKING:
    from loopwright.serving.monitor.monitor import Monitor


def numbers(m: Monitor) -> dict[str, float]:
    """For those who draw it over months."""
    found = {"saturated_share": m.saturated.value, "hold_share": m.hold.value}
    if min(m.max_move) < inf:
        found["rate_limited_share"] = m.limited.value
    if m.domain is not None:
        found["outside_domain_share"] = m.outside.value
    for i, s in enumerate(m.manifest.sp):
        found[f"mean_error_{s.name}"] = m.errors[i].value * float(s.high - s.low)
        found[f"regularity_{s.name}"] = m.swings[i].regularity()
        if m.harris[i].count:
            found[f"harris_index_{s.name}"] = m.harris[i].value
        seen = m.residual
        if seen.chart.learnt if isinstance(seen, Foresight) else seen.sizes.learnt:
            found[f"residual_ratio_{s.name}"] = seen.ratio(i)
    if m.rest.learnt:
        for i, s in enumerate(m.manifest.mv):
            found[f"shift_at_rest_{s.name}"] = m.rest.chart.shift(i) * float(s.high - s.low)
            gain = m.rest.gain(i)
            if gain is not None:
                found[f"gain_ratio_{s.name}"] = gain[0]
    return {name: value for name, value in found.items() if isfinite(value)}
