"""Drift of the plant: the MV that it needs at rest, and what the errors of predictions correlate with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.monitor.cusum import ANY, COUNT, SIZE_RANGE, Chart, KeepsState, Kept
from loopwright.serving.monitor.loop_statistics import LEAST_SIGMA, SQUARES, OnlineArx, log_mean_square, rms_ratio

Array: TypeAlias = NDArray[np.float64]

MAP_KNOTS = 9  # of the map over each set point's range
NEAR_LEVERAGE = 0.3  # leverage below which the map knows a set point
LEAST_DRIFT = 0.01  # of the MV's range: less is no drift worth a word
SMALLEST_MOVE = 0.03  # of the MV's range: a smaller one says nothing of a gain
GAIN_MOVES = 6  # that a gain needs
FORGET = 0.95  # a move
WILD = 0.25  # of the learning time in which the map is still too wild for its scatter to be known


class RestMap(KeepsState):
    """mv_rest = theta' phi(sp), phi piecewise linear over each set point's range, by recursive least squares.

    It learns ``learn`` periods of rest and is frozen then, but where it has no data (leverage phi' P phi >=
    NEAR_LEVERAGE) it goes on learning. The distance between the map and the MV goes into a chart, averaged over
    ``pool`` periods; the moves of the MV from one set point to another beside those of the map tell the plant's gain,
    whatever the load is.
    """

    KEPT: ClassVar[Kept] = {
        "theta": ANY,
        "p": ANY,
        "judged": COUNT,
        "sxy": ANY,
        "sxx": SIZE_RANGE,
        "syy": SIZE_RANGE,
        "moves": SIZE_RANGE,
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
        n = MAP_KNOTS * len(sp)
        self._low = np.array([s.low for s in mv])
        self._span = np.array([s.high - s.low for s in mv])
        self.theta, self.p = np.zeros((n, len(mv))), 100.0 * np.eye(n)
        self.judged = 0
        self.sxy = self.sxx = self.syy = np.zeros(len(mv))  # of the moves: asked for by the map, made
        self.moves = 0.0
        self.last, self.last_phi = np.zeros(len(mv)), np.zeros(n)
        self.chart = Chart(len(mv), figures, weekly=weekly, rate=rate / len(mv), least=LEAST_DRIFT, pool=pool)

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
        if leverage < NEAR_LEVERAGE:
            self.judged += 1
            if self.judged > self._wild:
                self.chart.add(off, time_s)
        if leverage >= NEAR_LEVERAGE or not learnt:
            gain = self.p @ phi / (1.0 + leverage)
            self.theta = self.theta + np.outer(gain, off)
            self.p = self.p - np.outer(gain, phi @ self.p)
        if leverage < NEAR_LEVERAGE:
            self._move(phi, share)
        else:
            self.last_phi = np.zeros_like(phi)

    def gain(self, i: int) -> tuple[float, float] | None:
        """(gain over the learnt one, its standard error) for MV ``i``; None as long as too few moves were made."""
        if self.moves < GAIN_MOVES or self.sxx[i] <= 0:
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
        phi = np.zeros(MAP_KNOTS * len(self.sp))
        for i, (s, value) in enumerate(zip(self.sp, sp.tolist(), strict=True)):
            place = min(max((value - s.low) / (s.high - s.low), 0.0), 1.0) * (MAP_KNOTS - 1)
            k = min(int(place), MAP_KNOTS - 2)
            phi[i * MAP_KNOTS + k], phi[i * MAP_KNOTS + k + 1] = k + 1 - place, place - k
        return phi


LEAST_SCORE = 1.0  # of a score: what white errors give


class Answers(KeepsState):
    """Errors e of a one-step model that is learnt beside the law, and of the law's own, over blocks of N scans.

    The model learns ``model`` blocks and is then frozen. Each further block gives, for each error,

        log(mean e^2),    and    s = sum W' phi e / (sigma sqrt(N)),

    where W' phi are the model's inputs, made uncorrelated. While nothing has changed every s has the mean it had; a
    parameter of the plant that is another one shifts the mean of some, whichever parameter it is. Both go into charts.

    Source: Benveniste, Basseville, Moustakides, "The asymptotic local approach to change detection and model
    validation", IEEE Trans. Automatic Control 32 (1987) 583.
    """

    KEPT: ClassVar[Kept] = {
        "model": ANY,
        "blocks": COUNT,
        "count": COUNT,
        "told_square": SIZE_RANGE,
        "squares": SIZE_RANGE,
        "scores": ANY,
        "sizes": ANY,
        "shapes": ANY,
        "readings": COUNT,
    }
    LATER = frozenset({"readings"})

    def __init__(
        self, manifest: Manifest, *, block: int, model: int, learn: int, weekly: float, rate: float, told: bool = False
    ) -> None:
        self.block, self.model_blocks = block, model
        self.model = OnlineArx(manifest)
        self.n_told = len(manifest.sp) if told else 0
        n_y, n_phi = self.model.n_y + self.n_told, self.model.n_phi
        self.told_square = np.zeros(self.n_told)  # mean square of the law's errors while the model learnt
        self.blocks, self.count = 0, 0
        self.squares, self.scores = np.zeros(n_y), np.zeros((n_phi, n_y))
        self.readings = np.zeros(n_y)  # new ones of each error
        self.sizes = Chart(n_y, learn, weekly=weekly, rate=rate / 2 / n_y, least=LEAST_SIGMA, both=False)
        self.shapes = Chart(n_phi * n_y, learn, weekly=weekly, rate=rate / 2 / n_phi / n_y, least=LEAST_SCORE)

    def recall(self, memory: Any) -> None:
        """Take them back; of an older release, which counted no readings, without its present block."""
        super().recall(memory)
        if "readings" not in memory:
            self.drop()

    @property
    def learnt(self) -> bool:
        """Whether both the model and the scatter of its errors are known."""
        return self.shapes.learnt

    @property
    def done(self) -> float:
        """Share of the learning time that is over."""
        learn = self.shapes.learn
        return min((min(self.blocks, self.model_blocks) + self.shapes.count) / (self.model_blocks + learn), 1.0)

    def forget(self) -> None:
        """The samples before a gap say nothing of the next."""
        self.model.forget()

    def add(self, pv: Array, mv: Array, error: Array | None, time_s: float, fresh: Array | None = None) -> None:
        """One scan: PVs (n_pv,), the MV that goes to the plant now (n_mv,), the error of the law's own prediction.

        PVs without a new reading (``fresh`` (n_pv,) 0) have no error; what stands for them is their last reading.
        """
        found = self.model.add(pv, mv, fresh)
        if found is None or (self.n_told and error is None):
            return
        self.count += 1
        phi, errors = found
        told = None if error is None else error[: self.n_told]
        if self.model.frozen:
            errors = errors if told is None else np.concatenate([errors, told])
            self.squares = self.squares + errors**2
            self.scores = self.scores + phi[:, None] * errors
            new = np.ones(self.model.n_y) if fresh is None else fresh
            self.readings = self.readings + np.concatenate([new, new[: self.n_told]])
        elif told is not None:
            change = (told**2 - self.told_square) / min(self.model.scans, SQUARES)
            self.told_square = self.told_square + (change if fresh is None else change * fresh[: self.n_told])
        whole = not self.model.frozen or self.readings.all() or self.learnt
        if self.count >= self.block and whole:
            self.end(time_s, 1)

    def end(self, time_s: float, least: int) -> None:
        """The end of a block; one of fewer than ``least`` scans is not judged, nor learnt without all readings."""
        if self.count >= least and (not self.model.frozen or self.readings.all() or self.learnt):
            self.blocks += 1
            if not self.model.frozen:
                if self.blocks >= self.model_blocks:
                    self.model.freeze()
            else:
                squares = np.concatenate([self.model.square, self.told_square])
                sigma = np.sqrt(np.maximum(squares, 1e-18))
                count, seen = np.maximum(self.readings, 1.0), self.readings > 0  # of the unseen: as at first
                scores = self.model.basis.T @ self.scores / (sigma * np.sqrt(count))
                self.sizes.add(np.where(seen, log_mean_square(self.squares, count), self.sizes.mean), time_s)
                shapes = np.where(np.repeat(seen, self.model.n_phi), scores.T.ravel(), self.shapes.mean)
                self.shapes.add(shapes, time_s)
        self.drop()

    def drop(self) -> None:
        """Leave the present block out."""
        self.count, self.squares, self.scores = 0, np.zeros_like(self.squares), np.zeros_like(self.scores)
        self.readings = np.zeros_like(self.readings)

    def ratio(self, i: int) -> float:
        """The root mean square error of PV ``i`` of late over that of the time in which it learnt."""
        return rms_ratio(self.sizes.shift(i))

    def changed(self, i: int) -> float | None:
        """Since when PV ``i`` answers otherwise [s since 1970]; None where it does not."""
        n = self.model.n_phi
        found, since = self.shapes.found.reshape(-1, n) > 0, self.shapes.since_s.reshape(-1, n)
        rows = [i, self.model.n_y + i] if i < self.n_told else [i]
        return float(since[rows][found[rows]].min()) if found[rows].any() else None
