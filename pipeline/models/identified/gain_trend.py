"""A gain that changes while the record is taken: its change from the first row to the last, and how sure it is.

A catalyst fades, a heater fouls: the model of such a record has a gain that the plant no longer has. A network may even
take the change for a curve, as the process variable lies elsewhere by then. So a linear model asks the rows.

Source: L. Ljung, System identification, 2nd ed., 1999, section 16.6 (residual tests); H. White, A heteroskedasticity-
consistent covariance matrix, Econometrica 48 (1980), 817 (sums of scores).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.innovations import Innovations, begun, innovations
from loopwright.pipeline.models.identified.output_error import fit_starts
from loopwright.pipeline.plants.simulator import Array

TREND_SDS = 4.0
"""Standard deviations from which a change is certain: 3 of 4 coolers whose gain fell by 40 % had 4.8 or more.

Steady plants of the benchmark had 1.4 at most.
"""

LEAST_TREND = 0.15
"""Share of the gain below which a change matters to no controller."""

TREND_PARTS = 40
"""Parts of the rows whose sums of scores tell the error: moves and loads last for many rows."""

ADDED_SHARE = 0.05
"""Share of an input's part of the output that is added to it, to see how the filter answers."""


class GainTrend(NamedTuple):
    """Change of a gain from the first row to the last, over the gain of the model, and its standard deviation."""

    change: float
    sd: float

    @property
    def certain(self) -> bool:
        """Whether the record shows the change beyond doubt, and it matters."""
        return abs(self.change) >= max(TREND_SDS * self.sd, LEAST_TREND)

    @property
    def at_end(self) -> float:
        """The gain in the last row, over the gain of the model."""
        return 1.0 + 0.5 * self.change


def gain_trends(model: Dynamics, data: Sequence[Stretch], n_mv: int) -> list[list[GainTrend]]:
    """The trend of each pair of output and MV, (n_y, n_mv), of a linear model; empty where no filter follows the rows.

    With t from -1/2 at the first row that counts to 1/2 at the last, gaps left out, the innovations of output i are

        e_i(k) = sum_j (g_j + h_j t(k)) f_ij(k) + q_j s_ij(k) + w(k)

    f_ij is what the filter leaves of the part of the output that MV j makes, s_ij of that part squared, which takes up
    the curve of the plant. h_j is the change. Its error is by sums of scores over ``TREND_PARTS`` parts of the rows.
    """
    if not isinstance(model, Innovations):
        try:
            model = begun(model, data)
        except ModelError:  # no filter follows the record
            return []
    n_y = data[0].y.shape[1]
    left = innovations(model, data)
    moved = [_moved(model.plant, data, j) for j in range(n_mv)]
    if left is None or any(of is None for of in moved):
        return []
    rows = np.linspace(-0.5, 0.5, len(left))
    found = []
    for i in range(n_y):
        columns = []
        for of in moved:
            parts = [part[:, i] for part in of or ()]
            size = max(float(np.concatenate(parts).std()), 1e-9)
            powers = ([part * (part / size) ** n for part in parts] for n in (0, 1))
            first, second = (_left_of(model, data, i, more, left) for more in powers)
            if first is None or second is None:
                return []
            columns += [first, second, first * rows]
        read = np.isfinite(left[:, i])
        found.append(_changes(np.column_stack(columns)[read], left[read, i]))
    return found


def _moved(plant: Dynamics, data: Sequence[Stretch], j: int) -> list[Array] | None:
    """The part (n, n_y) of each stretch's outputs that MV j makes beside its median; None where a run explodes."""
    median = float(np.median(np.concatenate([s.v[:, j] for s in data])))
    still = [replace(s, v=np.where(np.arange(s.v.shape[1]) == j, median, s.v)) for s in data]
    starts = fit_starts(plant, data)
    runs = [[plant.free_run(x, s) for x, s in zip(starts, of, strict=True)] for of in (data, still)]
    if any(run is None for of in runs for run in of):
        return None
    n_y = data[0].y.shape[1]
    return [a[0][:, :n_y] - b[0][:, :n_y] for a, b in zip(*runs, strict=True) if a is not None and b is not None]


def _left_of(model: Innovations, data: Sequence[Stretch], i: int, parts: Sequence[Array], left: Array) -> Array | None:
    """The part (n,) of ``parts`` (n,) of output i that the filter does not foresee; None where it explodes.

    ``left`` (n, n_y) are the innovations without them.
    """
    column = np.arange(left.shape[1]) == i
    more = [replace(s, y=s.y + ADDED_SHARE * column * part[:, None]) for s, part in zip(data, parts, strict=True)]
    both = innovations(model, more)
    return None if both is None else np.asarray((both - left)[:, i] / ADDED_SHARE)


def _changes(columns: Array, left: Array) -> list[GainTrend]:
    """The third of each three coefficients of ``left`` (n,) on columns (n, 3 n_mv)."""
    inverse = np.linalg.pinv(columns.T @ columns, hermitian=True)
    theta = inverse @ (columns.T @ left)
    rest = left - columns @ theta
    parts = np.array_split(np.arange(len(left)), TREND_PARTS)
    scores = np.array([columns[of].T @ rest[of] for of in parts])
    sd = np.sqrt(np.maximum(np.diag(inverse @ (scores.T @ scores) @ inverse), 0.0))
    return [GainTrend(float(theta[k]), float(sd[k])) for k in range(2, len(theta), 3)]
