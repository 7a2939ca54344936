"""Numbers of one or several PID loops from closed loops over a plant, whatever its dynamics are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from math import copysign, isfinite

import numpy as np

from loopwright.pipeline.engine.progress import steps
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.tuning.responses import FirstOrder
from loopwright.pipeline.tuning.rules import PidSettings

Loops = tuple[PidSettings, ...]
"""Settings of each loop."""

Cost = Callable[[Sequence[Loops]], Array]
"""Costs of candidates, infinite where a loop breaks, all at once."""

SPEEDS = tuple(np.geomspace(0.5, 32.0, 10))  # closed-loop time constants, in dead times and periods
WEIGHTS = (1.0, 0.7, 0.4)  # set-point weights that are tried first, common to all loops
FIRST_GAINS, FIRST_INTEGRALS = (0.5, 0.7, 1.0, 1.4, 2.0), (0.4, 0.63, 1.0, 1.6, 2.5)  # factors, in the first round
DERIVATIVES, FILTERS = (0.0, 0.07, 0.15, 0.3), (0.125, 0.5)  # Td of Ti, Tf of Td
# factors of gains and integral times about the best ones, in the second round
SECOND_FACTORS = (0.8, 0.9, 1.0, 1.11, 1.25)
FINE_WEIGHTS = (
    0.2,
    0.3,
    0.5,
    0.6,
    0.8,
    0.9,
    1.0,
)  # set-point weights tried for each loop by itself, last in a round

# of a PI of last resort; half the gain is a gain margin twice the tuned loop's, and twice the plant's gain has a test
CALM_GAIN = 0.5
CALM_LAGS = 1.0  # time constants: as slow as the plant by itself, which no error of the model makes swing
CALM_DEAD_TIMES = 4.0  # dead times and periods: four times what a tight loop has


def simc(process: FirstOrder, period_s: float, tau_c_s: float) -> PidSettings:
    """The PI for a lag or an integrator with dead time, the sampling counted as half a period of dead time.

        Kc = 1/(rate (tau_c + theta)),   Ti = min(tau, 4 (tau_c + theta))

    Source: Skogestad, Simple analytic rules for model reduction and PID controller tuning, 2003.
    """
    closed = tau_c_s + process.dead_time_s + period_s / 2
    return PidSettings(1 / (process.rate * closed), min(process.tau_s, 4 * closed))


def calm(processes: Sequence[FirstOrder], period_s: float, tuned: Loops) -> Loops:
    """A PI for each loop, of half the tuned gain at most, and no faster than the plant itself: the last resort.

    A lag is controlled with a closed-loop time constant of ``CALM_LAGS`` of its own, and each process of at least
    ``CALM_DEAD_TIMES`` dead times and periods. Integral times are no shorter than the tuned ones. The tuned set-point
    weights and tracking times stay.
    """
    found = []
    for process, now in zip(processes, tuned, strict=True):
        slow = CALM_DEAD_TIMES * (process.dead_time_s + period_s)
        pi = simc(process, period_s, max(slow, CALM_LAGS * process.tau_s) if isfinite(process.tau_s) else slow)
        gain = min(abs(pi.kc), CALM_GAIN * abs(now.kc))
        calmer = replace(now, kc=copysign(gain, now.kc), ti_s=max(pi.ti_s, now.ti_s), td_s=0.0, filter_s=0.0)
        found.append(calmer)
    return tuple(found)


def searched(
    processes: Sequence[FirstOrder], period_s: float, cost: Cost, base: PidSettings, weight: float | None
) -> tuple[float, Loops]:
    """(cost, settings): all loops at the same speed at first, then each loop's numbers in turn, twice.

    ``processes`` are those of the pairs. ``weight`` is the set-point weight, None: chosen too. ``base`` gives the
    tracking time. Raises LawError where every candidate's cost is infinite.
    """
    show, rounds = steps("tuning in closed loops", 1 + 2 * len(processes)), 1
    weights = WEIGHTS if weight is None else (weight,)

    def common(speed: float, b: float) -> Loops:
        each = (simc(p, period_s, speed * (p.dead_time_s + period_s)) for p in processes)
        return tuple(replace(s, set_point_weight=b, tracking_s=base.tracking_s) for s in each)

    best = _cheapest(cost, [common(s, b) for s in SPEEDS for b in weights], (np.inf, ()))
    if not np.isfinite(best[0]):
        raise LawError("no PID gave a finite closed loop; check the MV's range or tune by hand (`manual`)")
    show(rounds)
    for gains, integrals in ((FIRST_GAINS, FIRST_INTEGRALS), (SECOND_FACTORS, SECOND_FACTORS)):
        for i in range(len(processes)):
            now = best[1][i]
            rows = [replace(now, kc=now.kc * g, ti_s=now.ti_s * t) for g in gains for t in integrals]
            best = _cheapest(cost, _others(best[1], i, rows), best)
            now = best[1][i]
            rows = [replace(now, td_s=d * now.ti_s, filter_s=f * d * now.ti_s) for d in DERIVATIVES for f in FILTERS]
            best = _cheapest(cost, _others(best[1], i, rows), best)
            if weight is None:
                rows = [replace(best[1][i], set_point_weight=b) for b in FINE_WEIGHTS]
                best = _cheapest(cost, _others(best[1], i, rows), best)
            rounds += 1
            show(rounds)
    return best


def _others(loops: Loops, i: int, rows: Iterable[PidSettings]) -> list[Loops]:
    return [(*loops[:i], row, *loops[i + 1 :]) for row in rows]


def _cheapest(cost: Cost, rows: list[Loops], best: tuple[float, Loops]) -> tuple[float, Loops]:
    costs = cost(rows)
    at = int(costs.argmin())
    return (float(costs[at]), rows[at]) if costs[at] < best[0] else best
