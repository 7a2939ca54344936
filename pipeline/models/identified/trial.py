"""A candidate with its fits over folds and seeds, and how candidates are ranked."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from loopwright.pipeline.models.identified.output_error import Fitted
from loopwright.pipeline.models.identified.structure import Structure


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A candidate and its fits by (fold, seed)."""

    structure: Structure
    fits: dict[tuple[int, int], Fitted] = field(default_factory=dict)

    def of_fold(self, fold: int) -> list[Fitted]:
        """The fits of one fold, the best first.

        Held-out and training rows count alike: few held-out rows flatter a seed that missed others. Those that
        contradict what is known of the plant come after these, and last those that exploded.
        """
        own = (f for (of, _), f in self.fits.items() if of == fold)
        return sorted(own, key=lambda f: (not np.isfinite(f.held_out), bool(f.against), f.held_out**2 + f.trained**2))

    @property
    def against(self) -> int:
        """The folds of which every fit that did not explode contradicts what is known of the plant.

        Between none and all of them the candidate is uncertain of it.
        """
        finite = [[f.against for f in self.of_fold(k) if np.isfinite(f.held_out)] for k in self.folds]
        return sum(bool(of) and all(of) for of in finite)

    @property
    def rank(self) -> tuple[int, float]:
        """Key by which candidates are sorted: contradictions of knowledge first, then the error."""
        return self.against, self.error

    @property
    def error(self) -> float:
        """The rms over the folds of the median over the seeds of the held-out free-run error, scaled.

        Seeds that exploded are left out; infinite where all of a fold's did.
        """
        finite = [[f.held_out for f in self.of_fold(k) if np.isfinite(f.held_out)] for k in self.folds]
        if not all(finite):
            return np.inf
        return float(np.sqrt(np.mean([statistics.median(errors) ** 2 for errors in finite])))

    @property
    def spread(self) -> float:
        """The rms over the folds of the seeds' standard deviation, exploded ones left out; 0 for one seed."""
        finite = [[f.held_out for f in self.of_fold(k) if np.isfinite(f.held_out)] for k in self.folds]
        if not all(finite):
            return np.inf
        return float(np.sqrt(np.mean([np.var(errors) for errors in finite])))

    @property
    def seeds(self) -> int:
        """The fewest fits of a fold that did not explode, one at least."""
        return max(min(sum(np.isfinite(f.held_out) for f in self.of_fold(k)) for k in self.folds), 1)

    @property
    def folds(self) -> list[int]:
        """The folds that it was fitted on."""
        return sorted({k for k, _ in self.fits})


def best_of(trials: Sequence[Trial]) -> Trial | None:
    """The trial of the least error that is finite; None without one."""
    finite = [t for t in trials if np.isfinite(t.error)]
    return min(finite, key=lambda t: t.rank) if finite else None
