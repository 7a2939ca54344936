"""A round of the search: independent fits on the engine, their nominal cost, and what came of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.models.identified.candidates import Start, Task, find_start, fit, judged_beyond_drift
from loopwright.pipeline.models.identified.output_error import Fitted
from loopwright.pipeline.models.identified.structure import Budget, Problem, Structure, Trial


@dataclass(frozen=True, slots=True, eq=False)
class Rounds:
    """Runs rounds of fits on one problem under one budget; ``label`` names them while they run.

    A round depends on its tasks and on nominal costs alone, never on how many processes share it.
    """

    problem: Problem
    budget: Budget
    label: str

    def starts(self, structures: Sequence[Structure]) -> dict[tuple[Structure, int], Start | str]:
        """The starts under the shifts of some structures, on each fold."""
        tasks = [(s, fold) for s in structures for fold in range(len(self.problem.folds))]
        found = parallel_map(
            partial(find_start, self.problem), tasks, f"{self.label}: impulse responses from the record"
        )
        return dict(zip(tasks, found, strict=True))

    def fits(self, tasks: Sequence[Task], name: str) -> list[Fitted | str]:
        """The outcomes of some fits, in order. The dearest begin first, so that no core is left with one at the end."""
        costs = [self.budget.of(t.structure, t.iterations) for t in tasks]
        order = sorted(range(len(tasks)), key=lambda i: (-costs[i], i))
        in_order, weights = [tasks[i] for i in order], [costs[i] for i in order]
        found = parallel_map(partial(fit, self.problem), in_order, f"{self.label}: {name}", weights)
        outcomes: list[Fitted | str] = ["not fitted"] * len(tasks)
        for i, outcome in zip(order, found, strict=True):
            outcomes[i] = outcome
            done = 2 if isinstance(outcome, str) else outcome.work
            self.budget.spent += self.budget.of(tasks[i].structure, done)
        return outcomes

    def trials(self, tasks: Sequence[Task], name: str) -> tuple[list[Trial], list[str]]:
        """(the candidates with the fits that succeeded, in order of their first task, reasons of the others)."""
        trials: dict[Structure, Trial] = {}
        reasons = []
        for task, outcome in zip(tasks, self.fits(tasks, name), strict=True):
            if isinstance(outcome, str):
                reasons.append(outcome)
            else:
                trial = trials.setdefault(task.structure, Trial(task.structure))
                trial.fits[task.fold, task.seed] = outcome
        return list(trials.values()), reasons

    def judged_beyond_drift(self, trials: Sequence[Trial], rows: int) -> list[Trial]:
        """The trials with held-out errors that leave out a gain and a level of each ``rows`` rows."""
        tasks = [(t.structure, fold, fitted) for t in trials for (fold, _), fitted in t.fits.items()]
        label = f"{self.label}: errors of the models over held-out rows, slow drift left out"
        found = iter(parallel_map(partial(judged_beyond_drift, self.problem, rows), tasks, label))
        return [Trial(t.structure, {key: next(found) for key in t.fits}) for t in trials]

    def affordable(self, structures: Sequence[Structure], iterations: int, share: float) -> list[Structure]:
        """The first of some structures that ``iterations`` of each fit into ``share`` of the budget, one at least."""
        left, chosen = self.budget.left(share), list[Structure]()
        for structure in structures:
            left -= self.budget.of(structure, iterations)
            if chosen and left < 0:
                break
            chosen.append(structure)
        return chosen
