"""Tasks of identification, the free run of a model over their test rows, and the linear model to compare with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.linear_start import Realizations, high_order_arx
from loopwright.pipeline.models.identified.output_error import OutputErrorFit, fit_starts
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales, informative
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Part:
    """Neighbouring rows of the input u (n,) and the output y (n,); ``true`` (n,) is y without noise, where known."""

    u: Array
    y: Array
    true: Array | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """Rows to learn, tests by name, the rows that fit a test's initial state, and the sampling period [s].

    ``scale`` turns errors into the unit of the figures. ``overflows`` says that the plant is known to end at its
    highest reading.
    """

    learn: Part
    tests: Mapping[str, Part]
    begin: int
    period_s: float
    scale: float = 1.0
    overflows: bool = False


@dataclass(frozen=True, slots=True)
class Predictor:
    """A model that runs free over test rows: its equation, its scales, and whether the MV of a row acts on that row."""

    dynamics: Dynamics
    y_units: tuple[float, float]  # of a scaled output: its center, and its scale
    u_units: tuple[float, float]
    same_row: bool
    words: str

    def free_run(self, part: Part, begin: int, learn: Part) -> Array:
        """The output (n,) over all rows; NaN where it explodes.

        The initial state is the most likely one of the first ``begin`` rows, with the states of the free run over the
        rows to learn as what is known before. So few rows alone leave most states of a larger model open.
        """
        known = self._rows(learn)
        run = self.dynamics.free_run(fit_starts(self.dynamics, [known])[0], known)
        rows = self._rows(part)
        first = Stretch(rows.y[:begin], rows.v[:begin])
        if run is None:
            start = fit_starts(self.dynamics, [first])[0]
        else:
            spread = np.cov(run[0], rowvar=False).reshape(len(run[0].T), -1)
            sds, axes = np.linalg.eigh(spread)
            root, center = axes * np.sqrt(np.maximum(sds, 1e-12)), run[0].mean(axis=0)
            noise = float(np.sqrt(np.mean((run[0][:, 0] - known.y[:, 0]) ** 2)))

            def misses(z: Array) -> Array:
                ahead = self.dynamics.free_run(center + root @ z, first)
                missed = np.full(begin, 1e3) if ahead is None else (ahead[0][:, 0] - first.y[:, 0]) / noise
                return np.concatenate([missed, z])

            start = center + root @ least_squares(misses, np.zeros(len(center))).x
        ahead = self.dynamics.free_run(start, rows)
        y = np.full(len(part.y), np.nan) if ahead is None else ahead[0][:, 0]
        return np.asarray(y * self.y_units[1] + self.y_units[0])

    def _rows(self, part: Part) -> Stretch:
        """Scaled rows, each MV where it acts."""
        u = np.append(part.u[1:], part.u[-1]) if self.same_row else part.u
        (y0, y1), (u0, u1) = self.y_units, self.u_units
        y, v = (part.y - y0) / y1, (u - u0) / u1
        return Stretch(y[:, None], v[:, None])


def error_of(output: Array, part: Part, task: Task) -> float:
    """Root mean square error over the rows of a test that count, in the unit of the figures."""
    return task.scale * float(np.sqrt(np.mean((output - part.y)[task.begin :] ** 2)))


def linear_model(learn: Part, period_s: float, rows: int = 8000, orders: Sequence[int] = range(1, 9)) -> Predictor:
    """The best linear output-error model of all rows to learn, without `loopwright new`.

    Of orders 1 to 8 and of both conventions of rows, that with the least free-run error over the last fifth of them.
    """
    low, high, half = float(learn.u.min()), float(learn.u.max()), float(np.ptp(learn.y))
    pv = Signal("y", "-", float(learn.y.min()) - half, float(learn.y.max()) + half)
    signals = Signals(period_s, (pv,), (pv,), (), (Signal("u", "-", low, high),))
    record = informative(Record.of(signals, learn.y[:, None], learn.u[:, None]), rows)
    scales = Scales.of(record, 1)
    found = []
    for same_row in (False, True):
        data = ScaledRecord.of(record, scales).delayed([-int(same_row)])
        cut = int(0.8 * len(data))
        train, held = data.rows(slice(0, cut)).stretches(), data.rows(slice(cut, None)).stretches()
        starts = Realizations.of(high_order_arx(data).impulse_response(100), data.v.std(axis=0))
        for order in orders:
            fitted = OutputErrorFit(iterations=25).fit(starts.order(order), train, held)
            found.append((fitted.held_out, order, same_row, fitted.model))
    _, order, same_row, best = min(found, key=lambda one: one[0])
    y, u = (float(scales.y_center[0]), float(scales.y_scale[0])), (float(scales.v_center[0]), float(scales.v_scale[0]))
    return Predictor(best, y, u, same_row, f"linear, {order} states")
