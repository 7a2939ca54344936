"""Outliers judged by a linear model: sharp answers to moves come back, and errors that hide on a slope are found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.arx_model import Linear, fit_arx
from loopwright.pipeline.historian.cleaning.findings import Finding, counted
from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.sampling import TagSampling
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.metrics import Array

# -------------------------------------------------------------- single readings of an MV that the plant never received
FEWEST_PULSES, MOST_PULSE_SHARE = 3, 0.03  # pulses, and share of the rows
PULSE_SIZE = 0.05  # of the MV's span
CLEARER = 20.0  # n log of the ratio of the residuals' variances, from which a PV says that there was no pulse
OUTSIDE_SDS = 6.0  # standard deviations, beyond which a residual counts no more


def remove_pulses(grid: Grid, own: Mapping[str, Series], signals: Sequence[Tag]) -> list[Finding]:
    """Take pulses of the MVs out that no PV has answered to; changes grid and series in place.

    A PV says so where a linear model of it is clearly better without the pulses than with them.
    """
    found = []
    inputs = [t.tag for t in signals if t.role != "pv"]
    for tag in (t for t in signals if t.role == "mv"):
        u = grid.value[tag.tag]
        rows = _pulses(u, grid.piece)
        if not FEWEST_PULSES <= len(rows) <= MOST_PULSE_SHARE * len(u):
            continue
        plain = u.copy()
        plain[rows] = u[rows - 1]
        table = {name: grid.value[name] for name in inputs}
        gain = 0.0
        for y in (_as_read(grid, own[t.tag]) for t in signals if t.role == "pv"):
            with_them = fit_arx(y, list(table.values()), grid.piece)
            without = fit_arx(y, list((table | {tag.tag: plain}).values()), grid.piece)
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
    away &= np.abs(u[1:-1] - u[:-2]) > PULSE_SIZE * (high - low)
    away &= u[1:-1] != u[:-2]
    return np.flatnonzero(away) + 1


def _left(model: Linear, sd: float) -> float:
    """Mean square of the residual, none counted beyond OUTSIDE_SDS."""
    return float(np.mean(np.minimum(np.abs(model.residual), OUTSIDE_SDS * sd) ** 2))


# ----------------------------------------------------------------------------------------------------- readings of PVs
CONFIRM_SD = 5.0  # residual of the model below which an outlier is an answer
ERROR_SD = 8.0  # size of a measurement's error, in standard deviations of its estimate
ERROR_SPAN = 0.01  # of the PV's span
ERROR_OVER_JUMP = 0.4  # what an error of one measurement leaves unexplained, over what a jump of the plant leaves
SLOWEST = 0.7  # step of the readings over the period, from which a row is a reading
REVIEW_CHUNK = 200_000  # rows


def review_outliers(
    grid: Grid, own: Mapping[str, Series], signals: Sequence[Tag], rates: Mapping[str, TagSampling]
) -> list[Finding]:
    """Put answers to moves back, and take errors of single measurements out; changes grid and series in place.

    Only PVs whose rows are single readings; where rows are means, the local median alone has judged.
    """
    found = []
    inputs = [t for t in signals if t.role != "pv"]
    u = [grid.value[t.tag] for t in inputs]
    for tag in (t for t in signals if t.role == "pv"):
        series, rate = own[tag.tag], rates[tag.tag]
        y = grid.value[tag.tag]
        single = rate.step_s > SLOWEST * grid.period_s and not rate.irregular
        model = fit_arx(y, u, grid.piece) if single else None
        if model is None:
            continue
        back = _answers(grid, series, model, y, u)
        if back:
            some = counted(back, "of these is an answer", "of these are answers")
            words = f"{some} to moves, by a linear model, and left in"
            found.append(Finding("answer", tag.tag, words))
        errors = _errors(model, y, u, grid.piece)
        if errors.size:
            _take_out(grid, series, rate, errors)
            some = counted(len(errors), "reading contradicts", "readings contradict")
            words = f"{some} what was before and after, by a linear model"
            found.append(Finding("outlier", tag.tag, words, True))
    return found


def _answers(grid: Grid, series: Series, model: Linear, y: Array, u: Sequence[Array]) -> int:
    """Put outliers back that the model explains; how many."""
    bad = np.flatnonzero(series.code == Reason.OUTLIER)
    row = np.searchsorted(grid.time_s, series.time_s[bad] - 0.5 * grid.period_s)
    ok = (row > model.blocks[-1][1] + 1) & (row < len(grid))
    row, bad = row[ok], bad[ok]
    if not bad.size:
        return 0
    parts = np.split(row, np.searchsorted(row, np.arange(REVIEW_CHUNK, len(y), REVIEW_CHUNK)))
    expected = np.concatenate([model.predicted(y, u, part - 1) for part in parts if part.size])
    explained = np.abs(series.value[bad] - expected) < CONFIRM_SD * model.sd
    row, bad = row[explained], bad[explained]
    y[row] = series.value[bad]
    series.code[bad] = Reason.GOOD
    grid.code[series.tag][row] = Reason.GOOD
    return len(bad)


def _errors(model: Linear, y: Array, u: Sequence[Array], piece: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows with an error d of one measurement, (m,).

        e(k+j) = p_j d,   p = (1, -a_0, -a_1, -a_2),   d = sum p_j e(k+j) / sum p_j^2

    with e the one-step residuals: an error of measurement shows in the residuals after it, a jump of the plant does
    not. Taken where d is large and leaves less of these residuals than a jump does. Source:
    [chang1988].
    """
    p = np.r_[1.0, -model.a]
    norm = float(p @ p)
    low, high = np.nanquantile(y[:: max(1, len(y) // REVIEW_CHUNK)], [0.01, 0.99])
    least = max(ERROR_SD * model.sd / np.sqrt(norm), ERROR_SPAN * float(high - low))
    found = []
    first = model.blocks[-1][1] + 1
    for start in range(first, len(y) - len(p), REVIEW_CHUNK):
        k = np.arange(start, min(start + REVIEW_CHUNK, len(y) - len(p)))
        reach = np.arange(k[0], k[-1] + len(p))
        e = y[reach] - model.predicted(y, u, reach - 1)
        window = np.lib.stride_tricks.sliding_window_view(e, len(p))
        d = window @ p / norm
        total = np.einsum("ij,ij->i", window, window)
        with np.errstate(invalid="ignore"):
            error = (np.abs(d) > least) & (total - norm * d**2 < ERROR_OVER_JUMP * (total - window[:, 0] ** 2))
        error &= piece[k - first] == piece[k + len(p) - 1]
        found.append(k[error])
    rows = np.concatenate(found) if found else np.zeros(0, dtype=np.int64)
    # Neighbours judge each other by a wrong past; a cluster is no single error.
    alone = np.r_[True, np.diff(rows) > len(p)] & np.r_[np.diff(rows) > len(p), True] if rows.size else rows > 0
    return rows[alone]


def _take_out(grid: Grid, series: Series, rate: TagSampling, rows: NDArray[np.int64]) -> None:
    """Rows become the mean of their neighbours where the hold allows it, and lose their value where not."""
    y, code = grid.value[series.tag], grid.code[series.tag]
    if rate.hold_s >= 2 * grid.period_s:
        y[rows] = 0.5 * (y[rows - 1] + y[rows + 1])
    else:
        y[rows], code[rows] = np.nan, Reason.OUTLIER
    near = np.searchsorted(series.time_s, grid.time_s[rows] - 0.5 * grid.period_s)
    near = near[near < len(series)]
    series.code[near[series.code[near] == Reason.GOOD]] = Reason.OUTLIER
