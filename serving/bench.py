"""How long one step takes on this machine: called at once again, and once every 10 ms."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from serving.clock import MonotonicClock
from serving.controller import Controller
from serving.loop import WARM_LEAD_S


@dataclass(frozen=True, slots=True)
class Timing:
    """Percentiles of a step's duration [us]."""

    label: str
    p50: float
    p99: float
    p999: float

    @classmethod
    def of(cls, label: str, nanoseconds: NDArray[np.float64]) -> Timing:
        """Percentiles of measured durations [ns]."""
        p50, p99, p999 = np.percentile(nanoseconds / 1e3, [50, 99, 99.9])
        return cls(label, float(p50), float(p99), float(p999))


def bench(
    controller: Controller, *, steps: int = 5_000, loop_steps: int = 500, period_s: float = 0.01
) -> tuple[Timing, ...]:
    """Step times hot, in a ``period_s`` loop as the control loop runs it, and there without the warm step.

    Inputs move a little from step to step around the middle of their ranges.
    """
    m, rng = controller.manifest, np.random.default_rng(0)
    middle = {n: np.array([s.middle for s in m.signals(n)]) for n in ("sp", "pv", "dv", "mv_applied")}
    # A discrete signal has no values a little away from another.
    span = {n: np.array([0.0 if s.values else s.high - s.low for s in m.signals(n)]) for n in middle}
    count = max(steps, loop_steps)
    feeds = [{n: middle[n] + 0.01 * span[n] * rng.uniform(-1, 1, len(span[n])) for n in middle} for _ in range(count)]

    def run(n: int, wait: float | None, warm: bool) -> NDArray[np.float64]:
        clock, state, took = MonotonicClock(), controller.cold_state(), np.empty(n)
        start = clock.now() + 0.01
        for k in range(n):
            if wait is not None:
                if warm:
                    clock.sleep_until(start + k * wait - WARM_LEAD_S)
                    controller.warm()
                clock.sleep_until(start + k * wait)
            before = time.perf_counter_ns()
            state = controller.step(**feeds[k], state=state).state
            took[k] = time.perf_counter_ns() - before
        return took

    run(min(steps, 200), None, False)
    every = f"every {period_s * 1e3:g} ms"
    return (
        Timing.of("hot", run(steps, None, False)),
        Timing.of(f"{every}, warmed", run(loop_steps, period_s, True)),
        Timing.of(f"{every}, cold", run(loop_steps, period_s, False)),
    )


def table(timings: tuple[Timing, ...]) -> str:
    """The timings as plain text."""
    rows = [f"{'step [us]':<22}{'p50':>9}{'p99':>9}{'p99.9':>9}"]
    rows += [f"{t.label:<22}{t.p50:>9.1f}{t.p99:>9.1f}{t.p999:>9.1f}" for t in timings]
    return "\n".join(rows)
