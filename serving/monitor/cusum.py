"""Whether figures have moved for good from what they were while they were learnt, and how long that takes."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil, isfinite, log, sqrt
from statistics import NormalDist
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest

# ---------------------------------------------------------------------------------------- knowledge as values and back
Range: TypeAlias = tuple[float, float]
Kept: TypeAlias = Mapping[str, Range]

ANY: Range = (-1e100, 1e100)  # ends of a number that is kept
POSITIVE: Range = (1e-100, 1e100)  # the same of a number above zero
SIZE_RANGE: Range = (0.0, 1e100)  # what cannot be negative
COUNT: Range = (0, 10**12)  # the same of a count of figures, scans or blocks
SIGN: Range = (-1, 1)  # the same of the side of the set point on which an error lies
TIME_S: Range = (0.0, 1e11)  # since 1970: to the year 5138
LONGEST_LIST = 1_000  # entries of a list that is kept


class KeepsState:
    """Keeps the attributes in ``KEPT``, each with the range of its numbers.

    An attribute is a number, a bool, a list of numbers, an array, or another that remembers; of the last the range
    is its own affair.
    """

    KEPT: ClassVar[Kept] = {}
    LATER: ClassVar[frozenset[str]] = frozenset()  # that a memory of an older release has not: they stay as they are

    def memory(self) -> dict[str, Any]:
        """The attributes, JSON-ready."""
        return {name: _out(getattr(self, name)) for name in self.KEPT}

    def recall(self, memory: Any) -> None:
        """Take them back. ValueError where one is missing, or of another kind, shape or range."""
        if not isinstance(memory, dict):
            raise ValueError(f"{_shown(memory)} in place of what a {type(self).__name__} keeps")
        for name, within in self.KEPT.items():
            if name not in memory and name in self.LATER:
                continue
            if name not in memory:
                raise ValueError(f"{name} is missing")
            setattr(self, name, _in(getattr(self, name), memory[name], name, within))


def number(kept: Any, name: str, within: Range) -> float:
    """A finite number in a range. ValueError for anything else."""
    if type(kept) not in {int, float} or not within[0] <= kept <= within[1]:  # NaN lies in no range
        raise ValueError(f"{name} is {_shown(kept)}; it must be a number in {within[0]:g} .. {within[1]:g}")
    return float(kept)


def _out(value: Any) -> Any:
    if isinstance(value, KeepsState):
        return value.memory()
    return value.tolist() if isinstance(value, np.ndarray) else value


def _in(present: Any, kept: Any, name: str, within: Range) -> Any:
    if isinstance(present, KeepsState):
        present.recall(kept)
        return present
    if isinstance(present, np.ndarray):
        return _array(present, kept, name, within)
    if isinstance(present, list):
        if not isinstance(kept, list) or len(kept) > LONGEST_LIST:
            raise ValueError(f"{name} is {_shown(kept)}; it must be a list of numbers")
        return [number(k, name, within) for k in kept]
    if isinstance(present, bool | int) and type(kept) is not type(present):
        raise ValueError(f"{name} is {_shown(kept)}; it must be of the kind {type(present).__name__}")
    if isinstance(present, bool):
        return kept
    value = number(kept, name, within)
    return kept if isinstance(present, int) else value


def _array(present: NDArray[np.float64], kept: Any, name: str, within: Range) -> NDArray[np.float64]:
    if not isinstance(kept, list):
        raise ValueError(f"{name} is {_shown(kept)}; it must be a list of numbers")
    try:
        array = np.array(kept)
    except (ValueError, OverflowError, RecursionError):
        raise ValueError(f"{name} is no array") from None
    if array.dtype.kind not in "iuf" or array.shape != present.shape:
        raise ValueError(f"{name} has the shape {array.shape} of {array.dtype}; it must be {present.shape} of numbers")
    array = array.astype(np.float64)
    if not (np.isfinite(array).all() and (array >= within[0]).all() and (array <= within[1]).all()):
        raise ValueError(f"{name} has numbers outside {within[0]:g} .. {within[1]:g}")
    return array


def _shown(kept: Any) -> str:
    """A value in a message, however long it is."""
    if isinstance(kept, float) and not isfinite(kept):
        return str(kept)
    text = repr(kept) if isinstance(kept, str | float | bool) or kept is None else type(kept).__name__
    return text if len(text) <= 40 else text[:40] + "..."


# ----------------------------------------------------------------------- how fast a loop is, and how long it is learnt
SETTLE_SCANS, LEAST_SETTLE_SCANS, MOST_SETTLE_SCANS = 100, 20, 2000  # scans
ANSWER_SCANS, MOST_ANSWER_SCANS = 2, 200  # scans from a move to the first answer
DAY_S, WEEK_S = 86_400.0, 7 * 86_400.0  # [s]
LEARN_S = 3 * DAY_S  # that rests and blocks are learnt at least: loads of a fast plant need not be fast
FINE_S = DAY_S  # that the fewest figures of a fast plant last at least
NOISE = "_noise"  # how the names of the validation's tests with noise end


def settle_scans(m: Manifest) -> int:
    """Scans of the loop's settling time: the median over the evidence's tests without noise, which would hide it.

    It is that of the closed loop after a move of its set point, and not the plant's own after a step of an MV.
    """
    rows = m.evidence.get("scenarios")
    known = {n: row for n, row in rows.items() if isinstance(row, dict)} if isinstance(rows, dict) else {}
    found = [row.get("settling") for name, row in known.items() if not name.endswith(NOISE)]
    times = sorted(float(v) for v in found if isinstance(v, int | float) and v > 0)
    scans = round(times[len(times) // 2] / m.period_s) if times else SETTLE_SCANS
    return min(max(scans, LEAST_SETTLE_SCANS), MOST_SETTLE_SCANS)


def answer_scans(m: Manifest) -> list[int]:
    """Scans after which each controlled variable first answers a move: the evidence's; ANSWER_SCANS if nobody knows.

    It is 1 without a dead time, which ``dead_time_periods`` counts so too.
    """
    told = m.evidence.get("dead_time_periods")
    known = told if isinstance(told, list) and len(told) == len(m.sp) else [None] * len(m.sp)
    return [k if type(k) is int and 1 <= k <= MOST_ANSWER_SCANS else ANSWER_SCANS for k in known]


def pooled(least: int, figure_s: float) -> tuple[int, int]:
    """(figures to learn, figures that make one): ``least`` made ones last FINE_S, all of them LEARN_S."""
    pool = max(ceil(FINE_S / figure_s / least), 1)
    return max(least, ceil(LEARN_S / (pool * figure_s))) * pool, pool


def blocks(least: int, shortest_s: float) -> tuple[float, float]:
    """(seconds of a block, times ``least`` blocks that are learnt): ``least`` last FINE_S, all of them LEARN_S."""
    block_s = max(shortest_s, FINE_S / least)
    return block_s, max(LEARN_S / (least * block_s), 1.0)


Array: TypeAlias = NDArray[np.float64]

CUSUM_SLACK = 1.0  # scatters by which a figure may lie off without a trace
LEARNT_DOUBT = 0.05  # that what was learnt of any one of a chart's figures flatters
SUM_OVERSHOOT = 1.166  # of a sum of normal figures over its limit, in scatters [Siegmund]
LEAST_LIMIT = 4.0  # in scatters: least limit of a sum, also before it has learnt
LEAST_ROOT = 0.2  # of chi2 / nu: the approximation holds no further
FEWEST_FREEDOMS = 3.0  # degrees of freedom that a scatter is believed to have at least
# independent figures that learning needs; how often it may last twice as long for them
LEARNING_WORTH, LEARNING_DOUBLINGS = 12.0, 2


class Chart(KeepsState):
    """Page's cumulative sums, upwards and downwards, for each of n figures x(j).

        up(j) = max(0, up(j-1) + z(j) - k),    down(j) = max(0, down(j-1) - z(j) - k),    z = (x - mean) / scatter

    ``found`` once a sum exceeds the limit, until it has fallen below half of it. A z counts at most half a limit, so
    that it takes three figures at least; a sum never exceeds twice the limit, so a shift that is over is forgotten. A
    shift that came back by itself was none of the plant's: the limit becomes ``RISE`` times as large, ``RISES`` times
    at most.

    The first ``learn`` figures give mean, scatter s and correlation f = 1 + 2 sum rho: they are worth learn / f
    independent ones. Below LEARNING_WORTH of those, pairs are averaged, and learning lasts twice as long. Scatter and
    mean count with the unfavourable ends of their intervals, a higher scatter and a k above CUSUM_SLACK, at a level of
    LEARNT_DOUBT / n: of many figures one or two were calmer by chance than they will be. Where the scatter s is below
    ``least``, ``least`` takes its place and f (s / least)^2 that of f, but at least 1: z scatters by less then, and
    hangs together all the same. The limit is that of a sum of long-run variance f (a Brownian motion) whose mean time
    to a false alarm is A figures:

        limit = f / (2 k) ln(1 + 2 k^2 A / f) - 1.17,    A = figures a week / false alarms a week

    Sources: Page, "Continuous inspection schemes", Biometrika 41 (1954) 100; Siegmund, "Sequential Analysis" (1985),
    eq. 2.56.

    Parameters
    ----------
    n
        Figures.
    learn
        How many of each are learnt, after ``pool`` are averaged.
    weekly
        Figures a week, before pooling.
    rate
        False alarms a week that are allowed to one of the n.
    least
        Scatter below which a shift is not worth a word.
    both
        Whether a shift downwards matters, too.
    pool
        Figures that are averaged to one.
    """

    RISE, RISES = 1.5, 4
    MOST = 0.5  # of the limit that one figure counts
    KEPT: ClassVar[Kept] = {
        "pool": (1, 10**9),
        "doublings": (0, LEARNING_DOUBLINGS),
        "weekly": POSITIVE,
        "sums": ANY,
        "pooled": COUNT,
        "figures": ANY,
        "count": COUNT,
        "mean": ANY,
        "scatter": POSITIVE,
        "slack": SIZE_RANGE,
        "limit": POSITIVE,
        "up": SIZE_RANGE,
        "down": SIZE_RANGE,
        "last": ANY,
        "recent": ANY,
        "off": ANY,
        "offs": SIZE_RANGE,
        "found": (0, 1),
        "rises": (0, RISES),
        "began_s": TIME_S,
        "since_s": TIME_S,
    }

    def __init__(
        self, n: int, learn: int, *, weekly: float, rate: float, least: float = 0.0, both: bool = True, pool: int = 1
    ) -> None:
        self.n, self.learn, self.both, self.pool, self.least = n, learn, both, pool, least
        self.rate, self.weekly, self.doublings = rate, weekly, 0
        self.sums, self.pooled = np.zeros(n), 0
        self.figures, self.count = np.zeros((learn, n)), 0
        self.mean, self.scatter, self.slack, self.limit = np.zeros(n), np.ones(n), np.ones(n), np.full(n, LEAST_LIMIT)
        self.up, self.down, self.last, self.recent = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        # Sum and number of the figures since the present sums began, upwards and downwards.
        self.off, self.offs = np.zeros((2, n)), np.zeros((2, n))
        self.found, self.rises = np.zeros(n), np.zeros(n)  # found: 1 or 0
        self.began_s, self.since_s = np.zeros((2, n)), np.zeros(n)  # the present sums, the shift that was found

    @property
    def learnt(self) -> bool:
        """Whether it has seen enough."""
        return self.count >= self.learn

    @property
    def done(self) -> float:
        """Share of the learning time that is over."""
        return min((self.count + self.pooled / self.pool) / self.learn, 1.0)

    def shift(self, i: int) -> float:
        """By how much a figure lies off: since the shift began where one was found, else over the last ten or so."""
        if self.found[i]:
            return float(self._since()[i])
        return float(self.recent[i] - self.mean[i])

    def shares(self) -> Array:
        """The shifts of those that were found, in scatters (n,); 0 of the others."""
        return np.asarray(self.found * self._since() / self.scatter)

    def _since(self) -> Array:
        """Means of what figures lie off by since the larger sum began, (n,)."""
        means = self.off / np.maximum(self.offs, 1)
        return np.asarray(np.where(self.up >= self.down, means[0], means[1]))

    def add(self, x: Array, time_s: float) -> None:
        """One of each figure (n,)."""
        self.sums = self.sums + x
        self.pooled += 1
        if self.pooled < self.pool:
            return
        x = self.sums / self.pooled
        self.sums, self.pooled = np.zeros(self.n), 0
        self.last = x
        self.count += 1
        if self.count <= self.learn:
            self.figures[self.count - 1] = x
            if self.count == self.learn:
                self._reckon()
            return
        self._judge(x, time_s)

    def _reckon(self) -> None:
        self.mean, s = self.figures.mean(axis=0), self.figures.std(axis=0, ddof=1)
        f = correlation(self.figures)
        z = NormalDist().inv_cdf(1 - LEARNT_DOUBT / max(self.n, 1))
        wide = s * np.array([upper_scatter(self.learn / one - 1, z) for one in f.tolist()])
        self.scatter = np.maximum(wide, self.least) + 1e-12
        f = np.maximum(f * (wide / self.scatter) ** 2, 1.0)  # long-run variance of (x - mean) / scatter
        if self.n and self.learn / f.mean() < LEARNING_WORTH and self.doublings < LEARNING_DOUBLINGS:
            half = self.learn // 2
            self.figures[:half] = self.figures[: 2 * half].reshape(half, 2, self.n).mean(axis=1)
            self.count, self.pool, self.doublings = half, 2 * self.pool, self.doublings + 1
            return
        run_length = self.weekly / self.pool / self.rate * (2 if self.both else 1)
        self.slack = CUSUM_SLACK + z * np.sqrt(f / self.learn)
        self.limit = np.array([run_limit(CUSUM_SLACK, run_length, one) for one in f.tolist()])
        self.recent = self.mean.copy()
        self.figures = np.zeros((self.learn, self.n))

    def _judge(self, x: Array, time_s: float) -> None:
        self.recent = self.recent + (x - self.recent) / min(self.count - self.learn, 10)
        most = self.MOST * self.limit
        z = np.clip((x - self.mean) / self.scatter, -most, most)
        goes_on = np.array([self.up, self.down]) > 0
        self.began_s = np.where(goes_on, self.began_s, time_s)
        self.off = goes_on * self.off + x - self.mean
        self.offs = goes_on * self.offs + 1
        self.up = np.clip(self.up + z - self.slack, 0.0, 2 * self.limit)
        if self.both:
            self.down = np.clip(self.down - z - self.slack, 0.0, 2 * self.limit)
        largest = np.maximum(self.up, self.down)
        begins = (largest > self.limit) & (self.found == 0)
        over = (largest < self.limit / 2) & (self.found > 0)
        began_s = np.where(self.up >= self.down, self.began_s[0], self.began_s[1])
        self.since_s = np.where(begins, began_s, self.since_s)
        self.found = np.where(begins, 1.0, np.where(over, 0.0, self.found))
        rise = over & (self.rises < self.RISES)
        self.limit = np.where(rise, self.RISE * self.limit, self.limit)
        self.rises = self.rises + rise


def run_limit(slack: float, figures: float, f: float = 1.0) -> float:
    """The limit of a one-sided sum whose mean time to a false alarm is ``figures``; see ``Chart``."""
    limit = f / (2 * slack) * log(1 + 2 * slack**2 * figures / f) - SUM_OVERSHOOT
    return max(limit, LEAST_LIMIT)


def upper_scatter(freedom: float, z: float) -> float:
    """Factor on a scatter of so many degrees of freedom for the upper end of its interval.

    sqrt(nu / chi2(nu)), by Wilson's and Hilferty's chi2 = nu (1 - 2 / (9 nu) - z sqrt(2 / (9 nu)))^3, with the normal
    quantile z of the level.
    """
    nu = max(freedom, FEWEST_FREEDOMS)
    return 1 / sqrt(max(1 - 2 / (9 * nu) - z * sqrt(2 / (9 * nu)), LEAST_ROOT) ** 3)


def correlation(x: Array) -> Array:
    """1 + 2 sum rho of each column of x (n, m), by the means of ever longer pieces: the largest that is found.

    Pieces of b figures have the variance f s^2 / b, where b is longer than the correlation. At least eight pieces.
    """
    n = len(x)
    off = x - x.mean(axis=0)
    variance = np.maximum((off**2).mean(axis=0), 1e-300)
    found = np.ones(x.shape[1])
    for b in sorted({int(1.5**i) for i in range(2, 30) if 1.5**i < n // 8} | {n // 8}):
        means = off[: n // b * b].reshape(n // b, b, -1).mean(axis=1)
        found = np.maximum(found, b * (means**2).mean(axis=0) / variance * (n // b) / (n // b - 1))
    # The mean of n figures is theirs: what lies off it scatters less than the figures, by f / n.
    return np.minimum(found / np.maximum(1 - found / n, 0.5), n / (FEWEST_FREEDOMS + 1))
