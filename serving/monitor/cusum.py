"""Whether a standardized figure has moved from zero for good."""

from __future__ import annotations

from serving.monitor.memory import Remembers


class Cusum(Remembers):
    """Page's cumulative sums of a standardized figure z, upwards and downwards, z cut at ``most`` limits.

        up(j) = max(0, up(j-1) + z(j) - slack),    down(j) = max(0, down(j-1) - z(j) - slack)

    ``found`` once a sum exceeds the limit, until it has fallen below half of it. A sum never exceeds twice the limit,
    so a shift that is over is forgotten. While it ``learns`` the limit is the least one, and afterwards at least
    ``MARGIN`` times the greatest sum of that time: figures that hang together in time need more than theory's limit.
    A shift that came back by itself was none of the plant's: the limit becomes ``RISE`` times as large, ``RISES``
    times at most.

    Source: Page, "Continuous inspection schemes", Biometrika 41 (1954) 100.
    """

    KEPT = ("up", "down", "limit", "found", "began_s", "since_s", "rises")
    MARGIN, RISE, RISES = 2.5, 1.5, 4

    def __init__(self, slack: float = 1.0, limit: float = 12.0, both: bool = True, most: float = 0.5) -> None:
        self.slack, self.both, self.most = slack, both, most
        self.limit = limit
        self.up = self.down = 0.0
        self.found, self.rises = False, 0
        self.began_s = self.since_s = 0.0  # when the present sum began, when the shift that was found began

    def add(self, z: float, time_s: float, learning: bool = False) -> None:
        """One figure."""
        if self.up == 0.0 and self.down == 0.0:
            self.began_s = time_s
        largest = self.most * self.limit  # of a figure: a strange one alone is no shift
        z = min(max(z, -largest), largest)
        most = 1e9 if learning else 2 * self.limit
        self.up = min(max(0.0, self.up + z - self.slack), most)
        self.down = min(max(0.0, self.down - z - self.slack), most) if self.both else 0.0
        largest = max(self.up, self.down)
        if learning:
            self.limit = max(self.limit, self.MARGIN * largest)
        elif largest > self.limit and not self.found:
            self.found, self.since_s = True, self.began_s
        elif self.found and largest < self.limit / 2:
            self.found = False
            if self.rises < self.RISES:
                self.limit, self.rises = self.RISE * self.limit, self.rises + 1

    def begin(self) -> None:
        """Forget the sums of the time in which it learnt."""
        self.up = self.down = 0.0


class Drift(Remembers):
    """Whether a figure has moved from what it was while it was learnt.

    The mean and the standard deviation (at least ``least``) of the first ``learn`` figures standardize what follows,
    for a CUSUM.
    """

    KEPT = ("mean", "square", "count", "last", "cusum")

    def __init__(self, learn: int, least: float, both: bool = False) -> None:
        self.learn, self.least = learn, least
        self.mean = self.square = self.last = 0.0
        self.count = 0
        self.cusum = Cusum(both=both)

    @property
    def learnt(self) -> bool:
        """Whether it has seen enough."""
        return self.count >= self.learn

    @property
    def found(self) -> bool:
        """Whether the figure has moved."""
        return self.cusum.found

    def add(self, x: float, time_s: float) -> None:
        """One figure."""
        self.count += 1
        self.last = x
        learning = self.count <= self.learn
        if learning:
            off = x - self.mean
            self.mean += off / self.count
            self.square += (off * (x - self.mean) - self.square) / self.count
        elif self.count == self.learn + 1:
            self.cusum.begin()
        if self.count > self.learn // 4:  # the scatter is known roughly
            self.cusum.add((x - self.mean) / max(self.square**0.5, self.least), time_s, learning)
