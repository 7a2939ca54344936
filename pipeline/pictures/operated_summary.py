"""Lines of a simulated run on what operators asked for: time outside ranges, limits of MVs, rests, profit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from loopwright.pipeline.evaluation.closed_loop import RANGE_BAND
from loopwright.pipeline.evaluation.metric import NO_UNIT
from loopwright.pipeline.evaluation.ranges_kept import (
    mean_beyond,
    most_beyond,
    profit,
    rest_miss,
    share_clamped,
    share_outside,
)
from loopwright.pipeline.pictures.loop_picture import Array, History
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.serving.manifest import Signal

LATE_TENTH = 10  # parts of a run: the last one is where its MVs end


def operated_lines(plant: Simulator, history: History, noise: Array) -> Iterator[str]:
    """A line for each range, each MV that operators hold, and the profit; none for a law without ``operate``.

    ``noise`` (n_pv,) are the standard deviations that readings have: beyond them, and at least .2 % of its own range, a
    variable counts as outside. Profit is per hour, by the costs of each scan.
    """
    if not history.operate:
        return
    pv, mv = np.array(history.pv), np.array(history.mv)
    for i, s in enumerate(plant.pv_signals[: pv.shape[1]]):
        yield from _range(history, s, pv[:, i], float(noise[i]))
    for j, s in enumerate(plant.mv_signals):
        yield from _limits(history, s, mv[:, j])
    costs = [_costs(history, signals, len(pv)) for signals in (plant.pv_signals[: pv.shape[1]], plant.mv_signals)]
    if any(of.any() for of in costs):
        made = profit(pv, mv, costs[0], costs[1], plant.period_s)
        late = slice(-(len(pv) // LATE_TENTH + 1), None)
        end = profit(pv[late], mv[late], costs[0][late], costs[1][late], plant.period_s)
        yield f"profit {made:.5g} an hour by the costs, {end:.5g} over the last tenth of the run"


def _range(history: History, s: Signal, y: Array, noise: float) -> Iterator[str]:
    """The time that a PV was outside a range narrower than its own, while it was in use."""
    low, high, use = (history.of_entry(f"{s.name}.{what}") for what in ("low", "high", "use"))
    if low is None or high is None:
        return
    asked = (low > s.low) | (high < s.high)
    if use is not None:
        asked &= use > 0
    if not asked.any():
        return
    hidden = max(noise, RANGE_BAND * (s.high - s.low))
    y, low, high = y[asked], low[asked], high[asked]
    out, unit = 100 * share_outside(y, low, high, hidden), _unit(s)
    yield (
        f"{s.name} outside {low[-1]:g} … {high[-1]:g}{unit} by more than {hidden:.3g}{unit}: {out:.3g} % of the time, "
        f"by {mean_beyond(y, low, high):.3g}{unit} on average, {most_beyond(y, low, high):.3g}{unit} at most"
    )


def _limits(history: History, s: Signal, u: Array) -> Iterator[str]:
    """The time of an MV at operators' limits or out of use, and its distance from its resting value in the end."""
    low, high, use, rest, on = (
        history.of_entry(f"{s.name}.{what}") for what in ("low", "high", "use", "rest", "rest_use")
    )
    if low is not None and high is not None and (share := share_clamped(u, low, high, (s.low, s.high))):
        yield f"{s.name} at an operator's limit for {100 * share:.3g} % of the time"
    if use is not None and not use.all():
        yield f"{s.name} out of use for {100 * float(np.mean(use == 0)):.3g} % of the time"
    if rest is not None and on is not None and on[-1]:
        miss = rest_miss(u, float(rest[-1]), len(u) // LATE_TENTH + 1)
        yield f"{s.name} in the end {miss:.3g}{_unit(s)} from its resting value {rest[-1]:g}{_unit(s)}"


def _costs(history: History, signals: tuple[Signal, ...], n: int) -> Array:
    """Costs (n, signals) at each scan; 0 where the law has no such entry."""
    found = [history.of_entry(f"{s.name}.cost") for s in signals]
    return np.column_stack([np.zeros(n) if of is None else of for of in found])


def _unit(s: Signal) -> str:
    return "" if s.unit in NO_UNIT else f" {s.unit}"
