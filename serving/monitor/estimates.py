"""What a law itself estimates of its model's error: offsets, loads, disturbances in its info."""

from __future__ import annotations

from math import log
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.monitor.cusum import Drift
from serving.monitor.memory import Remembers

Array: TypeAlias = NDArray[np.float64]

LEAST_SIGMA = 0.2  # of the logarithm of a block's mean square
LEAST_SCANS = 20  # of a block


def estimated(info: tuple[str, ...]) -> list[int]:
    """Places of the info entries that estimate what the model does not explain."""
    return [i for i, n in enumerate(info) if n.startswith("load_") or n.endswith("offset") or n == "disturbance"]


class Estimates(Remembers):
    """The mean square of each estimate over blocks of ``block`` scans, or a batch: its logarithm goes into a CUSUM."""

    KEPT = ("sums", "count", "drifts")

    def __init__(self, info: tuple[str, ...], block: int, learn: int) -> None:
        self.block = block
        self.places = estimated(info)
        self.names = [info[i] for i in self.places]
        self.drifts = [Drift(learn, LEAST_SIGMA, both=True) for _ in self.places]
        self.sums, self.count = np.zeros(len(self.places)), 0

    def add(self, info: Array | None, time_s: float) -> None:
        """One scan's info."""
        if info is None or not self.places:
            return
        self.sums = self.sums + info[self.places] ** 2
        self.count += 1
        if self.count >= self.block:
            self.end(time_s)

    def end(self, time_s: float) -> None:
        """The end of a block, which a batch's end is too."""
        if self.count >= LEAST_SCANS:
            for drift, total in zip(self.drifts, self.sums.tolist(), strict=True):
                drift.add(log(total / self.count + 1e-18), time_s)
            self.sums, self.count = np.zeros(len(self.places)), 0
