"""The search among models with their noise: filters of the ARX's impulse response, refined ones, and networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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

LATER = (1, 2)
"""Rows on offer beyond the dead time that the impulse response shows: a sixth of the answer is over by then."""

KEPT = 8
"""Candidates of the first fold that are fitted on the others too."""

LARGEST = 12
"""Most states of the plant on offer: the impulse response of a record in closed loop shows no more."""

UNITS_OF, SEEDS, RIDGE = 3, 3, 1.0
"""Linear candidates that carry networks, seeds of each, and the weight of the ridge."""

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
        """With the impulse responses without dead time, with the one that the first fold shows, and a little more.

        A dead time that is known spares a model of few states the lags that would have to imitate it.
        """
        linears = LinearSearch.of(rounds)
        offered = list(dict.fromkeys(s.delays for s, _ in linears.starts))
        none = Structure("balanced", 0, (0, 0), offered[0])
        later = [rounds.problem.known.delays([d + more for d in offered[-1]]) for more in LATER]
        return cls(
            rounds, replace(linears, starts=linears.starts | rounds.starts([replace(none, delays=d) for d in later]))
        )

    def linear(self, orders: Sequence[int]) -> list[Trial]:
        """The best linear candidates over all folds, the best first; ModelError where none can be fitted."""
        delays = list(dict.fromkeys(s.delays for s, _ in self.linears.starts))
        structures = [
            Structure("balanced", n, (0, 0), d, noise=noise)
            for n in orders
            if n <= LARGEST
            for d in delays
            for noise in ("gain", "all")
        ]
        affordable = self.rounds.affordable(structures, ITERATIONS, 0.5)
        tasks = [Task(s, 0, ITERATIONS, start=self.linears.start(s, 0)) for s in affordable]
        trials, reasons = self.rounds.trials(tasks, "linear models with their noise")
        finite = [t for t in trials if np.isfinite(t.error)]
        if not finite:
            why = reasons[0] if reasons else "every filter over held-out rows explodes"
            raise ModelError(f"no linear model fits the record: {why}")
        shortlist = self.ranked(finite)[:KEPT]
        further = [
            Task(t.structure, k, ITERATIONS, start=self.linears.start(t.structure, k))
            for t in shortlist
            for k in self._folds[1:]
        ]
        others = {t.structure: t.fits for t in self.rounds.trials(further, "the best of them on all rows")[0]}
        whole = [Trial(t.structure, {**t.fits, **others.get(t.structure, {})}) for t in shortlist]
        whole = [t for t in whole if len(t.fits) == len(self._folds) and np.isfinite(t.error)]
        whole = self.following(whole) or whole
        return self.ranked(whole) if whole else shortlist

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
        best = min(trials, key=lambda t: t.error)

        def cost(t: Trial) -> tuple[int, float]:
            likely = nats(self.rounds.problem, t, best) + t.structure.order + (t.structure.noise == "gain")
            return t.against, likely

        return sorted(trials, key=cost)

    @property
    def _folds(self) -> range:
        return range(len(self.rounds.problem.folds))
