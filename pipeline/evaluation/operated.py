"""Results of tests in which operators steer a law by more than set points: ranges, MVs out, rests, ranks, costs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

MOST_OUTSIDE: Final = 0.05  # share of time: a law stands two standard deviations inside, noise has it out for 2 %
LEAST_GAIN: Final = 0.9  # share of the optimum's gain: the law keeps off its ranges by what its model's error asks
LEAST_BORNE: Final = 0.99  # of the violation that ranges of the last rank bear: the ratio of prices is made for that
MOST_REST_MISS: Final = 0.02  # of an MV's range: what operators read off a bar
MOST_MOVED_OUT: Final = 1e-6  # of an MV's range while it is out of use: the solver's last digits


@dataclass(frozen=True, slots=True)
class OperatedLimits:
    """Limits of one test, each a share: time outside ranges that a steady state allows, at most; gain, at least."""

    most_outside: float = MOST_OUTSIDE
    least_gain: float = LEAST_GAIN


@dataclass(frozen=True, slots=True)
class RangeResult:
    """A PV and the range that it had at the end of a test.

    ``outside``: share of the samples since the first change at which it was outside the range of that sample by more
    than ``hidden`` [unit]; ``late``: the same over the end of the test, see ``OperatedLoop.late_s``. ``mean`` and
    ``most``: how far it was outside [unit], over these same samples. ``least``: how far the best steady state is
    outside [unit], 0 where one keeps all ranges; None where no model says so.
    """

    signal: str
    unit: str
    low: float
    high: float
    rank: float
    outside: float
    late: float
    mean: float
    most: float
    hidden: float
    least: float | None = None

    @property
    def allowed(self) -> bool:
        """Whether a steady state keeps this range, or nothing says that none does."""
        return not self.least


@dataclass(frozen=True, slots=True)
class MvResult:
    """An MV over a test: its travel [unit] with its first move, and the share of time at an operator's limit.

    ``travel_share`` is the travel in widths of its range; ``moved_out``: its largest move while it was out of use, in
    shares of its range; ``rest``: where it should be in the end, and ``miss`` how far it is from there [unit],
    ``miss_share`` in shares of its range. None where not asked.
    """

    signal: str
    unit: str
    travel: float
    travel_share: float
    clamped: float
    moved_out: float | None = None
    rest: float | None = None
    miss: float | None = None
    miss_share: float | None = None


@dataclass(frozen=True, slots=True)
class ErrorResult:
    """A PV with a set point: mean distance at the end from where the best steady state has it, and as a share.

    ``share`` is of what set points move it by.
    """

    signal: str
    unit: str
    error: float
    share: float


@dataclass(frozen=True, slots=True)
class OperatedLoop:
    """One closed loop of such a test, with noise on its readings; figures are of the true values.

    Profits are per hour, in the costs' currency: ``profit`` over the end of the test, from ``late_s`` [s] on, the last
    third since anything changed; ``before`` at the start, ``optimum`` of the best steady state of the plant itself, and
    ``gain`` the share of what was to be gained. ``borne``: share of the violation that the last rank bears, where
    two ranges of different ranks are at odds. None where there is nothing to be said.
    """

    duration_s: float
    late_s: float
    ranges: tuple[RangeResult, ...]
    mvs: tuple[MvResult, ...]
    errors: tuple[ErrorResult, ...] = ()
    profit: float | None = None
    before: float | None = None
    optimum: float | None = None
    gain: float | None = None
    borne: float | None = None
    refused: int = 0


@dataclass(frozen=True, slots=True)
class OperatedResult:
    """One test by its loops, each on a plant of its own, and the limits by which it is judged.

    The worst loop counts, of profits their mean.
    """

    title: str
    loops: tuple[OperatedLoop, ...]
    limits: OperatedLimits = field(default_factory=OperatedLimits)

    @property
    def late(self) -> float | None:
        """Largest share of time, at the end, outside a range that a steady state allows; None without a range."""
        return _most(one.late for one in self.ranges if one.allowed)

    @property
    def outside(self) -> float | None:
        """The same over the whole test."""
        return _most(one.outside for one in self.ranges if one.allowed)

    @property
    def ranges(self) -> Iterator[RangeResult]:
        """The ranges of all loops."""
        return (one for loop in self.loops for one in loop.ranges)

    @property
    def mvs(self) -> Iterator[MvResult]:
        """The MVs of all loops."""
        return (one for loop in self.loops for one in loop.mvs)

    @property
    def gain(self) -> float | None:
        """Share of the optimum's gain over all loops: the sum that was gained over the sum that could be."""
        known = [(o.profit, o.before, o.optimum) for o in self.loops if o.gain is not None]
        sums = [math.fsum(v for v in of if v is not None) for of in zip(*known, strict=True)]
        return (sums[0] - sums[1]) / (sums[2] - sums[1]) if sums else None

    def mean(self, what: str) -> float | None:
        """Mean of ``profit``, ``before`` or ``optimum`` per hour over the loops that have it; None where none has."""
        known = [value for one in self.loops if (value := getattr(one, what)) is not None]
        return math.fsum(known) / len(known) if known else None

    @property
    def borne(self) -> float | None:
        """Least share of the violation that the last rank bears."""
        return min((one.borne for one in self.loops if one.borne is not None), default=None)

    @property
    def miss(self) -> MvResult | None:
        """The MV that ends farthest from its resting value, by its range; None where none has one."""
        known = [one for one in self.mvs if one.miss_share is not None]
        return max(known, key=lambda one: one.miss_share or 0.0, default=None)

    @property
    def moved_out(self) -> MvResult | None:
        """The MV that moved farthest while it was out of use, by its range; None where none was out."""
        known = [one for one in self.mvs if one.moved_out is not None]
        return max(known, key=lambda one: one.moved_out or 0.0, default=None)

    @property
    def error(self) -> ErrorResult | None:
        """The PV that ends farthest from its set point, by what set points move it; None without a set point."""
        return max((e for loop in self.loops for e in loop.errors), key=lambda one: one.share, default=None)

    def figures(self) -> dict[str, float]:
        """The figures of the test as plain numbers, for a manifest, a leaderboard and a tracking server."""
        found = {
            "outside": self.outside,
            "outside_late": self.late,
            "beyond": _most(one.most for one in self.ranges if one.allowed),
            "profit_per_h": self.mean("profit"),
            "optimum_per_h": self.mean("optimum"),
            "gain": self.gain,
            "borne_by_last": self.borne,
            "rest_miss": None if self.miss is None else self.miss.miss_share,
            "travel": math.fsum(one.travel for one in self.mvs) / len(self.loops) if _one_unit(self.mvs) else None,
            "clamped": _most(one.clamped for one in self.mvs),
        }
        return {name: value for name, value in found.items() if value is not None}


def summary_of(tests: Mapping[str, OperatedResult]) -> dict[str, float]:
    """The two figures of a law over all such tests: the worst share of time outside, and the least share of gain."""
    late = _most(of for test in tests.values() if (of := test.late) is not None)
    gain = min((of for test in tests.values() if (of := test.gain) is not None), default=None)
    return {name: value for name, value in (("outside_late", late), ("gain", gain)) if value is not None}


def words_of(tests: Mapping[str, OperatedResult]) -> str:
    """The same in words; empty where neither was measured."""
    found = summary_of(tests)
    late, gain = found.get("outside_late"), found.get("gain")
    parts = [f"outside a range {100 * late:.3g} % of the time"] if late is not None else []
    parts += [f"{100 * gain:.3g} % of the profit to be gained"] if gain is not None else []
    return f"operators' changes: {', '.join(parts)}" if parts else ""


def _one_unit(mvs: Iterable[MvResult]) -> bool:
    """Whether the travels can be summed: those of unlike units cannot."""
    return len({one.unit for one in mvs}) == 1


def _most(values: Iterable[float]) -> float | None:
    return max(values, default=None)
