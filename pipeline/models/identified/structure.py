"""The choices of a candidate, the record that candidates are compared on, its fits, and how candidates are ranked.

Regions of an MV's range are by the gain of a PV there: where it turns its sign or fades, one number is no gain. At the
middle of the record such a gain may be near zero by right, and the answer of a linear model is a mean over regions. So
the models' answers are taken in cells of the MV's range, which are put together where they are alike.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from typing import Literal, Self

import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.knowledge import NOTHING_KNOWN, Knowledge
from loopwright.pipeline.models.identified.output_error import Fitted
from loopwright.pipeline.models.identified.scaled_record import Fold, ScaledRecord
from loopwright.pipeline.models.identified.steady_states import central_map, settle
from loopwright.pipeline.plants.simulator import Array

FARTHEST = 20.0
"""Scaled output that no rest of a usable network exceeds, of a plant whose linear model has nearer ones."""


@dataclass(frozen=True, slots=True)
class Structure:
    """The choices of a candidate.

    ``start`` balanced: realization of ``order`` states; lagged: companion form of ``lags`` (of the outputs, of the
    inputs). ``delays`` are the dead times of the inputs in periods. ``correction`` is the share of the output's error
    that each sample of the training run takes back: for drift and integrating levels. ``same_row`` says that the MVs
    of a row act on the outputs of that row, not of the next one: a logger that stores them late. ``noise`` says what a
    fit by one-step errors changes: the filter's ``gain`` alone, or ``all``; ``none``: a free run is fitted.
    """

    start: Literal["balanced", "lagged"]
    order: int
    lags: tuple[int, int]
    delays: tuple[int, ...]
    n_hidden: int = 0
    ridge: float = 0.0
    correction: float = 0.0
    same_row: bool = False
    noise: Literal["none", "gain", "all"] = "none"

    @property
    def base(self) -> Structure:
        """The linear candidate that this one starts from."""
        return replace(self, n_hidden=0, ridge=0.0)

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        n_z = self.order + len(self.delays)
        return self.order * (n_z + 1) + self.n_hidden * (n_z + 1 + self.order)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The scaled record of ``n_mv`` MVs, its folds, the seed, and how candidates are judged.

    ``judged`` is the correction of the free runs over held-out rows, the same for all candidates. ``settles`` says
    that the plant comes to rest by itself, as its linear model does; a network that does not is rejected, and so is one
    with rests beyond ``farthest``, scaled. ``fed_back``
    says that the MVs follow the outputs. ``known`` is what an engineer knows of pairs of output and input.
    ``seen`` are the rows as a running loop sees them, where those of ``data`` know of later readings.
    """

    data: ScaledRecord
    folds: tuple[Fold, ...]
    n_mv: int
    seed: int = 0
    judged: float = 0.0
    settles: bool = False
    farthest: float = FARTHEST
    fed_back: bool = False
    known: Knowledge = NOTHING_KNOWN
    seen: ScaledRecord | None = None

    def part(self, structure: Structure, rows: slice) -> ScaledRecord:
        """Some rows, the inputs shifted to where they act in this structure, those at 0 that are known not to act."""
        shift = [d - int(structure.same_row and j < self.n_mv) for j, d in enumerate(structure.delays)]
        return self.known.heard(self.data.delayed(shift).rows(rows))

    @property
    def in_a_loop(self) -> Problem:
        """The same over the rows that a running loop sees: no figure of a model may rest on later readings."""
        return self if self.seen is None else replace(self, data=self.seen, seen=None)

    def train(self, structure: Structure, fold: int) -> list[Stretch]:
        """Training stretches of a fold."""
        return self.part(structure, self.folds[fold].train).stretches()

    def held(self, structure: Structure, fold: int) -> list[Stretch]:
        """Held-out stretches of a fold."""
        return self.part(structure, self.folds[fold].held).stretches()

    def whole(self, structure: Structure) -> list[Stretch]:
        """All stretches."""
        return self.part(structure, slice(None)).stretches()


@dataclass(slots=True)
class Budget:
    """Work in nominal seconds of one core, so that the same record and budget always do the same work.

    An iteration over N rows of a candidate with n_x states, n_h units and P parameters counts
    N (.3 + .06 n_h + .0018 n_x P + .000018 n_y P^2) 1.5e-6 s.
    """

    seconds: float
    rows: int
    n_y: int
    spent: float = 0.0

    def of(self, structure: Structure, iterations: int) -> float:
        """Nominal seconds of some iterations."""
        p = structure.parameters
        row = 0.3 + 0.06 * structure.n_hidden + 1.8e-3 * structure.order * p + 1.8e-5 * self.n_y * p * p
        return iterations * self.rows * row * 1.5e-6

    def left(self, share: float = 1.0) -> float:
        """Nominal seconds until ``share`` of the budget is spent."""
        return share * self.seconds - self.spent


# ---------------------------------------------------------------------- a candidate with its fits over folds and seeds
@dataclass(frozen=True, slots=True, eq=False)
class CandidateFits:
    """A candidate and its fits by (fold, seed)."""

    structure: Structure
    fits: dict[tuple[int, int], Fitted] = field(default_factory=dict)

    def of_fold(self, fold: int) -> list[Fitted]:
        """The fits of one fold, the best first.

        Held-out and training rows count alike: few held-out rows flatter a seed that missed others. Those that
        contradict what is known of the plant come after these, then wild ones, and last those that exploded.
        """
        own = (f for (of, _), f in self.fits.items() if of == fold)
        return sorted(
            own, key=lambda f: (not np.isfinite(f.held_out), f.wild, bool(f.against), f.held_out**2 + f.trained**2)
        )

    @property
    def against(self) -> int:
        """The folds of which every fit that did not explode contradicts what is known of the plant.

        Between none and all of them the candidate is uncertain of it.
        """
        finite = [[f.against for f in self.of_fold(k) if np.isfinite(f.held_out)] for k in self.folds]
        return sum(bool(of) and all(of) for of in finite)

    @property
    def wild(self) -> int:
        """The folds of which no fit settles."""
        finite = [[f.wild for f in self.of_fold(k) if np.isfinite(f.held_out)] for k in self.folds]
        return sum(bool(of) and all(of) for of in finite)

    @property
    def rank(self) -> tuple[int, int, float]:
        """Key by which candidates are sorted: contradictions of knowledge first, then the wild ones, then the error."""
        return self.against, self.wild, self.error

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


def best_of(trials: Sequence[CandidateFits]) -> CandidateFits | None:
    """The trial of the least error that is finite; None without one."""
    finite = [t for t in trials if np.isfinite(t.error)]
    return min(finite, key=lambda t: t.rank) if finite else None


EDGES = (0.05, 0.2, 0.4, 0.6, 0.8, 0.95)  # quantiles of an MV over its data between which its cells lie
NARROW_CELL = 0.05  # of the way between the outer edges: an edge that is nearer to the one before is left out
SMALL_CELL_ANSWER = 0.2  # of the largest answer of the cells: a smaller one decides nothing


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Answers of models to the way over each cell of an MV's range, per unit of the MV, all other inputs at medians.

    ``edges`` holds of each MV the ends of its cells (cells + 1,), ``curves`` the answers (members, cells, length, n_y)
    in the rows after the step from a cell's lower end to its upper one; all scaled.
    """

    edges: list[Array]
    curves: list[Array]

    @classmethod
    def of(cls, members: Sequence[Dynamics], data: ScaledRecord, n_mv: int, length: int) -> Self:
        """From models without loads, over ``length`` rows; 0 where a run explodes."""
        edges = [_edges(data.v[:, j]) for j in range(n_mv)]
        places = [(j, low, high) for j, of in enumerate(edges) for low, high in pairwise(of)]
        below = np.tile(np.median(data.v, axis=0), (len(places), 1))
        above = below.copy()
        for row, (j, low, high) in enumerate(places):
            below[row, j], above[row, j] = low, high
        width = np.array([high - low for _, low, high in places])[:, None, None]
        with np.errstate(over="ignore", invalid="ignore"):
            runs = [_ways(model, data, below, above, length) / width for model in members]
        found = np.nan_to_num(np.array(runs), posinf=0.0, neginf=0.0)
        ends = np.cumsum([len(of) - 1 for of in edges])[:-1]
        return cls(edges, np.split(found, ends, axis=1))


def alike(answers: Array) -> list[slice]:
    """Neighbouring cells of one sign, or of small answers (cells,), put together; empty where all are of one kind."""
    kinds = np.where(np.abs(answers) < SMALL_CELL_ANSWER * np.abs(answers).max(), 0.0, np.sign(answers))
    found, first = [], 0
    for _, group in groupby(kinds):
        last = first + len(list(group))
        found.append(slice(first, last))
        first = last
    return found if len(found) > 1 else []


def pieces(values: Array, knots: Sequence[float]) -> Array:
    """An input (n,) as the sum of what it moves within each region, (n, regions), but for a constant.

    ``knots`` (regions - 1,) part the regions. In a linear model each column has the gain of its region.

    Source: G. A. F. Seber, C. J. Wild, Nonlinear Regression, 1989, section 9.3 (linear splines).
    """
    ends = np.array([-np.inf, *knots, np.inf])
    return np.column_stack([np.clip(values, low, high) for low, high in pairwise(ends)])


def _edges(values: Array) -> Array:
    """Ends of the cells (2 to 6,) of an MV's values (n,)."""
    quantiles = np.quantile(values, EDGES)
    least = NARROW_CELL * (quantiles[-1] - quantiles[0])
    if least == 0:  # it rests nearly always
        return np.array([values.min(), values.max()])
    kept = [quantiles[0]]
    for edge in quantiles[1:]:
        if edge - kept[-1] > least:
            kept.append(edge)
    return np.array(kept)


def _ways(model: Dynamics, data: ScaledRecord, below: Array, above: Array, length: int) -> Array:
    """Changes (n, length, n_y) of the outputs by steps from inputs ``below`` to ``above`` (n, n_v), from rests."""
    n, n_y = len(below), data.y.shape[1]
    start = np.column_stack([np.zeros((n, n_y)), below, np.ones(n)]) @ central_map(model, data).T
    x, still = settle(model, below, start)
    states = np.tile(np.where(still[:, None], x, start), (2, 1))
    inputs, found = np.concatenate([above, below]), np.empty((n, length, n_y))
    for k in range(length):
        states = model.advance(states, inputs)
        found[:, k] = states[:n, :n_y] - states[n:, :n_y]
    return found
