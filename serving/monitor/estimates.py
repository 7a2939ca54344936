"""A law's own estimates of its model's error: offsets, loads, disturbances in its info."""

from __future__ import annotations

from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.monitor.chart import Chart
from loopwright.serving.monitor.memory import ANY, COUNT, SIZE, Kept, Remembers
from loopwright.serving.monitor.squares import LEAST_SIGMA, log_mean_square

Array: TypeAlias = NDArray[np.float64]


def estimated(info: tuple[str, ...]) -> list[int]:
    """Places of the info entries that estimate what the model does not explain."""
    return [i for i, n in enumerate(info) if n.startswith("load_") or n.endswith("offset") or n == "disturbance"]


class Estimates(Remembers):
    """The mean square of each estimate over blocks of ``block`` scans: its logarithm goes into a chart."""

    KEPT: ClassVar[Kept] = {"sums": SIZE, "count": COUNT, "chart": ANY}

    def __init__(self, info: tuple[str, ...], *, block: int, learn: int, weekly: float, rate: float) -> None:
        self.block = block
        self.places = estimated(info)
        self.names = [info[i] for i in self.places]
        n = len(self.places)
        self.chart = Chart(n, learn, weekly=weekly, rate=rate / max(n, 1), least=LEAST_SIGMA)
        self.sums, self.count = np.zeros(n), 0

    def add(self, info: Array | None, time_s: float) -> None:
        """One scan's info."""
        if info is None or not self.places:
            return
        self.sums = self.sums + info[self.places] ** 2
        self.count += 1
        if self.count >= self.block:
            self.chart.add(log_mean_square(self.sums, self.count), time_s)
            self.sums, self.count = np.zeros(len(self.places)), 0
