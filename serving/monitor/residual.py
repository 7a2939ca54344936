"""How well the next PV is foreseen: by the law where it tells, else by a model that is learnt beside it."""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.manifest import Manifest, Signal
from serving.monitor.cusum import Drift
from serving.monitor.memory import Remembers

Array: TypeAlias = NDArray[np.float64]

# Scans of a block: settling times, at least, at most. A linear model errs where set points move, so that each block
# must hold some of that.
TOLD, LEARNT = (2, 50, 500), (10, 200, 1000)
PAST_PV, PAST_MV = 2, 5  # samples that the learnt model looks back
LEAST_SIGMA = 0.2  # of the logarithm of a block's mean square


class Foresight(Remembers):
    """Errors of a one-step prediction of each controlled variable, in blocks.

    A law with ``next_<PV>`` in its info tells its prediction. For any other one

        y(k+1) = theta' [y(k), y(k-1), mv(k), ..., mv(k-4), 1],    all of their ranges,

    is learnt by recursive least squares over ``learn`` blocks and then frozen. The logarithm of each block's mean
    square goes, standardized by that of the next ``learn`` blocks, into a CUSUM upwards.
    """

    KEPT = ("theta", "p", "blocks", "sums", "count", "drifts")

    def __init__(self, manifest: Manifest, settle: int, learn: int) -> None:
        m = manifest
        self.learn = learn
        self.n_cv = len(m.sp)
        names = [f"next_{s.name}" for s in m.pv[: self.n_cv]]
        self.told = [m.info.index(n) for n in names] if all(n in m.info for n in names) else []
        scans, least, most = TOLD if self.told else LEARNT
        self.block = min(max(scans * settle, least), most)
        self._low_y, self._span_y = _ranges(m.pv)
        self._low_u, self._span_u = _ranges(m.mv)
        n = PAST_PV * len(m.pv) + PAST_MV * len(m.mv) + 1
        self.theta, self.p = np.zeros((n, self.n_cv)), 100.0 * np.eye(n)
        self.past = np.zeros(n)
        self.past[-1] = 1.0
        self.filled = 0
        self.blocks, self.count = 0, 0
        self.sums = np.zeros(self.n_cv)
        self.drifts = [Drift(learn, LEAST_SIGMA) for _ in range(self.n_cv)]
        self._expected: Array | None = None

    @property
    def learnt(self) -> bool:
        """Whether both the model and the scatter of its errors are known."""
        return all(drift.learnt for drift in self.drifts)

    def forget(self) -> None:
        """The samples before a gap say nothing of the next."""
        self._expected, self.filled = None, 0

    def add(self, pv: Array, mv: Array, info: Array | None, time_s: float) -> None:
        """One scan: PVs (n_pv,), the MV that goes to the plant now (n_mv,), the law's info."""
        y = (pv - self._low_y) / self._span_y
        if self._expected is not None:
            self._block((y[: self.n_cv] - self._expected) ** 2, time_s)
        if self.told:
            told = None if info is None else info[self.told]
            self._expected = None if told is None else (told - self._low_y[: self.n_cv]) / self._span_y[: self.n_cv]
            return
        if self.filled >= PAST_MV and self.blocks < self.learn:
            self._learn(y[: self.n_cv])
        n_y, n_u = len(y), len(mv)
        past = self.past
        past[n_y : PAST_PV * n_y] = past[: (PAST_PV - 1) * n_y].copy()
        past[:n_y] = y
        first, end = PAST_PV * n_y, PAST_PV * n_y + PAST_MV * n_u
        past[first + n_u : end] = past[first : end - n_u].copy()
        past[first : first + n_u] = (mv - self._low_u) / self._span_u
        self.filled += 1
        self._expected = past @ self.theta if self.filled >= PAST_MV else None

    def ratio(self, i: int) -> float:
        """The last block's root mean square error over that of the time in which it learnt."""
        drift = self.drifts[i]
        return float(np.exp((drift.last - drift.mean) / 2))

    def _learn(self, y: Array) -> None:
        phi = self.past
        p_phi = self.p @ phi
        gain = p_phi / (1.0 + phi @ p_phi)
        self.theta = self.theta + np.outer(gain, y - phi @ self.theta)
        self.p = self.p - np.outer(gain, p_phi)

    def _block(self, squares: Array, time_s: float) -> None:
        self.sums = self.sums + squares
        self.count += 1
        if self.count < self.block:
            return
        self.blocks += 1
        if self.told or self.blocks > self.learn:
            for drift, total in zip(self.drifts, self.sums.tolist(), strict=True):
                drift.add(log(total / self.count + 1e-18), time_s)
        self.sums, self.count = np.zeros(self.n_cv), 0


def _ranges(signals: Sequence[Signal]) -> tuple[Array, Array]:
    low = np.array([s.low for s in signals])
    return low, np.array([s.high for s in signals]) - low
