"""Regions of an MV's range by the gain of a PV there: where it turns its sign or fades, one number is no gain.

At the middle of the record such a gain may be near zero by right, and the answer of a linear model is a mean over
regions. So the models' answers are taken in cells of the MV's range, which are put together where they are alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Self

import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord
from loopwright.pipeline.models.identified.steady_states import central_map, settle
from loopwright.pipeline.plants.simulator import Array

EDGES = (0.05, 0.2, 0.4, 0.6, 0.8, 0.95)  # quantiles of an MV over its data between which its cells lie
NARROW = 0.05  # of the way between the outer edges: an edge that is nearer to the one before is left out
SMALL = 0.2  # of the largest answer of the cells: a smaller one decides nothing


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
    kinds = np.where(np.abs(answers) < SMALL * np.abs(answers).max(), 0.0, np.sign(answers))
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
    least = NARROW * (quantiles[-1] - quantiles[0])
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
