"""The networks: units on the best linear candidates, ranked in rounds that keep fewer and train them longer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.models.identified.candidates import BEGINNING, Task
from pipeline.models.identified.rounds import Rounds
from pipeline.models.identified.structure import Structure
from pipeline.models.identified.trial import Trial, best_of

SEEDS = 3
"""Seeds of each network that reaches the last round."""

UNITS = (4, 8, 12)
"""Tanh units on offer."""

RIDGES = (1.0, 30.0)
"""Weights of the ridge on offer: the first in all rounds, the others for the winner."""

SHORT, MIDDLE, LONG = 20, 60, 120
"""Iterations of the first, the second and the last round."""

SECOND, LAST = 4, 2
"""Candidates of the second and of the last round."""


@dataclass(frozen=True, slots=True, eq=False)
class NetworkSearch:
    """The search among networks on some finished linear candidates."""

    rounds: Rounds
    linear: Sequence[Trial]

    def finalists(self, units: Sequence[int]) -> list[Trial]:
        """The candidates of the last round; none where the budget is spent or no number of units is given."""
        if not units or self.rounds.budget.left() <= 0:
            return []
        offers = self.rounds.affordable(_offers([t.structure for t in self.linear], units), BEGINNING + SHORT, 0.4)
        quick, _ = self.rounds.trials([self._task(s, 0, 0, SHORT) for s in offers], "networks")
        ranked = sorted((t for t in quick if np.isfinite(t.error)), key=lambda t: t.error)[:SECOND]
        if len(ranked) > LAST and self.rounds.budget.left(0.6) > 0:
            tasks = [self._task(t.structure, k, 0, MIDDLE, t) for t in ranked for k in self._folds]
            longer, _ = self.rounds.trials(tasks, "networks, both folds")
            ranked = sorted((t for t in longer if np.isfinite(t.error)), key=lambda t: t.error) or ranked
        found = self.last_round([t.structure for t in ranked[:LAST]])
        best = best_of(found)
        if best is not None and self.rounds.budget.left() > 0:
            found += self.last_round([replace(best.structure, ridge=ridge) for ridge in RIDGES[1:]])
        return found

    def last_round(self, structures: Sequence[Structure]) -> list[Trial]:
        """Candidates over all folds and as many seeds as the budget carries, one structure at least."""
        tasks: list[Task] = []
        left = self.rounds.budget.left()
        for seed in range(SEEDS):
            for s in structures:
                left -= len(self._folds) * self.rounds.budget.of(s, BEGINNING + LONG)
                if left >= 0 or not tasks:
                    tasks += [self._task(s, k, seed, LONG) for k in self._folds]
        return self.rounds.trials(tasks, "networks, all seeds")[0]

    @property
    def _folds(self) -> range:
        return range(len(self.rounds.problem.folds))

    def _task(self, structure: Structure, fold: int, seed: int, iterations: int, trial: Trial | None = None) -> Task:
        """A fit, gone on from the one of ``trial`` where there is one."""
        bases = (
            t for t in self.linear if replace(t.structure, correction=0.0) == replace(structure.base, correction=0.0)
        )
        base = next((t.fits[fold, 0] for t in bases if (fold, 0) in t.fits), None)
        begun = None if trial is None else trial.fits.get((fold, seed))
        return Task(structure, fold, iterations, seed, base=base, begun=begun)


def _offers(linear: Sequence[Structure], units: Sequence[int]) -> list[Structure]:
    """Networks to try: units on the best two balanced and the best two lagged candidates of each row convention."""
    groups = [
        [s for s in linear if s.start == start and s.same_row is same_row][:2]
        for same_row in (False, True)
        for start in ("balanced", "lagged")
    ]
    bases = [g[place] for place in (0, 1) for g in groups if len(g) > place]
    middle = units[len(units) // 2]
    first = [replace(b, n_hidden=middle, ridge=RIDGES[0]) for b in bases]
    rest = [replace(b, n_hidden=n, ridge=RIDGES[0]) for n in units if n != middle for b in bases[:3]]
    return [*first, *rest]
