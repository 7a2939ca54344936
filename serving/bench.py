"""How long one step takes on this machine: called at once again, and once every 10 ms."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.clock import MonotonicClock
from loopwright.serving.controller import Controller
from loopwright.serving.loop import WARM_LEAD_S

WARM_UP = 1_000  # steps before the first that counts
FEEDS = 1_000  # different inputs, taken in turn: more would only fill the caches
WAIT_US = 20.0  # without the processor: a step that lost it for longer was disturbed
# Some systems count a thread's time in ticks, which tells nothing of a step.
TELLS = time.get_clock_info("thread_time").resolution < 1e-6


@dataclass(frozen=True, slots=True)
class Timing:
    """Percentiles of a step's duration [us], of all steps and of those that nothing disturbed.

    ``waited`` is the share [%] of steps in which the thread was without a processor for more than 20 us: another
    program had it, and the controller can do nothing about that. ``alone`` is the 99.9 % quantile of the others. Both
    are NaN where the system does not tell.
    """

    label: str
    p50: float
    p99: float
    p999: float
    waited: float
    alone: float

    @classmethod
    def of(cls, label: str, wall_ns: NDArray[np.float64], processor_ns: NDArray[np.float64]) -> Timing:
        """Percentiles of measured durations, and of the processor's time that each step had."""
        took = wall_ns / 1e3
        p50, p99, p999 = np.percentile(took, [50, 99, 99.9])
        free = took - processor_ns / 1e3 <= WAIT_US
        waited, alone = 100 * float(1 - free.mean()), np.percentile(took[free], 99.9) if free.any() else np.nan
        if not TELLS:
            waited = alone = np.nan
        return cls(label, float(p50), float(p99), float(p999), waited, float(alone))


def bench(
    controller: Controller, *, steps: int = 20_000, loop_steps: int = 1_000, period_s: float = 0.01
) -> tuple[Timing, ...]:
    """Step times hot, in a ``period_s`` loop as the control loop runs it, and there without the warm step.

    Inputs move a little from step to step around the middle of their ranges. The first steps do not count.
    """
    m, rng = controller.manifest, np.random.default_rng(0)
    middle = {n: np.array([s.middle for s in m.signals(n)]) for n in ("sp", "pv", "dv", "mv_applied")}
    # A discrete signal has no values a little away from another.
    span = {n: np.array([0.0 if s.values else s.high - s.low for s in m.signals(n)]) for n in middle}
    feeds = [{n: middle[n] + 0.01 * span[n] * rng.uniform(-1, 1, len(span[n])) for n in middle} for _ in range(FEEDS)]

    def run(label: str, n: int, wait: float | None, warm: bool) -> Timing:
        clock, state, took, had = MonotonicClock(), controller.cold_state(), np.ones(n), np.ones(n)
        start = clock.now() + 0.01
        for k in range(n):
            if wait is not None:
                if warm:
                    clock.sleep_until(start + k * wait - WARM_LEAD_S)
                    controller.warm()
                clock.sleep_until(start + k * wait)
            inputs = feeds[k % FEEDS]
            own = time.thread_time_ns()
            before = time.perf_counter_ns()
            state = controller.step(**inputs, state=state).state
            took[k] = time.perf_counter_ns() - before
            had[k] = time.thread_time_ns() - own
        return Timing.of(label, took, had)

    run("", min(steps, WARM_UP), None, False)
    every = f"every {period_s * 1e3:g} ms"
    return (
        run("hot", steps, None, False),
        run(f"{every}, warmed", loop_steps, period_s, True),
        run(f"{every}, cold", loop_steps, period_s, False),
    )


def table(timings: tuple[Timing, ...]) -> str:
    """The timings as plain text, with what disturbed them."""
    rows = [f"{'step [us]':<22}{'p50':>9}{'p99':>9}{'p99.9':>9}{'waited':>9}{'p99.9 of the others':>21}"]
    for t in timings:
        alone = f"{t.alone:.1f} = {t.alone / t.p50:.1f} p50"
        rows.append(f"{t.label:<22}{t.p50:>9.1f}{t.p99:>9.1f}{t.p999:>9.1f}{t.waited:>7.2f} %{alone:>21}")
    rows.append(f"waited: steps that were without a processor for more than {WAIT_US:g} us, as other programs had it")
    return "\n".join(rows)
