"""Findings in the residual of a fit: curves that a linear model leaves, a plant that drifts, lost dynamics, colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.output_error import fit_starts
from loopwright.pipeline.plants.simulator import Array

# ---------------------------------------------------------------------------------- curves of the state and the inputs
CURVED = 0.02
"""Share of a residual's variance beyond which curves count: a model with them would gain 1 % of its error."""

CURVATURE_SDS = 4.0
"""Standard deviations by which the share must exceed what chance gives."""

ROWS_A_PRODUCT = 10
"""Rows for each coefficient below which products of different columns are left out."""


def curved(model: Dynamics, starts: Sequence[Array], data: Sequence[Stretch], correction: float = 0.0) -> bool:
    """Whether squares, products and cubes of [x(k), v(k)] explain the residual of any output at k + 1, beyond lines.

    A residual of moves that jump each period, or of runs that the outputs correct, is white whatever the plant; its
    whiteness then says nothing of curves. False where a run explodes, or where the rows are too few.
    """
    runs = [model.free_run(x, part, correction) for x, part in zip(starts, data, strict=True)]
    if any(run is None for run in runs):
        return False
    pairs = [(run, part) for run, part in zip(runs, data, strict=True) if run is not None]
    n_y = data[0].y.shape[1]
    left = np.concatenate([part.errors(before[:, :n_y])[1:] for (before, _), part in pairs])
    z = np.concatenate([np.hstack([after, part.v])[:-1] for (_, after), part in pairs])
    straight, bent = _columns(z)
    if not np.isnan(left).any():
        return _bends(straight, bent, left)
    known = np.isfinite(left)
    return any(_bends(straight[of], bent[of], left[of, i : i + 1]) for i, of in enumerate(known.T))


def _bends(straight: Array, bent: Array, left: Array) -> bool:
    """Whether columns (n, q) beside those of lines (n, p) explain a residual (n, n_y) by more than chance."""
    n, p, more = len(left), straight.shape[1], bent.shape[1]
    if n < 2 * (p + more):
        return False
    without, beside = _squares_left(straight, left), _squares_left(np.hstack([straight, bent]), left)
    # (n_y,) without what chance explains
    share = 1 - beside / (n - p - more) / np.maximum(without / (n - p), 1e-300)
    return bool(np.any(share > max(CURVED, CURVATURE_SDS * np.sqrt(2 * more) / n)))


def _squares_left(columns: Array, values: Array) -> Array:
    """Sum of squares (n_y,) of the values (n, n_y) that no combination of the columns (n, p) explains."""
    rest = values - columns @ np.linalg.lstsq(columns, values, rcond=1e-10)[0]
    return np.asarray((rest**2).sum(axis=0))


def _columns(z: Array) -> tuple[Array, Array]:
    """(1 and the columns of z (n, m) by their deviations; their squares, products and cubes)."""
    z = (z - z.mean(axis=0)) / np.maximum(z.std(axis=0), 1e-12)
    n, m = z.shape
    first, second = np.triu_indices(m)
    if n < ROWS_A_PRODUCT * (1 + 2 * m + len(first)):
        first = second = np.arange(m)
    return np.column_stack([np.ones(n), z]), np.column_stack([z[:, first] * z[:, second], z**3])


# ---------------------------------------------------------------------- a gain or a level that moves inside the record
DRIFT_PARTS = (8, 16, 32, 64, 128)
"""Numbers of parts of the record that get a gain and a level of their own: drift may be slow or quick."""

LEAST_PART_ROWS = 50
"""Fewest rows of a part."""

DRIFTED = 0.5
"""Share of the residual's power, beyond the noise, that they must explain."""

AS_GOOD_PARTS = 0.05
"""Smaller share at which longer parts still count as the best, because they leave less to chance."""

MUCH = 1.5
"""Residual over noise of a model that may lack something."""


@dataclass(frozen=True, slots=True)
class Drift:
    """Share of what a free run misses that moving gains and levels explain, and the rows over which they hold."""

    share: float
    rows: int

    @property
    def found(self) -> bool:
        """Whether drift explains most of it."""
        return self.share > DRIFTED


def drift_of(model: Dynamics, data: Sequence[Stretch]) -> Drift:
    """How much of what a free run misses is drift: of the output where that is most.

        y = g_p y_hat + l_p,   p = 1 .. P in the order of time

    A gain and a level of part p come from the parts beside it. So they cannot follow what the model lacks, which
    differs from move to move, but only what goes on from part to part. The longest parts that explain nearly the most
    count. The share is 0 for an output that the run misses by less than ``MUCH`` times the noise after one gain and
    one level of the whole record, and for a run that explodes.
    """
    rows = sum(len(part.y) for part in data)
    none = Drift(0.0, rows // DRIFT_PARTS[0])
    runs = [model.free_run(x, part) for x, part in zip(fit_starts(model, data), data, strict=True)]
    if any(run is None for run in runs):
        return none
    found = [none]
    for i in range(data[0].y.shape[1]):
        both = [
            (part.y[of, i], run[0][of, i])
            for part, run in zip(data, runs, strict=True)
            if run is not None
            for of in (part.seen[:, i],)
        ]
        floor = float(np.mean(np.concatenate([np.diff(y - predicted) for y, predicted in both]) ** 2)) / 2
        y, predicted = (np.concatenate(series) for series in zip(*both, strict=True))
        power = float(np.mean(_beyond(y, predicted, len(y)) ** 2))
        if power <= MUCH**2 * floor:
            continue
        for parts in DRIFT_PARTS:
            if len(y) >= parts * LEAST_PART_ROWS:
                left = float(np.mean(_beyond_neighbours(y, predicted, parts) ** 2))
                found.append(Drift(min((power - left) / (power - floor), 1.0), len(y) // parts))
    best = max(drift.share for drift in found)
    return max((drift for drift in found if drift.share > best - AS_GOOD_PARTS), key=lambda drift: drift.rows)


def _beyond_neighbours(y: Array, predicted: Array, parts: int) -> Array:
    """Residual (n,) of y (n,) on a gain and a level of ``predicted`` (n,), of each part by the parts beside it."""
    pieces = np.array_split(np.arange(len(y)), parts)
    found = []
    for p, rows in enumerate(pieces):
        beside = np.concatenate([*pieces[max(p - 1, 0) : p], *pieces[p + 1 : p + 2]])
        gain, level = _line(y[beside], predicted[beside])
        found.append(y[rows] - gain * predicted[rows] - level)
    return np.concatenate(found)


def error_beyond_drift(model: Dynamics, data: Sequence[Stretch], part: int) -> float:
    """Rms error of a free run, beyond a gain and a level of each ``part`` rows; infinite where it explodes."""
    n_y, found = data[0].y.shape[1], []
    for start, stretch in zip(fit_starts(model, data), data, strict=True):
        run = model.free_run(start, stretch)
        if run is None:
            return np.inf
        left = stretch.errors(run[0][:, :n_y])
        for i, of in enumerate(np.isfinite(left).T):
            # The parts of an output with fewer readings last as long, and hold fewer.
            left[of, i] = _beyond(stretch.y[of, i], run[0][of, i], max(round(part * of.mean()), 2))
        found.append(left)
    return float(np.sqrt(np.nanmean(np.concatenate(found) ** 2)))


def _beyond(y: Array, predicted: Array, part: int) -> Array:
    """Residual (n,) of y (n,) on a gain and a level of ``predicted`` (n,) for each ``part`` rows."""
    found = []
    for rows in np.array_split(np.arange(len(y)), max(round(len(y) / part), 1)):
        gain, level = _line(y[rows], predicted[rows])
        found.append(y[rows] - gain * predicted[rows] - level)
    return np.concatenate(found)


def _line(y: Array, predicted: Array) -> tuple[float, float]:
    """Gain and level of y (n,) on ``predicted`` (n,) by least squares."""
    design = np.column_stack([predicted, np.ones(len(predicted))])
    gain, level = np.linalg.lstsq(design, y, rcond=1e-10)[0]
    return float(gain), float(level)


# ------------------------------------------------------------------ dynamics that are missing, noise that has a colour
RESIDUAL_LAGS = 25
"""Lags of the residual's correlations."""


def residual_figures(
    residuals: Sequence[Array], inputs: Sequence[Array], names: Sequence[str]
) -> dict[str, dict[str, float]]:
    """For each PV's free-run residual: shares of its correlations outside the 99 % band of a white one.

    ``autocorrelated`` over lags 1 .. 25, ``input_correlated`` with the inputs at lags 0 .. 25; .01 is what chance
    gives. A share of the second far above that says that dynamics are missing; the first also sees coloured noise.
    Where an output is not read in each row, residuals are NaN, and the lags of the first count its readings.
    """
    e = np.concatenate([r - np.nanmean(r, axis=0) for r in residuals])
    v = np.concatenate([u - u.mean(axis=0) for u in inputs])
    n = len(e)
    if n <= 2 * RESIDUAL_LAGS:
        return {}
    figures = {}
    for i, name in enumerate(names):
        read = np.isfinite(e[:, i])
        # Errors of 0 where nothing is read leave the band of the correlations with the inputs as it is.
        of = e[:, i] if read.all() else np.where(read, e[:, i], 0.0)
        own = _correlations(of, of)
        apart = own if read.all() else _correlations(e[read, i], e[read, i])
        bound = 2.58 / np.sqrt(n)
        cross = []
        for u in v.T:
            # Correlated inputs widen the band: the product of both autocorrelations, after Bartlett.
            wide = np.sqrt(max(1 + 2 * float(np.sum(own[1:] * _correlations(u, u)[1:])), 1.0))
            cross.append(np.abs(_correlations(of, u)) > bound * wide)
        figures[name] = {
            "autocorrelated": float(np.mean(np.abs(apart[1:]) > 2.58 / np.sqrt(np.count_nonzero(read)))),
            "input_correlated": float(np.mean(cross)),
        }
    return figures


def _correlations(later: Array, earlier: Array) -> Array:
    """Correlation coefficients of later(k) and earlier(k - l), l = 0 .. ``RESIDUAL_LAGS``."""
    norm = max(float(np.linalg.norm(later) * np.linalg.norm(earlier)), 1e-300)
    n = len(later)
    return np.array([float(later[lag:] @ earlier[: n - lag]) for lag in range(RESIDUAL_LAGS + 1)]) / norm
