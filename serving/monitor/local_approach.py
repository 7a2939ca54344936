"""Whether the plant answers as at first: what the errors of predictions go with."""

from __future__ import annotations

from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest
from loopwright.serving.monitor.cusum import Chart
from loopwright.serving.monitor.learning import ANY, COUNT, SIZE, Kept, Remembers
from loopwright.serving.monitor.prediction_error import LEAST_SIGMA, SQUARES, BesideModel, log_mean_square, rms_ratio

Array: TypeAlias = NDArray[np.float64]

LEAST_SCORE = 1.0  # of a score: what white errors give


class Answers(Remembers):
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
        "told_square": SIZE,
        "squares": SIZE,
        "scores": ANY,
        "sizes": ANY,
        "shapes": ANY,
    }

    def __init__(
        self, manifest: Manifest, *, block: int, model: int, learn: int, weekly: float, rate: float, told: bool = False
    ) -> None:
        self.block, self.model_blocks = block, model
        self.model = BesideModel(manifest)
        self.n_told = len(manifest.sp) if told else 0
        n_y, n_phi = self.model.n_y + self.n_told, self.model.n_phi
        self.told_square = np.zeros(self.n_told)  # mean square of the law's errors while the model learnt
        self.blocks, self.count = 0, 0
        self.squares, self.scores = np.zeros(n_y), np.zeros((n_phi, n_y))
        self.sizes = Chart(n_y, learn, weekly=weekly, rate=rate / 2 / n_y, least=LEAST_SIGMA, both=False)
        self.shapes = Chart(n_phi * n_y, learn, weekly=weekly, rate=rate / 2 / n_phi / n_y, least=LEAST_SCORE)

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

    def add(self, pv: Array, mv: Array, error: Array | None, time_s: float) -> None:
        """One scan: PVs (n_pv,), the MV that goes to the plant now (n_mv,), the error of the law's own prediction."""
        found = self.model.add(pv, mv)
        if found is None or (self.n_told and error is None):
            return
        self.count += 1
        phi, errors = found
        told = None if error is None else error[: self.n_told]
        if self.model.frozen:
            errors = errors if told is None else np.concatenate([errors, told])
            self.squares = self.squares + errors**2
            self.scores = self.scores + phi[:, None] * errors
        elif told is not None:
            self.told_square = self.told_square + (told**2 - self.told_square) / min(self.model.scans, SQUARES)
        if self.count >= self.block:
            self.end(time_s, 1)

    def end(self, time_s: float, least: int) -> None:
        """The end of a block; one of fewer than ``least`` scans is not judged."""
        if self.count >= least:
            self.blocks += 1
            if not self.model.frozen:
                if self.blocks >= self.model_blocks:
                    self.model.freeze()
            else:
                squares = np.concatenate([self.model.square, self.told_square])
                sigma = np.sqrt(np.maximum(squares, 1e-18))
                scores = self.model.basis.T @ self.scores / (sigma * np.sqrt(self.count))
                self.sizes.add(log_mean_square(self.squares, self.count), time_s)
                self.shapes.add(scores.T.ravel(), time_s)
        self.drop()

    def drop(self) -> None:
        """Leave the present block out."""
        self.count, self.squares, self.scores = 0, np.zeros_like(self.squares), np.zeros_like(self.scores)

    def ratio(self, i: int) -> float:
        """The root mean square error of PV ``i`` of late over that of the time in which it learnt."""
        return rms_ratio(self.sizes.shift(i))

    def changed(self, i: int) -> float | None:
        """Since when PV ``i`` answers otherwise [s since 1970]; None where it does not."""
        n = self.model.n_phi
        found, since = self.shapes.found.reshape(-1, n) > 0, self.shapes.since_s.reshape(-1, n)
        rows = [i, self.model.n_y + i] if i < self.n_told else [i]
        return float(since[rows][found[rows]].min()) if found[rows].any() else None
