"""A linear model that is learnt beside the law: what the next PVs will be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.monitor.memory import ANY, COUNT, SIZE, Kept, Remembers

Array: TypeAlias = NDArray[np.float64]

PAST_PV, PAST_MV = 2, 5  # samples that it looks back
SQUARES = 1000  # scans over which squares of errors are averaged
DOUBT = 100.0  # variance of its numbers before it has learnt


class BesideModel(Remembers):
    """y(k+1) = theta' phi(k), phi = [y(k), y(k-1), mv(k), ..., mv(k-4), 1], all of their ranges.

    By recursive least squares, until ``freeze``. y are all PVs.
    """

    KEPT: ClassVar[Kept] = {"theta": ANY, "p": ANY, "scans": COUNT, "square": SIZE, "frozen": ANY}

    def __init__(self, manifest: Manifest) -> None:
        m = manifest
        self._low_y, self._span_y = ranges(m.pv)
        self._low_u, self._span_u = ranges(m.mv)
        self.n_y, self.n_u = len(m.pv), len(m.mv)
        self.n_phi = PAST_PV * self.n_y + PAST_MV * self.n_u + 1
        self.theta, self.p = np.zeros((self.n_phi, self.n_y)), DOUBT * np.eye(self.n_phi)
        self.scans, self.frozen = 0, False
        self.square = np.zeros(self.n_y)  # mean square of its errors while it learnt
        self._past = np.zeros(self.n_phi)
        self._past[-1] = 1.0
        n_y, n_u, first = self.n_y, self.n_u, PAST_PV * self.n_y  # where each entry of the next phi stands in this one
        self._older = np.arange(self.n_phi)
        self._older[n_y:first] -= n_y
        self._older[first + n_u : -1] -= n_u
        self._filled = 0
        self._basis: Array | None = None

    def forget(self) -> None:
        """The samples before a gap say nothing of the next."""
        self._filled = 0

    def add(self, pv: Array, mv: Array) -> tuple[Array, Array] | None:
        """One scan: (phi of the scan before, errors (n_pv,) of what it foresaw); None right after a gap."""
        y, past = (pv - self._low_y) / self._span_y, self._past
        told = None
        if self._filled >= PAST_MV:
            error = y - past @ self.theta
            told = past, error
            if not self.frozen:
                self._learn(past, error)
        first = PAST_PV * self.n_y
        self._past = past[self._older]
        self._past[: self.n_y] = y
        self._past[first : first + self.n_u] = (mv - self._low_u) / self._span_u
        self._filled += 1
        return told

    def freeze(self) -> None:
        """It has learnt enough."""
        self.frozen, self._basis = True, None

    @property
    def basis(self) -> Array:
        """W (n_phi, n_phi): over the learning time the entries of W' phi were uncorrelated with mean square 1."""
        if self._basis is None:
            values, vectors = np.linalg.eigh(self.p * max(self.scans, 1))
            self._basis = vectors * np.sqrt(np.maximum(values, 1e-12))
        return self._basis

    def _learn(self, phi: Array, error: Array) -> None:
        p_phi = self.p @ phi
        gain = (p_phi / (1.0 + phi @ p_phi))[:, None]
        self.theta = self.theta + gain * error
        self.p = self.p - gain * p_phi
        self.scans += 1
        # Errors of a model that is still wild say nothing of its noise.
        self.square = self.square + (error**2 - self.square) / max(min(self.scans, SQUARES), 20)


def ranges(signals: Sequence[Signal]) -> tuple[Array, Array]:
    """(low ends, widths) of signals, each (n,)."""
    low = np.array([s.low for s in signals])
    return low, np.array([s.high for s in signals]) - low
