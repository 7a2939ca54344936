"""The search among models with their noise: filters of the ARX's impulse response, refined ones, and networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from loopwright.pipeline.dynamics.step_response import reached
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.historian.settling import MOST_PERIODS
from loopwright.pipeline.models.identified.candidates import FitTask
from loopwright.pipeline.models.identified.identified import step_responses
from loopwright.pipeline.models.identified.innovations import innovations
from loopwright.pipeline.models.identified.linear_search import LinearSearch
from loopwright.pipeline.models.identified.network_search import Rounds
from loopwright.pipeline.models.identified.structure import CandidateFits, Problem, Structure

LINEAR_ITERATIONS = 20
"""Iterations of a linear fit."""

NATS = 5.0
"""Log-likelihood of the held-out rows within which two linear models are alike."""

NETWORK_NATS = 10.0
"""Log-likelihood by which a network must be better than the best linear model.

It is the best of six: 5 to 8 were seen by chance, of networks that left gain and speed five times as open.
"""

ASIDE = ((1, 2), (3, 4), (6, 8), (11, 15), (20, 27), (36, 48))
"""Rows from the dead time that the impulse response shows to those on offer, round by round while they explain as much.
"""

PLAIN_ORDERS = 3
"""The smallest orders, by which dead times are compared first."""

LIKELIEST = 4
"""Dead times on offer with all orders."""

LIKELY_NATS = 2.0
"""Nats up to which a dead time is as likely as the best: it is the 95 % limit of a likelihood ratio of one number."""

HALF_RISE = 0.5
"""Share of an answer's last value at which its rise is compared with its dead time."""

UNEVEN = 3.0
"""Nats that count as one of the weight of a dead time: fits of neighbouring ones end as far apart by chance."""

SCAN_NATS = 10.0
"""Nats by which a dead time is worse, from which on no farther one is tried."""

KEPT_CANDIDATES = 8
"""Candidates of the first fold that are fitted on the others too."""

LARGEST_ORDER = 12
"""Most states of the plant on offer: the impulse response of a record in closed loop shows no more."""

UNIT_CARRIERS, SEEDS_A_NETWORK, NETWORK_RIDGE = 3, 3, 1.0
"""Linear candidates that carry networks, seeds of each, and the weight of the ridge."""

FITTED: tuple[Literal["gain", "all"], ...] = ("gain", "all")
"""The parts that a fit changes: the gain of the filter alone, or the model too."""

TRAINED = 60
"""Iterations of a network's fit."""


def nats(problem: Problem, trial: CandidateFits, better: CandidateFits) -> float:
    """Log-likelihood of the held-out rows by which a trial is worse than a better one, n_y n log(e/e')."""
    readings = sum(problem.data.rows(problem.folds[k].held).readings for k in trial.folds)
    return float(readings * np.log(trial.error / better.error))


def worse(problem: Problem, trial: CandidateFits, best: CandidateFits) -> float:
    """Nats by which a trial is worse than another, each state and the freedom of the whole model counting one."""
    more = trial.structure.order - best.structure.order
    plain = (trial.structure.noise == "gain") - (best.structure.noise == "gain")
    return nats(problem, trial, best) + more + plain


def behind(problem: Problem, trial: CandidateFits, best: CandidateFits) -> float:
    """Nats over all rows by which a trial is worse than another, each state counting one: of two dead times.

    They have as many parameters, so that the rows of a fit count too. The held-out ones alone are few: 4 nats for a
    dead time that is not there were seen in noise of 10 %.
    """
    rows = problem.data.readings
    ratio = _of_all_rows(problem, trial) / _of_all_rows(problem, best)
    return float(rows * np.log(ratio)) + trial.structure.order - best.structure.order


def _of_all_rows(problem: Problem, trial: CandidateFits) -> float:
    """The rms one-step error of the fits of all folds, over their training and their held-out rows."""
    squares = []
    for k in trial.folds:
        fitted, fold = trial.of_fold(k)[0], problem.folds[k]
        held = fold.held.stop - fold.held.start
        share = held / len(problem.data.y)
        squares.append(share * fitted.held_out**2 + (1 - share) * fitted.trained**2)
    return float(np.sqrt(np.mean(squares)))


def _finite(trial: CandidateFits) -> bool:
    return all(np.isfinite(f.held_out) and np.isfinite(f.trained) for f in trial.fits.values())


def likely_dead_times(problem: Problem, linear: Sequence[CandidateFits]) -> list[tuple[int, int]]:
    """Least and most periods of dead time of each input, over the models that are as likely as the best one."""
    least = min(t.against for t in linear)
    own = [t for t in linear if t.against == least and t.structure.noise == "all" and _finite(t)]
    own = own or list(linear[:1])
    best = min(own, key=lambda t: behind(problem, t, own[0]))
    found = [t.structure.delays for t in own if behind(problem, t, best) <= LIKELY_NATS]
    return [(min(of), max(of)) for of in zip(*found, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class NoiseSearch:
    """The search among models with their noise of one problem; ``linears`` finds their impulse responses."""

    rounds: Rounds
    linears: LinearSearch

    @classmethod
    def of(cls, rounds: Rounds) -> NoiseSearch:
        """With the impulse responses without dead time, and with the one that the first fold shows."""
        return cls(rounds, LinearSearch.of(rounds))

    def linear(self, orders: Sequence[int]) -> list[CandidateFits]:
        """The best linear candidates over all folds, the best first; ModelError where none can be fitted.

        Where dead times explain the rows alike, the best one of the middle of them goes first, see ``_along``.
        """
        offered = [n for n in orders if n <= LARGEST_ORDER]
        scanned, middle = self._scanned(offered[:PLAIN_ORDERS])
        none = next(s.delays for s, _ in self.linears.starts)
        likely = dict.fromkeys([middle, *(t.structure.delays for t in scanned)])
        delays = list(dict.fromkeys([*list(likely)[:LIKELIEST], none]))
        structures = [
            Structure("balanced", n, (0, 0), d, noise=noise) for n in offered for d in delays for noise in FITTED
        ]
        known = {t.structure for t in scanned}
        affordable = self.rounds.affordable([s for s in structures if s not in known], LINEAR_ITERATIONS, 0.5)
        trials, reasons = self.rounds.trials([self._task(s, 0) for s in affordable], "linear models with their noise")
        shortlist = self.ranked([t for t in trials if np.isfinite(t.error)])[:KEPT_CANDIDATES]
        if not (shortlist or scanned):
            why = reasons[0] if reasons else "every filter over held-out rows explodes"
            raise ModelError(f"no linear model fits the record: {why}")
        further = [self._task(t.structure, k) for t in shortlist for k in self._folds[1:]]
        others = {t.structure: t.fits for t in self.rounds.trials(further, "the best of them on all rows")[0]}
        whole = [CandidateFits(t.structure, {**t.fits, **others.get(t.structure, {})}) for t in shortlist]
        whole = [t for t in whole if len(t.fits) == len(self._folds) and np.isfinite(t.error)]
        whole += scanned
        whole = self.following(whole) or whole
        if not whole:
            return shortlist
        ranked = self.ranked(whole)
        best = ranked[0]
        of_middle = [t for t in ranked if t.structure.delays == middle and t.against == best.against]
        lead = next((t for t in of_middle if nats(self.rounds.problem, t, best) <= SCAN_NATS), best)
        return [lead, *(t for t in ranked if t is not lead)]

    def _scanned(self, orders: Sequence[int]) -> tuple[list[CandidateFits], tuple[int, ...]]:
        """(fits of all folds with dead times about those that are seen, ranked; the middle of those that are alike).

        A load hides how an answer begins, and models of few states imitate a dead time by lags: the rows then tell no
        dead time from many others, and the first ones of an impulse response least of all. All MVs' dead times are
        moved together, then each one's, then those of the measured disturbances; not those of inputs that are known to
        move nothing.
        """
        problem = self.rounds.problem
        heard = [j for j in range(problem.data.v.shape[1]) if j not in problem.known.silent]
        mvs = [j for j in heard if j < problem.n_mv]
        seen = list(dict.fromkeys(s.delays for s, _ in self.linears.starts))
        trials = self.ranked(self._fitted(seen, orders))
        if not trials:
            return trials, seen[-1]
        at = next(iter(self._by_dead_time(trials)))
        if mvs:
            trials, at = self._along(mvs, at, orders, trials)
        for j in (j for j in heard if len(mvs) > 1 or j not in mvs):
            trials, at = self._along([j], at, [trials[0].structure.order], trials)
        return trials, at

    def _along(
        self, inputs: Sequence[int], at: tuple[int, ...], orders: Sequence[int], trials: list[CandidateFits]
    ) -> tuple[list[CandidateFits], tuple[int, ...]]:
        """(trials and those with dead times of some inputs beside ``at``, ranked; the median of these dead times).

        Each counts by its likelihood, by its distance from its neighbours, and by the square of the share of its
        answer's rise that is no dead time: where a record tells nothing, dead time is a quarter of the rise. The
        likeliest one of many alike is chance, and a law that trusts one too early swings on the plant.
        """
        known = self.rounds.problem.known

        def rows(d: tuple[int, ...]) -> float:
            return sum(d[j] for j in inputs) / len(inputs)

        line, sides, tried = {at}, [-1, 1], {t.structure.delays for t in trials}
        for aside in ASIDE:
            of_side = {}
            for side in sides:
                moved = ([max(d + side * n, 0) if j in inputs else d for j, d in enumerate(at)] for n in aside)
                of_side[side] = {known.delays(d) for d in moved} - line
                line |= of_side[side]
            nearest = sorted(line - tried, key=lambda d: (abs(rows(d) - rows(at)), d))
            trials = self.ranked([*trials, *self._fitted(nearest, orders)])
            tried |= line
            costs = self._by_dead_time(trials)
            near = {d for d, (cost, _) in costs.items() if cost <= SCAN_NATS}
            sides = [side for side in sides if near & of_side[side]]
            if not sides:
                break
        costs = {d: found for d, found in costs.items() if d in line}
        ordered = sorted(costs, key=rows)
        if len(ordered) < 2:
            return trials, (ordered or [at])[0]
        n_y = self.rounds.problem.data.y.shape[1]
        apart = np.gradient([rows(d) for d in ordered])
        lags = np.array([_of_lags(costs[d][1], inputs, n_y) for d in ordered])
        cost = np.array([costs[d][0] for d in ordered])
        weights = np.cumsum(apart * lags**2 * np.exp((cost.min() - cost) / UNEVEN))
        return trials, ordered[int(np.searchsorted(weights, 0.5 * weights[-1]))]

    def _by_dead_time(self, trials: Sequence[CandidateFits]) -> dict[tuple[int, ...], tuple[float, CandidateFits]]:
        """Dead times -> (nats behind the best of all, the best trial with them).

        Those count alone that contradict what is known the least.
        """
        own = [t for t in trials if t.against == trials[0].against]
        cost = {id(t): behind(self.rounds.problem, t, own[0]) for t in own}
        least = min(cost.values())
        found: dict[tuple[int, ...], tuple[float, CandidateFits]] = {}
        for t in sorted(own, key=lambda t: cost[id(t)]):
            found.setdefault(t.structure.delays, (cost[id(t)] - least, t))
        return found

    def _fitted(self, delays: Sequence[tuple[int, ...]], orders: Sequence[int]) -> list[CandidateFits]:
        """The fits of all folds with some dead times and orders, where none explodes; the first that are affordable."""
        structures = [Structure("balanced", n, (0, 0), d, noise="all") for d in delays for n in orders]
        if not structures:
            return []
        affordable = self.rounds.affordable(structures, LINEAR_ITERATIONS * len(self._folds), 0.3)
        begun = {s.delays for s, _ in self.linears.starts}
        new = [d for d in dict.fromkeys(s.delays for s in affordable) if d not in begun]
        self.linears.starts.update(self.rounds.starts([Structure("balanced", 0, (0, 0), d) for d in new]))
        tasks = [self._task(s, k) for s in affordable for k in self._folds]
        trials = self.rounds.trials(tasks, "dead times")[0]
        return [t for t in trials if len(t.fits) == len(self._folds) and _finite(t)]

    def _task(self, structure: Structure, fold: int) -> FitTask:
        return FitTask(structure, fold, LINEAR_ITERATIONS, start=self.linears.start(structure, fold))

    def networks(self, linear: Sequence[CandidateFits], units: Sequence[int]) -> list[CandidateFits]:
        """Networks on the best linear candidates of the first one's dead times, from several seeds, over all folds."""
        bases = [t for t in linear if t.structure.delays == linear[0].structure.delays][:UNIT_CARRIERS]
        offers = [
            (replace(t.structure, n_hidden=n, ridge=NETWORK_RIDGE, noise="all"), t) for t in bases for n in units[:2]
        ]
        tasks = [
            FitTask(s, k, TRAINED, seed, base=t.fits[k, 0])
            for s, t in offers
            for seed in range(SEEDS_A_NETWORK)
            for k in t.folds
        ]
        costs = np.cumsum([self.rounds.budget.of(t.structure, t.iterations) for t in tasks])
        affordable = [t for t, cost in zip(tasks, costs, strict=True) if cost <= self.rounds.budget.left()]
        trials, _ = self.rounds.trials(affordable, "neural networks with their noise")
        whole = [t for t in self.following(trials) if t.folds == linear[0].folds]
        return sorted(whole, key=lambda t: t.rank)

    def following(self, trials: Sequence[CandidateFits]) -> list[CandidateFits]:
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

    def ranked(self, trials: Sequence[CandidateFits]) -> list[CandidateFits]:
        """Best first, by the log-likelihood of the held-out rows less one nat a state; what is known comes before it.

        One-step errors hardly tell orders apart, and a state less is one less to mislead. A refined model goes before
        the ARX's response as it is, whose tail still holds what the prior made of noise.
        """
        best = min(trials, key=lambda t: t.error, default=None)
        return [] if best is None else sorted(trials, key=lambda t: (t.against, worse(self.rounds.problem, t, best)))

    @property
    def _folds(self) -> range:
        return range(len(self.rounds.problem.folds))


def _of_lags(trial: CandidateFits, inputs: Sequence[int], n_y: int) -> float:
    """Share of the time to half of an answer that is no dead time, the mean of some inputs' answers.

    For each input the answer counts of the output that it moves most, over the rows that a law looks ahead at most.
    """
    model = trial.of_fold(trial.folds[0])[0].model.plant
    size = np.ones(model.n_v)
    curves = step_responses(model, np.zeros(model.n_x), np.zeros(model.n_v), size, MOST_PERIODS)
    shares = []
    for j in inputs:
        moved = curves[j, :, :n_y]
        one = moved[:, int(np.abs(moved[-1]).argmax())]
        rise = reached(one / one[-1], HALF_RISE) if one[-1] else float(MOST_PERIODS)
        shares.append(rise / (rise + trial.structure.delays[j]))
    return float(np.mean(shares))
