"""Choice among quick linear models of a PV: one that rests, one that integrates, or one beside a slow drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.linear import Linear, answer_of, fitted
from loopwright.pipeline.metrics import Array

WINDOW, WINDOWS = 400, 8  # rows of a free run that is compared, and how many there are at least
KNOTS = (32, 8)  # of lines in time that take up a drift
SETTLINGS = 4  # between two knots at least: shorter lines take up the answers too
AS_GOOD = 1.1  # error over another model's
UNEXPLAINED = 0.8  # of the motion of y: an integrator that leaves more is none
STRONG = 4.0  # inputs with an answer
GAIN, SETTLES = 0.1, 1.3  # relative change of a gain, and ratio of two settling times: by a drift


def believed(y: Array, u: Sequence[Array], run: NDArray[np.int64]) -> Linear | None:
    """The quick model of y (n,) from inputs u, (n,) each, for gain and settling; None where there is none.

    Noise in y pulls a pole at 1 below 1. So a model with the pole at 1 is taken where the plain one does not settle
    and its free run is no better. A drift pulls the poles towards 1. So a model beside lines in time is taken where
    it settles well within one line, and in less time or to another gain than the plain one.
    """
    plain = fitted(y, u, run)
    if plain is None:
        return None
    error = free_run_error(plain, y, u, run)
    level = fitted(y, u, run, integrates=True)
    ramps = [i for i in range(len(u)) if level is not None and level.ramps(i)]
    settles = any(plain.settling(i) for i in ramps)
    if level is not None and ramps and not settles:
        most = min(AS_GOOD * error, UNEXPLAINED * _motion(y, run))
        if free_run_error(level, y, u, run) <= most:
            return replace(level, sure=True)
    for knots in KNOTS:
        beside = fitted(y, u, run, slow=knots)
        if beside is None or not _within_lines(beside, len(plain.rows) / knots):
            continue
        if not _differ(plain, beside):
            return replace(plain, sure=True)
        if free_run_error(beside, y, u, run) <= AS_GOOD * error:
            return replace(beside, sure=True)
    return plain


def _within_lines(model: Linear, length: float) -> bool:
    """Whether every answer settles well within ``length`` rows."""
    settling = [model.settling(i) for i, strength in model.strength.items() if strength > STRONG]
    return bool(settling) and all(0 < rows * SETTLINGS <= length for rows in settling)


def _differ(one: Linear, other: Linear) -> bool:
    """Whether two models disagree on a gain or a settling time."""
    for i, strength in other.strength.items():
        if strength > STRONG:
            a, b = (m.settling(i) for m in (one, other))
            gains = [float(m.step_response(i)[-1]) for m in (one, other)]
            if not a or a > SETTLES * b or abs(gains[0] - gains[1]) > GAIN * abs(gains[1]):
                return True
    return False


def free_run(model: Linear, u: Sequence[Array], run: NDArray[np.int64]) -> Array:
    """Answer (n,) of the model to the inputs alone from rest at the start of each run (n,); NaN until lags are full."""
    from scipy.signal import lfilter  # half a second to load, here and elsewhere in this room, for who screens alone

    back = model.blocks[-1][1]
    out = np.full(len(run), np.nan)
    edges = np.r_[0, np.flatnonzero(np.diff(run)) + 1, len(run)]
    for start, end in pairwise(edges):
        if end - start <= back + 2:
            continue
        k = np.arange(back - 1, end - start - 1)
        drive = np.zeros(len(k))
        for i, weights in enumerate(model.b):
            drive += answer_of(u[i][start:end] - model.centre[i], k, model.blocks, weights)
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable model
            out[start + back : end] = lfilter([1.0], np.r_[1.0, -model.a], drive)
    return out


def free_run_error(model: Linear, y: Array, u: Sequence[Array], run: NDArray[np.int64]) -> float:
    """Standard deviation of y (n,) about the free run within windows, each about its own mean; inf if it explodes."""
    return _motion(y - free_run(model, u, run), run)


def _motion(rest: Array, run: NDArray[np.int64]) -> float:
    """Standard deviation of what is left (n,) within windows, each about its own mean, NaN left out."""
    ok = np.flatnonzero(~np.isnan(rest))
    length = max(min(WINDOW, len(ok) // WINDOWS), 2)
    m = len(ok) // length
    if not m:
        return float("inf")
    rows = ok[: m * length].reshape(m, length)
    rows = rows[run[rows[:, 0]] == run[rows[:, -1]]]
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.sqrt(np.mean(np.var(rest[rows], axis=1)))) if len(rows) else float("inf")
    return error if np.isfinite(error) else float("inf")
