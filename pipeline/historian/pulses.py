"""Single readings of an MV that the plant never received: for one row elsewhere, and back to the same value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.export import Series
from loopwright.pipeline.historian.findings import Finding
from loopwright.pipeline.historian.grid import Grid
from loopwright.pipeline.historian.linear import Linear, fitted
from loopwright.pipeline.historian.reason import Reason
from loopwright.pipeline.historian.tags import Tag
from loopwright.pipeline.metrics import Array

FEWEST, MOST_SHARE = 3, 0.03  # pulses, and share of the rows
SIZE = 0.05  # of the MV's span
CLEARER = 20.0  # n log of the ratio of the residuals' variances, from which a PV says that there was no pulse
OUTSIDE = 6.0  # standard deviations, beyond which a residual counts no more


def pulses(grid: Grid, own: Mapping[str, Series], signals: Sequence[Tag]) -> list[Finding]:
    """Take pulses of the MVs out that no PV has answered to; changes grid and series in place.

    A PV says so where a linear model of it is clearly better without the pulses than with them.
    """
    found = []
    inputs = [t.tag for t in signals if t.role != "pv"]
    for tag in (t for t in signals if t.role == "mv"):
        u = grid.value[tag.tag]
        rows = _pulses(u, grid.piece)
        if not FEWEST <= len(rows) <= MOST_SHARE * len(u):
            continue
        plain = u.copy()
        plain[rows] = u[rows - 1]
        table = {name: grid.value[name] for name in inputs}
        gain = 0.0
        for y in (_as_read(grid, own[t.tag]) for t in signals if t.role == "pv"):
            with_them = fitted(y, list(table.values()), grid.piece)
            without = fitted(y, list((table | {tag.tag: plain}).values()), grid.piece)
            if with_them is not None and without is not None:
                gain += len(with_them.rows) * np.log(_left(with_them, without.sd) / _left(without, without.sd))
        if gain > CLEARER:
            u[rows] = plain[rows]
            series = own[tag.tag]
            near = np.searchsorted(series.time_s, grid.time_s[rows] - 0.5 * grid.period_s)
            series.code[near[near < len(series)]] = Reason.OUTLIER
            words = f"{len(rows)} moves for a single row that nothing answers to; the value before holds instead"
            found.append(Finding("outlier", tag.tag, words, True))
    return found


def _as_read(grid: Grid, series: Series) -> Array:
    """The PV (n,) with its outliers: a sharp answer to a pulse looks like one."""
    y = grid.value[series.tag].copy()
    bad = np.flatnonzero(series.code == Reason.OUTLIER)
    row = np.searchsorted(grid.time_s, series.time_s[bad] - 0.5 * grid.period_s)
    y[row[row < len(y)]] = series.value[bad[row < len(y)]]
    return y


def _pulses(u: Array, piece: NDArray[np.int64]) -> NDArray[np.int64]:
    low, high = np.nanquantile(u[:: max(1, len(u) // 200_000)], [0.01, 0.99])
    # Slices in place of lists of rows: a long record has room for one more column, not for six.
    away = (u[2:] == u[:-2]) & (piece[2:] == piece[:-2])
    away &= np.abs(u[1:-1] - u[:-2]) > SIZE * (high - low)
    away &= u[1:-1] != u[:-2]
    return np.flatnonzero(away) + 1


def _left(model: Linear, sd: float) -> float:
    """Mean square of the residual, none counted beyond OUTSIDE."""
    return float(np.mean(np.minimum(np.abs(model.residual), OUTSIDE * sd) ** 2))
