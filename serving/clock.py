"""Time for a loop: the machine's, or one that tests and simulations own."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Seconds that never go back."""

    def now(self) -> float:
        """Time [s] since some fixed instant."""

    def sleep_until(self, time_s: float) -> None:
        """Return at ``time_s`` [s] at the earliest; at once if that has passed."""


class EndingClock(Clock, Protocol):
    """A clock whose sleeps end early once nobody is to wait any more."""

    def end(self) -> None:
        """Let every sleep return, also one that has begun; from any thread."""


class Time(Protocol):
    """Time as a loop's machine has it, beside the clock of the scans."""

    def wall_s(self) -> float:
        """Seconds since 1970, which somebody may set."""

    def steady_s(self) -> float:
        """Seconds that never go back."""

    def wait(self, seconds: float) -> None:
        """Return after so many seconds."""

    def paced(self, speed: float) -> EndingClock:
        """A clock for scans, ``speed`` times as fast."""


class MachineTime:
    """The time of this machine."""

    def wall_s(self) -> float:
        """Seconds since 1970."""
        return time.time()

    def steady_s(self) -> float:
        """Seconds that never go back."""
        return time.monotonic()

    def wait(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(seconds)

    def paced(self, speed: float) -> EndingClock:
        """A clock for scans."""
        return MonotonicClock(speed)


MACHINE_TIME = MachineTime()


class MonotonicClock:
    """The machine's monotonic clock, ``speed`` times as fast.

    The last 0.4 ms before a deadline are spent spinning: a sleeping processor wakes up late and
    with cold caches, and that costs more than the step itself. After ``end`` nothing is waited for any more.
    """

    spin_s = 4e-4
    look_s = 0.2  # a long sleep looks so often whether it is to end

    def __init__(self, speed: float = 1.0) -> None:
        self.speed, self.ended = speed, False

    def now(self) -> float:
        """Machine time [s] times ``speed``."""
        return time.monotonic() * self.speed

    def sleep_until(self, time_s: float) -> None:
        """Sleep, then spin for the rest."""
        until = time_s / self.speed
        while (rest := until - time.monotonic() - self.spin_s) > 0 and not self.ended:
            time.sleep(min(rest, self.look_s))
        while time.monotonic() < until and not self.ended:
            pass

    def end(self) -> None:
        """Let every sleep return, also one that has begun; from any thread, and from the handler of a signal.

        A run on this clock needs a ``stop`` that is true from then on: without one it would scan without waiting.
        """
        self.ended = True


class VirtualClock:
    """Time that passes only by sleeping or by ``advance``: for tests, and for simulating at full speed."""

    def __init__(self, start_s: float = 0.0) -> None:
        self.time_s = start_s

    def now(self) -> float:
        """Virtual time [s]."""
        return self.time_s

    def sleep_until(self, time_s: float) -> None:
        """Jump to ``time_s``."""
        self.time_s = max(self.time_s, time_s)

    def end(self) -> None:
        """Nothing: no sleep lasts."""

    def advance(self, seconds: float) -> None:
        """Let ``seconds`` pass, as slow work would."""
        self.time_s += seconds
