"""The linear candidates: balanced and lagged starts, with and without dead times, and the row in which MVs act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.candidates import FitTask, FoldStart
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.linear_start import within_unit_circle
from loopwright.pipeline.models.identified.network_search import Rounds
from loopwright.pipeline.models.identified.structure import CandidateFits, Structure

MOST_LAGGED_STATES = 18
"""States of a lagged start beyond which it is not tried."""

OFFERED_LAGS = ((2, 2), (3, 3), (2, 5), (2, 10))
"""Lags of the outputs and of the inputs on offer."""

FIRST_ROUND_ITERATIONS, FINISHING_ITERATIONS = 10, 30
"""Iterations of the first round, and of the fits that finish it."""

EQUAL_CANDIDATES = 1.02
"""Relative error up to which candidates of the first round count as equal, the smaller ones first."""

LARGEST_START_POLE = 0.98
"""Largest pole of a candidate that begins again inside the unit circle."""

FINISHED, SMALLEST = 3, 3
"""Candidates that are trained to the end: the best of any start, and the best of each of the smallest orders."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearSearch:
    """The search among linear models of one problem."""

    rounds: Rounds
    starts: dict[tuple[Structure, int], FoldStart | str]

    @classmethod
    def of(cls, rounds: Rounds) -> LinearSearch:
        """With the impulse responses without dead time, and with the one that the first fold shows.

        Where a dead time is known, with the least and the nearest one that it may be.
        """
        known = rounds.problem.known
        none = Structure("balanced", 0, (0, 0), known.delays((0,) * rounds.problem.data.v.shape[1]))
        starts = rounds.starts([none])
        first = starts[none, 0]
        if isinstance(first, FoldStart) and max(first.dead_times) > 0:
            # The dead times that are seen lie beyond the delays that the response was taken with.
            seen = known.delays([d + more for d, more in zip(none.delays, first.dead_times, strict=True)])
            starts |= rounds.starts([replace(none, delays=seen)])
        return cls(rounds, starts)

    def first_round(self, orders: Sequence[int], correction: float, lagged: bool = True) -> list[CandidateFits]:
        """The candidates after a short training on the first fold, best first; ModelError where none can be fitted.

        Without ``lagged`` the balanced ones alone.
        """
        n_y, n_v = self.rounds.problem.data.y.shape[1], self.rounds.problem.data.v.shape[1]
        options = list(dict.fromkeys(s.delays for s, _ in self.starts))
        structures = [Structure("balanced", n, (0, 0), d) for d in options for n in orders]
        for y_lags, v_lags in OFFERED_LAGS if lagged else ():
            order = y_lags * n_y + (v_lags - 1) * n_v
            if order <= MOST_LAGGED_STATES:
                structures.extend(Structure("lagged", order, (y_lags, v_lags), d) for d in options)
        offered = [
            replace(s, correction=correction) for s in self.rounds.affordable(structures, FIRST_ROUND_ITERATIONS, 0.3)
        ]
        tasks = [FitTask(s, 0, FIRST_ROUND_ITERATIONS, start=self.start(s, 0)) for s in offered]
        trials, reasons = self.rounds.trials(tasks, "linear models, first fits")
        finite = [t for t in trials if np.isfinite(t.error)]
        if not finite:
            why = reasons[0] if reasons else "every free run over held-out rows explodes"
            raise ModelError(f"no linear model fits the record: {why}")
        limit = EQUAL_CANDIDATES * min(finite, key=lambda t: t.rank).error
        return sorted(
            finite, key=lambda t: (t.against, t.error, 0) if t.error > limit else (t.against, 0.0, t.structure.order)
        )

    def finish(self, shortlist: Sequence[CandidateFits]) -> list[CandidateFits]:
        """The best of a short list and its smallest models, both starts among them, trained to the end on all folds.

        The smallest balanced ones are there for networks: units do with few states what a linear model does with many.
        """
        kept = list(shortlist[:FINISHED])
        balanced, lagged = ([t for t in shortlist if t.structure.start == s] for s in ("balanced", "lagged"))
        small = [min(of, key=lambda t: t.rank) for of in _by_order(balanced)[:SMALLEST]]
        kept.extend(t for t in (*balanced[:2], *lagged[:2], *small) if t not in kept)
        folds = range(len(self.rounds.problem.folds))
        tasks = [
            FitTask(t.structure, k, FINISHING_ITERATIONS, start=self.start(t.structure, k), begun=t.fits.get((k, 0)))
            for t in kept
            for k in folds
        ]
        finished = self.rounds.trials(tasks, "the best linear models, fitted to the end")[0] or kept
        return smallest_first(finished)

    def in_the_same_row(self, trials: Sequence[CandidateFits]) -> list[CandidateFits]:
        """The best balanced and the best lagged candidate again, the MVs acting in their own row."""
        kept = [next((t for t in trials if t.structure.start == start), None) for start in ("balanced", "lagged")]
        structures = [replace(t.structure, same_row=True) for t in kept if t is not None]
        self.starts.update(
            self.rounds.starts([replace(s, order=0, correction=0.0) for s in structures if s.start == "balanced"])
        )
        tasks = [
            FitTask(s, k, FIRST_ROUND_ITERATIONS + FINISHING_ITERATIONS, start=self.start(s, k))
            for s in structures
            for k in range(len(self.rounds.problem.folds))
        ]
        return smallest_first(self.rounds.trials(tasks, "linear models whose MV acts in its own row of the record")[0])

    def settling(self, trials: Sequence[CandidateFits]) -> list[CandidateFits]:
        """The best candidates again, begun with all poles within ``LARGEST_START_POLE``.

        A nonlinear plant can leave the impulse response, and the fit that starts from it, with a pole at 1 that the
        plant does not have; an integrator's pole finds its way back.
        """
        tasks = [
            FitTask(t.structure, k, FINISHING_ITERATIONS, begun=replace(f, model=inside(f.model)))
            for t in trials[:2]
            for (k, _), f in t.fits.items()
        ]
        return smallest_first(self.rounds.trials(tasks, "linear models again, begun without integrator")[0])

    def corrected(self, trials: Sequence[CandidateFits], correction: float) -> list[CandidateFits]:
        """The same candidates, trained with another correction of their runs."""
        folds = range(len(self.rounds.problem.folds))
        tasks = [
            FitTask(
                replace(t.structure, correction=correction),
                k,
                FIRST_ROUND_ITERATIONS + FINISHING_ITERATIONS,
                start=self.start(t.structure, k),
            )
            for t in trials
            for k in folds
        ]
        return smallest_first(
            self.rounds.trials(tasks, "linear models again, with a slow correction of their error")[0]
        )

    def start(self, structure: Structure, fold: int) -> FoldStart | None:
        """Where the balanced candidates of a fold start from; None without an impulse response."""
        shift = (structure.delays, structure.same_row, fold)
        found = (start for (s, k), start in self.starts.items() if (s.delays, s.same_row, k) == shift)
        return next((start for start in found if isinstance(start, FoldStart)), None)


def _by_order(trials: Sequence[CandidateFits]) -> list[list[CandidateFits]]:
    """The trials of each order, the smallest order first."""
    orders = sorted({t.structure.order for t in trials})
    return [[t for t in trials if t.structure.order == n] for n in orders]


def inside(model: Dynamics) -> Dynamics:
    """The model with all its poles within ``LARGEST_START_POLE``."""
    return replace(model, a=within_unit_circle(model.a, LARGEST_START_POLE))


def smallest_first(trials: Sequence[CandidateFits]) -> list[CandidateFits]:
    """Best first, those of fewer folds last; of those within 1 % of the best the smallest leads.

    A state less is one less to mislead. Those that contradict what is known of the plant come after all others.
    """
    most = max((len(t.fits) for t in trials), default=0)
    ranked = sorted(trials, key=lambda t: (len(t.fits) < most, t.against, t.error))
    near = [t for t in ranked if t.error <= 1.01 * ranked[0].error and len(t.fits) == len(ranked[0].fits)]
    near = [t for t in near if t.against == ranked[0].against]
    first = min(near, key=lambda t: (t.structure.order + sum(t.structure.delays), t.error), default=None)
    return [] if first is None else [first, *(t for t in ranked if t is not first)]
