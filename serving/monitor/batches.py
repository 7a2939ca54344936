"""A batch beside earlier batches, at equal batch times: a batch never rests."""

from __future__ import annotations

from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest
from loopwright.serving.monitor.cusum import ANY, COUNT, WEEK_S, Chart, KeepsState, Kept
from loopwright.serving.monitor.loop_statistics import estimated, ranges
from loopwright.serving.monitor.plant_drift import Answers

Array: TypeAlias = NDArray[np.float64]

BATCH_PARTS = 8  # of a batch
LEAST_SCANS = 40  # of a batch
LEARN, MODEL = 20, 5  # batches
SAME_LENGTH, SAME_RECIPE = 0.1, 0.02  # of the first one's scans, of a set point's range
# batches that make a plant one of batches: an operator who takes a loop by hand now and then makes none
ALIKE_BATCHES = 3
OTHER_BATCHES = 5  # batches of another recipe in a row: it is the recipe now
LEAST_SHIFT = 0.002  # of a range: less is not worth a word
FOREVER = 10**9  # scans: a block ends with its batch alone


class BatchMeans(KeepsState):
    """Means over eighths of each batch: every MV, every PV, what the law estimates; and ``Answers`` of a batch.

    A batch is a stretch in AUTO that the operator, or the recipe, ends with MANUAL or SHADOW. The first one gives
    length and recipe; batches of another length or another recipe are not judged. ``LEARN`` batches tell what is
    normal. In a plant that runs on and on there are none, and nothing is computed.
    """

    KEPT: ClassVar[Kept] = {
        "length": COUNT,
        "recipe": ANY,
        "alike": COUNT,
        "others": COUNT,
        "sums": ANY,
        "counts": COUNT,
        "scans": COUNT,
        "chart": ANY,
        "answers": ANY,
    }

    def __init__(self, manifest: Manifest, rate: float) -> None:
        m = manifest
        self._period_s = m.period_s
        self._sp_low, self._sp_span = ranges(m.sp)
        self._mv_low, self._mv_span = ranges(m.mv)
        self._pv_low, self._pv_span = ranges(m.pv)
        self._places = estimated(m.info)
        self.names = [*(s.name for s in m.mv), *(s.name for s in m.pv), *(m.info[i] for i in self._places)]
        self.units = [*(s.unit for s in (*m.mv, *m.pv)), *("" for _ in self._places)]
        self.spans = np.concatenate([self._mv_span, self._pv_span, np.ones(len(self._places))])
        self._n = len(m.sp) + len(self.names)
        self.scans = 0
        self.sums, self.counts = np.zeros((BATCH_PARTS, self._n)), np.zeros(BATCH_PARTS)
        self._manifest, self._rate = m, rate
        self._begin(0)

    @property
    def known(self) -> bool:
        """Whether the plant makes batches at all."""
        return self.alike >= ALIKE_BATCHES

    def add(self, sample: tuple[Array, Array, Array, Array | None], time_s: float, fresh: Array | None = None) -> None:
        """One scan: set points, PVs, MVs, info; ``fresh`` (n_pv,) is 1 for new readings, None: all are."""
        sp, pv, mv, info = sample
        self.scans += 1
        if not self.length:
            return
        part = min((self.scans - 1) * BATCH_PARTS // self.length, BATCH_PARTS - 1)
        told = np.zeros(len(self._places)) if info is None else info[self._places]
        shares = (
            (sp - self._sp_low) / self._sp_span,
            (mv - self._mv_low) / self._mv_span,
            (pv - self._pv_low) / self._pv_span,
            told,
        )
        self.sums[part] += np.concatenate(shares)
        self.counts[part] += 1
        self.answers.add(pv, mv, None, time_s, fresh)

    def end(self, time_s: float) -> None:
        """The end of a stretch in AUTO."""
        scans, n_sp = self.scans, len(self._sp_span)
        if scans >= LEAST_SCANS:
            if not self.length:
                self._begin(scans)
            else:
                means = self.sums / np.maximum(self.counts, 1)[:, None]
                self._compare(means[:, :n_sp], means[:, n_sp:], time_s)
        self.answers.drop()
        self.answers.forget()
        self.sums, self.counts, self.scans = np.zeros((BATCH_PARTS, self._n)), np.zeros(BATCH_PARTS), 0

    def forget(self) -> None:
        """A fault: what the model expected is of no use."""
        self.answers.forget()

    def _begin(self, scans: int) -> None:
        """Learn batches of ``scans`` scans from here; 0: of the next one's."""
        self.length, self.alike, self.others = scans, 0, 0
        self.recipe = np.zeros((BATCH_PARTS, len(self._sp_span)))
        weekly, n = WEEK_S / (max(scans, 1) * self._period_s), BATCH_PARTS * len(self.names)
        self.chart = Chart(n, LEARN, weekly=weekly, rate=self._rate / 2 / n, least=LEAST_SHIFT)
        self.answers = Answers(
            self._manifest, block=FOREVER, model=MODEL, learn=LEARN, weekly=weekly, rate=self._rate / 2
        )

    def _compare(self, recipe: Array, means: Array, time_s: float) -> None:
        if self.alike == 0:
            self.recipe = recipe
        same = abs(self.scans - self.length) <= SAME_LENGTH * self.length
        same = same and bool((np.abs(recipe - self.recipe) <= SAME_RECIPE).all())
        if not same:
            self.others += 1
            if self.others >= OTHER_BATCHES:
                self._begin(0)
            return
        self.alike, self.others = self.alike + 1, 0
        self.chart.add(means.T.ravel(), time_s)
        self.answers.end(time_s, LEAST_SCANS // 2)

    def changed(self, i: int) -> tuple[int, float, float] | None:
        """(part of the batch, shift of its mean in the variable's unit, since when) of name ``i``; None: no change."""
        place = slice(i * BATCH_PARTS, (i + 1) * BATCH_PARTS)
        if not self.chart.found[place].any():
            return None
        part = int(np.argmax(np.abs(self.chart.shares()[place])))
        at = i * BATCH_PARTS + part
        return part, self.chart.shift(at) * float(self.spans[i]), float(self.chart.since_s[at])
