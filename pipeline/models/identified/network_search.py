"""Networks: units on the best linear candidates, ranked in rounds that keep fewer and train them longer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.models.identified.candidates import (
    BEGINNING,
    FitTask,
    FoldStart,
    find_start,
    fit_candidate,
    judged_beyond_drift,
)
from loopwright.pipeline.models.identified.output_error import Fitted
from loopwright.pipeline.models.identified.structure import Budget, CandidateFits, Problem, Structure


@dataclass(frozen=True, slots=True, eq=False)
class Rounds:
    """Runs rounds of fits on one problem under one budget; ``label`` names them while they run.

    A round depends on its tasks and on nominal costs alone, never on how many processes share it.
    """

    problem: Problem
    budget: Budget
    label: str

    def starts(self, structures: Sequence[Structure]) -> dict[tuple[Structure, int], FoldStart | str]:
        """The starts under the shifts of some structures, on each fold."""
        tasks = [(s, fold) for s in structures for fold in range(len(self.problem.folds))]
        found = parallel_map(
            partial(find_start, self.problem), tasks, f"{self.label}: impulse responses from the record"
        )
        return dict(zip(tasks, found, strict=True))

    def fits(self, tasks: Sequence[FitTask], name: str) -> list[Fitted | str]:
        """The outcomes of some fits, in order. The dearest begin first, so that no core is left with one at the end."""
        costs = [self.budget.of(t.structure, t.iterations) for t in tasks]
        order = sorted(range(len(tasks)), key=lambda i: (-costs[i], i))
        in_order, weights = [tasks[i] for i in order], [costs[i] for i in order]
        found = parallel_map(partial(fit_candidate, self.problem), in_order, f"{self.label}: {name}", weights)
        outcomes: list[Fitted | str] = ["not fitted"] * len(tasks)
        for i, outcome in zip(order, found, strict=True):
            outcomes[i] = outcome
            done = 2 if isinstance(outcome, str) else outcome.work
            self.budget.spent += self.budget.of(tasks[i].structure, done)
        return outcomes

    def trials(self, tasks: Sequence[FitTask], name: str) -> tuple[list[CandidateFits], list[str]]:
        """(the candidates with the fits that succeeded, in order of their first task, reasons of the others)."""
        trials: dict[Structure, CandidateFits] = {}
        reasons = []
        for task, outcome in zip(tasks, self.fits(tasks, name), strict=True):
            if isinstance(outcome, str):
                reasons.append(outcome)
            else:
                trial = trials.setdefault(task.structure, CandidateFits(task.structure))
                trial.fits[task.fold, task.seed] = outcome
        return list(trials.values()), reasons

    def judged_beyond_drift(self, trials: Sequence[CandidateFits], rows: int) -> list[CandidateFits]:
        """The trials with held-out errors that leave out a gain and a level of each ``rows`` rows."""
        tasks = [(t.structure, fold, fitted) for t in trials for (fold, _), fitted in t.fits.items()]
        label = f"{self.label}: errors of the models over held-out rows, slow drift left out"
        found = iter(parallel_map(partial(judged_beyond_drift, self.problem, rows), tasks, label))
        return [CandidateFits(t.structure, {key: next(found) for key in t.fits}) for t in trials]

    def affordable(self, structures: Sequence[Structure], iterations: int, share: float) -> list[Structure]:
        """The first of some structures that ``iterations`` of each fit into ``share`` of the budget, one at least."""
        left, chosen = self.budget.left(share), list[Structure]()
        for structure in structures:
            left -= self.budget.of(structure, iterations)
            if chosen and left < 0:
                break
            chosen.append(structure)
        return chosen


NETWORK_SEEDS = (3, 6)
"""Fewest and most seeds of each network that reaches the last round; short records carry more of them."""

FIRST_ROUND_SEEDS = (2, 6)
"""The same of the first round, in which the best one counts: a free run has poor minima."""

UNITS = (4, 8, 12)
"""Tanh units on offer."""

RIDGES = (1.0, 30.0)
"""Weights of the ridge on offer: the first in the first round, all after it."""

SHORT_ITERATIONS, MIDDLE_ITERATIONS, LONG_ITERATIONS = 20, 50, 120
"""Iterations of the first, the second and the last round."""

SECOND_CANDIDATES, LAST_CANDIDATES = 6, 3
"""Candidates of the second and of the last round."""

SMALL_CARRIERS, VARIED_CARRIERS = 3, 4
"""Smallest balanced candidates that carry networks, and candidates that carry every number of units."""


@dataclass(frozen=True, slots=True, eq=False)
class NetworkSearch:
    """The search among networks on some finished linear candidates."""

    rounds: Rounds
    linear: Sequence[CandidateFits]

    def finalists(self, units: Sequence[int]) -> list[CandidateFits]:
        """The candidates of the last round; none where the budget is spent or no number of units is given."""
        if not units or self.rounds.budget.left() <= 0:
            return []
        offers = _offers([t.structure for t in self.linear], units)
        offers = self.rounds.affordable(offers, FIRST_ROUND_SEEDS[0] * (BEGINNING + SHORT_ITERATIONS), 0.4)
        cost = sum(self.rounds.budget.of(s, BEGINNING + SHORT_ITERATIONS) for s in offers)
        seeds = int(np.clip(self.rounds.budget.left(0.25) / cost, *FIRST_ROUND_SEEDS))
        tasks = [self._task(s, 0, seed, SHORT_ITERATIONS, last=False) for s in offers for seed in range(seeds)]
        quick = _ranked(self.rounds.trials(tasks, "neural networks, first training")[0])
        second = [
            self._task(replace(t.structure, ridge=ridge), k, _seed(t), MIDDLE_ITERATIONS, t, last=False)
            for t in quick[:SECOND_CANDIDATES]
            for ridge in RIDGES
            for k in self._folds
        ]
        longer = (
            self.rounds.trials(second, "the best networks, trained longer")[0]
            if self.rounds.budget.left(0.5) > 0
            else []
        )
        ranked = sorted((t for t in longer if np.isfinite(t.error)), key=lambda t: t.rank) or quick
        return self.last_round(ranked[:LAST_CANDIDATES])

    def last_round(self, trials: Sequence[CandidateFits]) -> list[CandidateFits]:
        """Candidates over all folds and as many seeds as the budget carries, one seed of one candidate at least.

        Fits that ``trials`` hold are gone on with.
        """
        tasks: list[FitTask] = []
        left = self.rounds.budget.left()
        least, most = NETWORK_SEEDS
        for place in range(most):
            for t in trials:
                seed = [_seed(t), *(k for k in range(most) if k != _seed(t))][place]
                left -= len(self._folds) * self.rounds.budget.of(
                    t.structure, LONG_ITERATIONS + (0 if place == 0 else BEGINNING)
                )
                # The seeds beyond the fewest leave half of the budget to later rounds.
                if left >= (0 if place < least else 0.5 * self.rounds.budget.left()) or not tasks:
                    tasks += [self._task(t.structure, k, seed, LONG_ITERATIONS, t) for k in self._folds]
        return self.rounds.trials(tasks, "the last networks, trained to the end from several starts")[0]

    def corrected(self, trial: CandidateFits, correction: float) -> list[CandidateFits]:
        """The candidate with another correction of its training runs, trained anew."""
        return self.last_round([CandidateFits(replace(trial.structure, correction=correction))])

    @property
    def _folds(self) -> range:
        return range(len(self.rounds.problem.folds))

    def _task(
        self,
        structure: Structure,
        fold: int,
        seed: int,
        iterations: int,
        trial: CandidateFits | None = None,
        *,
        last: bool = True,
    ) -> FitTask:
        """A fit, gone on from the one of ``trial`` where there is one."""
        uncorrected = replace(structure.base, correction=0.0)
        bases = (t for t in self.linear if replace(t.structure, correction=0.0) == uncorrected)
        base = next((t.fits[fold, 0] for t in bases if (fold, 0) in t.fits), None)
        begun = None if trial is None else trial.fits.get((fold, seed))
        return FitTask(structure, fold, iterations, seed, base=base, begun=begun, last=last)


def _ranked(trials: Sequence[CandidateFits]) -> list[CandidateFits]:
    """Trials of the first fold by their better seed, exploded ones left out."""
    finite = [t for t in trials if np.isfinite(t.of_fold(0)[0].held_out)]
    return sorted(finite, key=lambda t: (t.against, t.wild, t.of_fold(0)[0].held_out))


def _seed(trial: CandidateFits) -> int:
    """The seed of a trial's best fit on its first fold; 0 without one."""
    first = [(f.wild, f.held_out, seed) for (fold, seed), f in trial.fits.items() if fold == 0]
    return min(first)[-1] if first else 0


def _offers(linear: Sequence[Structure], units: Sequence[int]) -> list[Structure]:
    """Networks to try: units on the best and the smallest balanced candidate, on the best lagged one, and on others.

    Order and units are chosen together: the best linear order is that of the curve that it has to imitate. So the
    smallest one comes second: a long record's budget does not carry many networks of many states.
    """
    first, second = list[Structure](), list[Structure]()
    for same_row in (False, True):
        balanced, lagged = (
            [s for s in linear if s.start == start and s.same_row is same_row] for start in ("balanced", "lagged")
        )
        small = sorted(balanced[1:], key=lambda s: s.order)[:SMALL_CARRIERS]
        first += [*balanced[:1], *small[:1], *lagged[:1]]
        second += [*small[1:], *lagged[1:2]]
    bases = [*first, *second]
    middle = units[len(units) // 2]
    widest = [replace(b, n_hidden=middle, ridge=RIDGES[0]) for b in bases]
    rest = [replace(b, n_hidden=n, ridge=RIDGES[0]) for n in units if n != middle for b in bases[:VARIED_CARRIERS]]
    return [*widest, *rest]
