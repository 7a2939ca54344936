"""The MV that a plant needs at rest, learnt over its set points: what a drift of the plant moves first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Signal
from loopwright.serving.monitor.cusum import Chart
from loopwright.serving.monitor.learning import ANY, COUNT, SIZE, Kept, Remembers

Array: TypeAlias = NDArray[np.float64]

KNOTS = 9  # of the map over each set point's range
NEAR = 0.3  # leverage below which the map knows a set point
LEAST_SIGMA = 0.01  # of the MV's range: less is no drift worth a word
SMALLEST_MOVE = 0.03  # of the MV's range: a smaller one says nothing of a gain
MOVES = 6  # that a gain needs
FORGET = 0.95  # a move
WILD = 0.25  # of the learning time in which the map is still too wild for its scatter to be known


class RestMap(Remembers):
    """mv_rest = theta' phi(sp), phi piecewise linear over each set point's range, by recursive least squares.

    It learns ``learn`` periods of rest and is frozen then, but where it has no data (leverage phi' P phi >= NEAR) it
    goes on learning. The distance between the map and the MV goes into a chart, averaged over ``pool`` periods; the
    moves of the MV from one set point to another beside those of the map tell the plant's gain, whatever the load is.
    """

    KEPT: ClassVar[Kept] = {
        "theta": ANY,
        "p": ANY,
        "judged": COUNT,
        "sxy": ANY,
        "sxx": SIZE,
        "syy": SIZE,
        "moves": SIZE,
        "last": ANY,
        "last_phi": ANY,
        "chart": ANY,
    }

    def __init__(
        self, sp: Sequence[Signal], mv: Sequence[Signal], *, learn: int, weekly: float, rate: float, pool: int = 1
    ) -> None:
        self.sp, self.mv = sp, mv
        figures = round((1 - WILD) * learn / pool)
        self.learn, self._wild = learn, learn - figures * pool
        n = KNOTS * len(sp)
        self._low = np.array([s.low for s in mv])
        self._span = np.array([s.high - s.low for s in mv])
        self.theta, self.p = np.zeros((n, len(mv))), 100.0 * np.eye(n)
        self.judged = 0
        self.sxy = self.sxx = self.syy = np.zeros(len(mv))  # of the moves: asked for by the map, made
        self.moves = 0.0
        self.last, self.last_phi = np.zeros(len(mv)), np.zeros(n)
        self.chart = Chart(len(mv), figures, weekly=weekly, rate=rate / len(mv), least=LEAST_SIGMA, pool=pool)

    @property
    def learnt(self) -> bool:
        """Whether it has seen enough."""
        return self.judged >= self.learn

    def add(self, sp: Array, mv: Array, time_s: float) -> None:
        """One period of rest: the set points (n_sp,) and the mean MV (n_mv,)."""
        phi, share = self._phi(sp), (mv - self._low) / self._span
        leverage = float(phi @ self.p @ phi)
        off = share - phi @ self.theta
        learnt = self.learnt
        if leverage < NEAR:
            self.judged += 1
            if self.judged > self._wild:
                self.chart.add(off, time_s)
        if leverage >= NEAR or not learnt:
            gain = self.p @ phi / (1.0 + leverage)
            self.theta = self.theta + np.outer(gain, off)
            self.p = self.p - np.outer(gain, phi @ self.p)
        if leverage < NEAR:
            self._move(phi, share)
        else:
            self.last_phi = np.zeros_like(phi)

    def gain(self, i: int) -> tuple[float, float] | None:
        """(gain over the learnt one, its standard error) for MV ``i``; None as long as too few moves were made."""
        if self.moves < MOVES or self.sxx[i] <= 0:
            return None
        slope = self.sxy[i] / self.sxx[i]
        left = max(self.syy[i] - slope * self.sxy[i], 0.0)
        error = float(np.sqrt(left / max(self.moves - 1, 1) / self.sxx[i]))
        return (1 / slope, error / slope**2) if slope > 0.05 else None

    def _move(self, phi: Array, share: Array) -> None:
        """From the period of rest before to this one, where the set points differ and the map is done."""
        if self.learnt and self.last_phi.any() and not np.array_equal(phi, self.last_phi):
            wanted, made = (phi - self.last_phi) @ self.theta, share - self.last
            if np.abs(wanted).max() > SMALLEST_MOVE:
                self.sxy = FORGET * self.sxy + wanted * made
                self.sxx = FORGET * self.sxx + wanted**2
                self.syy = FORGET * self.syy + made**2
                self.moves = FORGET * self.moves + 1
        self.last, self.last_phi = share, phi

    def _phi(self, sp: Array) -> Array:
        """Piecewise linear functions of each set point, one after the other; they sum to one for each."""
        phi = np.zeros(KNOTS * len(self.sp))
        for i, (s, value) in enumerate(zip(self.sp, sp.tolist(), strict=True)):
            place = min(max((value - s.low) / (s.high - s.low), 0.0), 1.0) * (KNOTS - 1)
            k = min(int(place), KNOTS - 2)
            phi[i * KNOTS + k], phi[i * KNOTS + k + 1] = k + 1 - place, place - k
        return phi
