"""The search for a structure as work that the members of an ensemble share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from loopwright.pipeline.historian.answers import Beside, beside_record
from loopwright.pipeline.historian.feedback import fed_back
from loopwright.pipeline.models.identified.knowledge import Knowledge
from loopwright.pipeline.models.identified.rounds import Rounds
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales, folds, informative
from loopwright.pipeline.models.identified.selection import Selection, select
from loopwright.pipeline.models.identified.structure import Budget, Problem
from loopwright.pipeline.models.part import Groundwork, Source

MINUTES = 2.0
"""Budget for each output, in minutes of one core."""

MORE = 3
"""Times as many rows of a record in closed loop: little of it tells of the plant, and one-step errors are quick."""


@dataclass(frozen=True, slots=True, eq=False)
class Searched:
    """The problem that was searched, its outcome, the scales of its record, and what is known beside that record."""

    problem: Problem
    selection: Selection
    scales: Scales
    known: Sequence[Beside] = ()


@dataclass(frozen=True, slots=True)
class StructureSearch(Groundwork[Searched]):
    """The choices of params.yaml that decide the search."""

    kind: str
    all_measured: bool  # all PVs are outputs, not the controlled ones alone
    orders: tuple[int, int] | None
    lagged: bool
    units: tuple[int, ...]
    correction: float | None
    minutes: float | None
    rows: int

    def done(self, source: Source, label: str) -> Searched:
        """The search over the source's record; ModelError where it cannot carry a model."""
        seen = source.data(self.kind)
        n_y, n_mv = len(source.signals.pv if self.all_measured else source.signals.sp), len(source.signals.mv)
        back = seen.fed_back or fed_back(seen.mv, seen.pv[:, :n_y], seen.run)
        record = informative(seen, MORE * self.rows if back else self.rows)
        scales = Scales.of(record, n_y)
        data = ScaledRecord.of(record, scales)
        signals = source.signals
        inputs, outputs = [s.name for s in (*signals.mv, *signals.dv)], [s.name for s in signals.pv[:n_y]]
        # No model is bent to what the record is certain to contradict: that is asked, and answered by a person.
        beside = beside_record(source.known, record)
        used = [one.known for one in beside if not one.question]
        known = Knowledge.of(used, outputs, inputs, scales, signals.period_s)
        problem = Problem(data, folds(record), n_mv, source.seed, self.correction or 0.0, fed_back=back, known=known)
        budget = Budget(60 * (MINUTES * n_y if self.minutes is None else self.minutes), len(data), n_y)
        least, most = self.orders or (max(2, n_y), 8 + 2 * (n_y - 1))
        orders = range(max(least, n_y), max(most, n_y) + 1)
        rounds = Rounds(problem, budget, label)
        selection = select(rounds, orders=orders, units=self.units, correction=self.correction, lagged=self.lagged)
        return Searched(
            replace(problem, settles=selection.settles, farthest=selection.farthest), selection, scales, beside
        )

    def plainer(self, found: Searched) -> Searched | None:
        """The linear model in the network's place: it may be proven where the network bends by what is not the MVs'."""
        if not found.selection.nonlinear:
            return None
        return replace(found, selection=replace(found.selection, refused=True))
