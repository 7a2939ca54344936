"""The search among models with their noise: filters of the ARX's impulse response, refined ones, and networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.errors import ModelError
from pipeline.models.identified.candidates import Task
from pipeline.models.identified.innovations import innovations
from pipeline.models.identified.linear_search import LinearSearch
from pipeline.models.identified.rounds import Rounds
from pipeline.models.identified.structure import Problem, Structure
from pipeline.models.identified.trial import Trial

ITERATIONS = 20
"""Of a linear fit."""

NATS = 5.0
"""Log-likelihood of the held-out rows by which a network must be better than the best linear model."""

ASIDE = ((1, 2), (3, 4), (6, 8), (11, 15), (20, 27), (36, 48))
"""Rows from the dead time that the impulse response shows to those on offer, round by round while they explain as much.
"""

PLAIN = 3
"""The smallest orders, by which dead times are compared first."""

LIKELIEST = 4
"""Dead times on offer with all orders."""

ALIKE = 5.0
"""Nats within which dead times are weighed; what is farther off hardly has a weight."""

FAR = 10.0
"""Nats by which a dead time is worse, from which on no farther one is tried."""

KEPT = 8
"""Candidates of the first fold that are fitted on the others too."""

LARGEST = 12
"""Most states of the plant on offer: the impulse response of a record in closed loop shows no more."""

UNITS_OF, SEEDS, RIDGE = 3, 3, 1.0
"""Linear candidates that carry networks, seeds of each, and the weight of the ridge."""

FITTED: tuple[Literal["gain", "all"], ...] = ("gain", "all")
"""What a fit changes: the gain of the filter alone, or the model too."""

TRAINED = 60
"""Iterations of a network's fit."""


def nats(problem: Problem, worse: Trial, better: Trial) -> float:
    """Log-likelihood of the held-out rows by which one trial is better than another, n_y n log(e/e')."""
    rows = sum(problem.folds[k].held.stop - problem.folds[k].held.start for k in worse.folds)
    return float(problem.data.y.shape[1] * rows * np.log(worse.error / better.error))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseSearch:
    """The search among models with their noise of one problem; ``linears`` finds their impulse responses."""

    rounds: Rounds
    linears: LinearSearch

    @classmethod
    def of(cls, rounds: Rounds) -> NoiseSearch:
        """With the impulse responses without dead time, and with the one that the first fold shows."""
        return cls(rounds, LinearSearch.of(rounds))

    def linear(self, orders: Sequence[int]) -> list[Trial]:
        """The best linear candidates over all folds, the best first; ModelError where none can be fitted.

        Of dead times that explain the rows alike, the middle one goes first, see ``middle_first``.
        """
        offered = [n for n in orders if n <= LARGEST]
        scanned = self._scanned(offered[:PLAIN])
        delays = [t.structure.delays for t in _best_of_each(scanned)][:LIKELIEST]
        structures = [
            Structure("balanced", n, (0, 0), d, noise=noise) for n in offered for d in delays for noise in FITTED
        ]
        structures = [s for s in structures if all(s != t.structure for t in scanned)]
        tasks = [self._task(s, 0) for s in self.rounds.affordable(structures, ITERATIONS, 0.5)]
        trials, reasons = self.rounds.trials(tasks, "linear models with their noise")
        finite = [t for t in (*scanned, *trials) if np.isfinite(t.error)]
        if not finite:
            why = reasons[0] if reasons else "every filter over held-out rows explodes"
            raise ModelError(f"no linear model fits the record: {why}")
        ranked = self.ranked(finite)
        near = [t for t in _best_of_each(ranked) if t.against == ranked[0].against]
        near = [t for t in near if nats(self.rounds.problem, t, ranked[0]) <= FAR]
        shortlist = list(dict.fromkeys([*ranked[:KEPT], *near]))
        further = [self._task(t.structure, k) for t in shortlist for k in self._folds[1:]]
        others = {t.structure: t.fits for t in self.rounds.trials(further, "the best of them on all rows")[0]}
        whole = [Trial(t.structure, {**t.fits, **others.get(t.structure, {})}) for t in shortlist]
        whole = [t for t in whole if len(t.fits) == len(self._folds) and np.isfinite(t.error)]
        whole = self.following(whole) or whole
        return self.middle_first(self.ranked(whole)) if whole else shortlist

    def _scanned(self, orders: Sequence[int]) -> list[Trial]:
        """Fits of the first fold with dead times about those that are seen, ranked; all MVs' are moved together.

        A load hides how an answer begins, and models of few states imitate a dead time by lags: the rows then tell no
        dead time from many others, and the first ones of an impulse response least of all.
        """
        problem = self.rounds.problem
        known, n_mv = problem.known, problem.n_mv
        none, *later = dict.fromkeys(s.delays for s, _ in self.linears.starts)
        seen = later[-1] if later else none
        trials: list[Trial] = []
        tried: set[tuple[int, ...]] = set()
        sides = [-1, 1]
        for aside in ((0,), *ASIDE):
            offered = {none} if aside == (0,) else set[tuple[int, ...]]()
            of_side = {}
            for side in sides:
                moved = ([max(d + side * n, 0) if j < n_mv else d for j, d in enumerate(seen)] for n in aside)
                of_side[side] = {known.delays(d) for d in moved}
                offered |= of_side[side]
            offered -= tried
            tried |= offered
            trials = self.ranked([*trials, *self._fitted(sorted(offered), orders)])
            near = {t.structure.delays for t in _best_of_each(trials) if nats(problem, t, trials[0]) <= FAR}
            if aside != (0,):
                sides = [side for side in sides if near & of_side[side] & offered]
        return trials

    def _fitted(self, delays: Sequence[tuple[int, ...]], orders: Sequence[int]) -> list[Trial]:
        """The fits of the first fold with some dead times and orders that do not explode."""
        self.linears.starts.update(self.rounds.starts([Structure("balanced", 0, (0, 0), d) for d in delays]))
        structures = [Structure("balanced", n, (0, 0), d, noise="all") for d in delays for n in orders]
        if not structures:
            return []
        tasks = [self._task(s, 0) for s in self.rounds.affordable(structures, ITERATIONS, 0.3)]
        return [t for t in self.rounds.trials(tasks, "dead times")[0] if np.isfinite(t.error)]

    def middle_first(self, ranked: list[Trial]) -> list[Trial]:
        """The candidates, the best one of the middle dead time first: the median of those that explain the rows alike.

        Each counts by its likelihood. The likeliest one of many alike is chance, and a law that trusts one too early
        swings on the plant.
        """
        best = ranked[0]
        near = [(self._cost(t, best), t) for t in _best_of_each(ranked) if t.against == best.against]
        near = sorted(((c, t) for c, t in near if c - self._cost(best, best) <= ALIKE), key=lambda one: _late(one[1]))
        weights = np.cumsum([np.exp(self._cost(best, best) - c) for c, _ in near])
        middle = near[int(np.searchsorted(weights, 0.5 * weights[-1]))][1]
        return [middle, *(t for t in ranked if t is not middle)]

    def _task(self, structure: Structure, fold: int) -> Task:
        return Task(structure, fold, ITERATIONS, start=self.linears.start(structure, fold))

    def networks(self, linear: Sequence[Trial], units: Sequence[int]) -> list[Trial]:
        """Networks on the best linear candidates, trained over all folds from several seeds."""
        bases = linear[:UNITS_OF]
        offers = [(replace(t.structure, n_hidden=n, ridge=RIDGE, noise="all"), t) for t in bases for n in units[:2]]
        tasks = [
            Task(s, k, TRAINED, seed, base=t.fits[k, 0]) for s, t in offers for seed in range(SEEDS) for k in t.folds
        ]
        costs = np.cumsum([self.rounds.budget.of(t.structure, t.iterations) for t in tasks])
        affordable = [t for t, cost in zip(tasks, costs, strict=True) if cost <= self.rounds.budget.left()]
        trials, _ = self.rounds.trials(affordable, "neural networks with their noise")
        whole = [t for t in self.following(trials) if t.folds == linear[0].folds]
        return sorted(whole, key=lambda t: t.rank)

    def following(self, trials: Sequence[Trial]) -> list[Trial]:
        """The trials without the fits whose filter explodes over the whole record, and without those of no other fits.

        A fit has followed the rows that it was trained on, and the held-out ones; together they begin elsewhere.
        """
        problem = self.rounds.problem
        kept = []
        for t in trials:
            rows = problem.whole(t.structure)
            fits = {key: f for key, f in t.fits.items() if innovations(f.model, rows) is not None}
            if {fold for fold, _ in fits} == set(t.folds):
                kept.append(replace(t, fits=fits))
        return kept

    def ranked(self, trials: Sequence[Trial]) -> list[Trial]:
        """Best first, by the log-likelihood of the held-out rows less one nat a state; what is known comes before it.

        One-step errors hardly tell orders apart, and a state less is one less to mislead. A refined model goes before
        the ARX's response as it is, whose tail still holds what the prior made of noise.
        """
        best = min(trials, key=lambda t: t.error, default=None)
        return [] if best is None else sorted(trials, key=lambda t: (t.against, self._cost(t, best)))

    def _cost(self, trial: Trial, best: Trial) -> float:
        """Nats by which a trial is worse than the best, and its states."""
        return nats(self.rounds.problem, trial, best) + trial.structure.order + (trial.structure.noise == "gain")

    @property
    def _folds(self) -> range:
        return range(len(self.rounds.problem.folds))


def _best_of_each(ranked: Sequence[Trial]) -> list[Trial]:
    """The first trial of each dead time."""
    found: dict[tuple[int, ...], Trial] = {}
    for t in ranked:
        found.setdefault(t.structure.delays, t)
    return list(found.values())


def _late(trial: Trial) -> int:
    return sum(trial.structure.delays)
