"""How well the law itself foresees the next PV, where it tells what it expects."""

from __future__ import annotations

from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest
from loopwright.serving.monitor.beside import ranges
from loopwright.serving.monitor.chart import Chart
from loopwright.serving.monitor.memory import ANY, COUNT, SIZE, Kept, Remembers
from loopwright.serving.monitor.squares import LEAST_SIGMA, log_mean_square, rms_ratio

Array: TypeAlias = NDArray[np.float64]


class Foresight(Remembers):
    """Errors of ``next_<PV>`` of a law's info for each controlled variable, in blocks of ``block`` scans.

    The logarithm of each block's mean square goes into a chart upwards. ``told``: whether the law tells it at all.
    """

    KEPT: ClassVar[Kept] = {"sums": SIZE, "count": COUNT, "chart": ANY}

    def __init__(self, manifest: Manifest, *, block: int, learn: int, weekly: float, rate: float) -> None:
        m = manifest
        n_cv = self.n_cv = len(m.sp)
        names = [f"next_{s.name}" for s in m.pv[:n_cv]]
        self._places = [m.info.index(n) for n in names] if all(n in m.info for n in names) else []
        self.told = bool(self._places)
        self.block = block
        self._span = ranges(m.pv)[1][:n_cv]
        self.sums, self.count = np.zeros(n_cv), 0
        self.chart = Chart(n_cv, learn, weekly=weekly, rate=rate / n_cv, least=LEAST_SIGMA, both=False)
        self._expected: Array | None = None

    def forget(self) -> None:
        """The samples before a gap say nothing of the next."""
        self._expected = None

    def add(self, pv: Array, info: Array | None, time_s: float) -> Array | None:
        """One scan: PVs (n_pv,) and the law's info. The errors (n_cv,) of what it expected, of their ranges."""
        if not self.told:
            return None
        error = None
        if self._expected is not None:
            error = (pv[: self.n_cv] - self._expected) / self._span
            self.sums = self.sums + error**2
            self.count += 1
            if self.count >= self.block:
                self.chart.add(log_mean_square(self.sums, self.count), time_s)
                self.sums, self.count = np.zeros(self.n_cv), 0
        self._expected = None if info is None else info[self._places]
        return error

    def ratio(self, i: int) -> float:
        """The root mean square error of late over that of the time in which it learnt."""
        return rms_ratio(self.chart.shift(i))
