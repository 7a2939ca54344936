"""How long a plant takes to settle, whether that is certain, and the sampling period that suits it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.step_response import (
    SETTLED_IN_RECORD,
    SLOPE_KEPT,
    ramp_delay,
    settling_index,
    slope_thirds,
)
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.answers import COLOUR, whitening
from loopwright.pipeline.historian.arx_model import Linear, blocks_of, fit_arx, least_squares
from loopwright.pipeline.historian.cleaning.findings import Finding
from loopwright.pipeline.historian.cleaning.record_rows import mask_stuck_and_saturated, readings_of
from loopwright.pipeline.historian.cleaning.row_grid import resampled
from loopwright.pipeline.historian.cleaning.sampling import NICE_S
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.feedback import fed_back
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.metrics import Array

# ---------------------------------------- a finite impulse response beside the model, whose noise has poles of its own
FIR_BLOCK_GROWTH = 1.25  # by which a block of lags is longer than the one before
FOLLOWED_SETTLINGS = 2.0  # settling times, over which the answer is followed
END_UNCERTAIN = 0.06  # of the answer's end: its standard deviation, from which on it is not known where it settles
RESPONSES_AGREE = 1.6  # ratio of two settling times that are the same, blocks of lags being as wide as they are
ROWS_A_LAG = 4  # rows of the fit for each of its coefficients, at least
RAMP_ROWS, RAMP_GROWTH = 60, 1.3  # rows over which a ramp is followed, and its end over the middle
MOST_FIR_ROWS = 24_000  # rows of a fit, the first ones: more cost time and hardly change it


@dataclass(frozen=True, slots=True, eq=False)
class StepAnswer:
    """The answer s (m,) of a PV to a unit step of an input, at the ends of blocks of lags, and its likely errors."""

    lag: NDArray[np.int64]  # (m,) rows after the step
    value: Array  # (m,)
    sd: Array  # (m,)

    @property
    def known(self) -> bool:
        """Whether the end is certain to a share END_UNCERTAIN of itself."""
        return bool(self.sd[-1] <= END_UNCERTAIN * abs(self.value[-1]))

    @property
    def settles(self) -> int:
        """Rows after which the answer stays within SETTLED_IN_RECORD of its end, as far as the errors tell."""
        return int(self.lag[settling_index(self.value, SETTLED_IN_RECORD * abs(self.value[-1]) + self.sd)])


def step_answers(y: Array, u: Sequence[Array], run: NDArray[np.int64], length: int) -> list[StepAnswer] | None:
    """The answer of y (n,) to each input of u, (n,) each, over ``length`` rows; None of too few rows.

        y(k+1) - y(k) = sum_j sum_l h_jl (u_j(k-l) - u_j(k-l-1)) + e(k),   e(k) = sum_i a_i e(k-i) + w(k)

    by least squares on both sides filtered by 1 - a(q). The noise has poles of its own, so that a load that comes and
    goes slowly does not make the answer seem slow; ``Linear`` has the same poles for both.
    """
    from scipy.signal import lfilter  # half a second to load

    blocks = _blocks(length)
    keep = _rows(y, run, blocks[-1][1] + COLOUR)
    if len(keep) < ROWS_A_LAG * len(blocks) * len(u):
        return None
    same = np.r_[False, run[1:] == run[:-1]]
    du = [np.nan_to_num(np.where(same, np.diff(c, prepend=c[:1]), 0.0)) for c in u]
    dy = np.nan_to_num(np.where(np.r_[same[1:], False], np.diff(y, append=y[-1:]), 0.0))
    theta, cov = _fit(dy, du, keep, blocks)
    white = whitening((dy - _answer(du, theta, keep, blocks))[keep])
    dy, du = lfilter(white, [1.0], dy), [lfilter(white, [1.0], c) for c in du]
    theta, cov = _fit(dy, du, keep, blocks)
    m = len(blocks)
    ones, lag, found = np.tril(np.ones((m, m))), np.array([b for _, b in blocks]), []
    for own in (slice(i * m, (i + 1) * m) for i in range(len(u))):
        spread = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", ones, cov[own, own], ones), 0.0))
        found.append(StepAnswer(lag, np.cumsum(theta[own]), spread))
    return found


def certain(y: Array, u: Sequence[Array], run: NDArray[np.int64], settling: Mapping[int, int]) -> frozenset[int]:
    """Inputs of u, (n,) each, after which y (n,) takes about ``settling`` rows, by impulse responses of their own.

    One fit for all inputs of which the response is followed for as long.
    """
    lengths: dict[int, list[int]] = {}
    for i, rows in settling.items():
        lengths.setdefault(_blocks(int(np.ceil(FOLLOWED_SETTLINGS * rows)))[-1][1], []).append(i)
    found = set()
    for length, inputs in lengths.items():
        answers = step_answers(y, u, run, length)
        if answers is not None:
            found |= {i for i in inputs if answers[i].known and _agree(answers[i].settles, settling[i])}
    return frozenset(found)


def _agree(one: int, other: int) -> bool:
    """Whether two settling times [rows] are the same."""
    return 1 / RESPONSES_AGREE < (one + 1) / (other + 1) < RESPONSES_AGREE


def grows(y: Array, u: Sequence[Array], run: NDArray[np.int64], i: int) -> bool:
    """Whether y (n,) goes on and on after a step of input ``i``, for certain."""
    answers = step_answers(y, u, run, RAMP_ROWS)
    if answers is None or not (found := answers[i]).known:
        return False
    middle = int(np.searchsorted(found.lag, found.lag[-1] / 2))
    return bool(abs(found.value[-1]) > RAMP_GROWTH * abs(found.value[middle]))


def _blocks(length: int) -> list[tuple[int, int]]:
    """Lags first .. last-1 that share a coefficient, from 0 to ``length`` or a little more."""
    ends = [0, 1]
    while ends[-1] < length:
        ends.append(max(ends[-1] + 1, int(FIR_BLOCK_GROWTH * ends[-1])))
    return list(pairwise(ends))


def _rows(y: Array, run: NDArray[np.int64], back: int) -> NDArray[np.int64]:
    """Rows k with ``back`` rows before and one after in their run, y known as far back as noise remembers."""
    k = np.arange(back, len(y) - 1)
    missing = np.r_[0, np.cumsum(~np.isfinite(y))]
    k = k[(run[k - back] == run[k + 1]) & (missing[k + 2] == missing[k - COLOUR])]
    return k[:MOST_FIR_ROWS]


def _fit(dy: Array, du: Sequence[Array], k: NDArray[np.int64], blocks: list[tuple[int, int]]) -> tuple[Array, Array]:
    x = np.column_stack([blocks_of(c, k, tuple(blocks)) for c in du])
    theta, cov, _ = least_squares(x, dy[k])
    return theta, cov


def _answer(du: Sequence[Array], theta: Array, k: NDArray[np.int64], blocks: list[tuple[int, int]]) -> Array:
    out = np.zeros(len(du[0]))
    out[k] = np.column_stack([blocks_of(c, k, tuple(blocks)) for c in du]) @ theta
    return out


# ------------------------------------------------------------------- settling time and period, by readings of any rate

# in which a plant settles: the longest look ahead, and what is usual
MOST_PERIODS, WANTED_PERIODS, LEAST_PERIODS = 60, 40, 28
FINE_EXPORT = 240  # periods up to which an export keeps its step, where its rows as they are show the settling
FAST, A_HOLD = 4, 3  # periods that the fastest answer, and a hold of an MV, still have
FACTORS = (1, 3, 10, 30, 100, 300, 1000)  # by which the rows are thinned out
LEAST_FIT_ROWS = 200  # of a fit
RESOLVED = 8  # rows from which an answer's settling is known well enough
AGREES = 1.3  # ratio of two settling times that are the same
CLEAR_ANSWER = 10.0  # strength of an answer
A_PART = 0.1  # of what the largest answer of a PV is: smaller ones do not count
MOST_SETTLING_SHARE = 0.2  # of the rows, up to which an answer's settling is believed
RAMP_LINE, LATENESS = (41, 120), 3  # rows between which a ramp's line is laid, and how often its lateness is taken
MV_MOVE = 0.02  # of an MV's span


@dataclass(frozen=True, slots=True)
class SettlingAnswer:
    """How long a PV takes to settle after a move of an MV; one that goes on as a ramp, to get going and to stop."""

    pv: str
    mv: str
    settles_s: float
    shown: bool  # by the export's rows as they are, and not only when they are thinned out


@dataclass(frozen=True, slots=True)
class Pace:
    """The clear answers of a plant, how long its MVs are usually held, and whether these follow its PVs.

    Only ``answers`` decide anything; ``uncertain`` are those whose settling time another model does not confirm.
    """

    answers: tuple[SettlingAnswer, ...] = ()
    hold_s: float = np.inf  # [s] the shortest usual one
    uncertain: tuple[SettlingAnswer, ...] = ()
    fed_back: bool = False  # by the readings: rows averaged from them may hide it

    @property
    def slowest(self) -> SettlingAnswer | None:
        """The answer that takes longest; None where none is clear."""
        return max(self.answers, key=lambda a: a.settles_s, default=None)

    def suits(self, step_s: float) -> bool:
        """Whether rows of step_s [s] show how the plant settles, in some MOST_PERIODS, or at most FINE_EXPORT."""
        slowest = self.slowest
        return slowest is None or slowest.settles_s <= (FINE_EXPORT if slowest.shown else MOST_PERIODS) * step_s

    def period(self, step_s: float) -> float:
        """The period [s] for an export with a reading every step_s: step_s itself where that suits.

        Else a usual number in which the slowest answer takes some WANTED_PERIODS periods and at most MOST_PERIODS or
        so, and, as far as that leaves room, the fastest one FAST of them, and a hold of an MV A_HOLD.
        """
        return step_s if self.slowest is None or self.suits(step_s) else self.longer(step_s, self.slowest.settles_s)

    def longer(self, step_s: float, slow: float) -> float:
        """A multiple of step_s with which the plant settles within MOST_PERIODS; slow [s] is its settling."""
        fast = min(a.settles_s for a in self.answers)
        wanted = max(min(slow / WANTED_PERIODS, fast / FAST, self.hold_s / A_HOLD), slow / MOST_PERIODS)
        usual = [n for n in NICE_S if slow / MOST_PERIODS <= n <= slow / LEAST_PERIODS and _is_multiple(n, step_s)]
        if usual:
            return float(min(usual, key=lambda n: abs(np.log(n / wanted))))
        return float(f"{step_s * np.ceil(wanted / step_s - 1e-6):.12g}")


def of_period(pace: Pace, period_s: float, step_s: float, *, given: bool) -> list[Finding]:
    """The record's period and its reason, where it is not the export's own or short for the plant."""
    slowest = pace.slowest
    if slowest is None:
        return _undecided(pace, step_s, given=given)
    if slowest.settles_s <= MOST_PERIODS * step_s:
        return []
    settles = f"takes about {in_words(slowest.settles_s)} to settle after {slowest.mv}"
    if slowest.settles_s > MOST_PERIODS * period_s:
        rows, better = slowest.settles_s / period_s, pace.longer(step_s, slowest.settles_s)
        words = f"{settles}, {rows:.0f} rows of {period_s:g} s: predictive control looks at most {MOST_PERIODS} ahead"
        words += "" if slowest.shown else ", and a model learns the noise of such rows"
        return [Finding("period", slowest.pv, f"{words}; --period {better:g} lets it look as far as the plant settles")]
    if period_s <= step_s:
        return []
    words = f"one row every {period_s:g} s: it {settles}, and the export has a reading every {step_s:g} s"
    words += ", of which the rows are samples and no means, for MVs follow PVs" * pace.fed_back
    return [Finding("period", slowest.pv, words + "; --period says another" * (not given))]


def _undecided(pace: Pace, step_s: float, *, given: bool) -> list[Finding]:
    """A finding where the export's step stays, as no settling time is certain, and the plant may be slow beside it."""
    slow = max(pace.uncertain, key=lambda a: a.settles_s, default=None)
    if given or slow is None or Pace((slow,)).suits(step_s):
        return []
    words = (
        f"one model says that it takes {in_words(slow.settles_s)} to settle after {slow.mv}, another does not agree: "
        f"loads or a controller may look like a slow answer. The rows stay at the export's {step_s:g} s; where you "
        f"know how long it takes, give --period, a {WANTED_PERIODS}th of that"
    )
    return [Finding("period", slow.pv, words)]


def in_words(seconds: float) -> str:
    """A length of time with two digits, in the unit that a person would choose."""
    unit, name = next((u for u in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")) if seconds >= 2 * u[0]), (1.0, "s"))
    value = seconds / unit
    digits = max(0, 1 - int(np.floor(np.log10(value)))) if value < 10 else 0
    return f"{round(value, digits):g} {name}"


def pace_of(series: Mapping[str, Series], tags: Sequence[Tag], step_s: float) -> Pace:
    """The pace of the plant, by an excerpt of the readings of its signals; ``step_s`` between those of the PVs.

    The linear models of ``fit_arx`` see the rows as they are and thinned out. From fast rows they learn the noise, and
    in sparse ones the settling is no more than a row or two; so the sparsest count by which an answer is resolved. No
    answer where the readings give no rows.
    """
    pv, mv, dv = ([series[t.tag] for t in tags if t.role == role] for role in ("pv", "mv", "dv"))
    cut = readings_of(pv, (*pv, *mv, *dv), step_s)
    try:
        grid, rates = resampled([cut[s.tag] for s in (*pv, *dv)], [cut[s.tag] for s in mv], step_s)
    except RecordError:  # of the record's own rows, whose period a person may have given, it is raised again
        return Pace()
    # A sensor that is stuck would answer to nothing, and make the plant seem to settle otherwise in rows thinned out.
    mask_stuck_and_saturated(grid, [t for t in tags if t.tag in grid.value], {rate.tag: rate for rate in rates})
    known = {tag: grid.known(tag) for tag in grid.value}
    names, inputs = [s.tag for s in pv], [s.tag for s in (*mv, *dv)]
    spans = np.array([_span(known[tag]) for tag in inputs])
    u, y = (np.column_stack([known[s.tag] for s in group]) for group in (mv, pv))
    back = fed_back(u, y, grid.piece)
    found: dict[tuple[str, str], list[tuple[int, bool, float]]] = {}
    thinned: dict[int, tuple[dict[str, Array], NDArray[np.int64]]] = {}
    for factor in FACTORS:
        if factor > 1 and len(grid) < factor * LEAST_FIT_ROWS:
            break
        thinned[factor] = value, run = _thinned(known, grid.piece, {s.tag for s in mv}, factor, back)
        for name in names:
            model = fit_arx(value[name], [value[tag] for tag in inputs], run)
            if model is not None:
                for i, answer in _answers(model, spans, len(mv)).items():
                    found.setdefault((name, inputs[i]), []).append((factor, *answer))
    settled = {pair: _settling(rows) for pair, rows in found.items()}
    most = MOST_SETTLING_SHARE * len(grid)
    answers: dict[bool, list[SettlingAnswer]] = {True: [], False: []}
    for (name, moved), (n, shown) in settled.items():
        if 0 < n <= most:
            factor = max((f for f, _, _ in found[name, moved] if n >= RESOLVED * f), default=1)
            value, run = thinned[factor]
            z, i, rows = [value[tag] for tag in inputs], inputs.index(moved), max(round(n / factor), 1)
            kind = found[name, moved][-1][1]
            sure = i in certain(value[name], z, run, {i: rows}) if kind else grows(value[name], z, run, i)
            answers[sure].append(SettlingAnswer(name, moved, n * step_s, shown))
    hold = min((_hold(known[s.tag], grid.piece) for s in mv), default=np.inf) * step_s
    return Pace(tuple(answers[True]), hold, tuple(answers[False]), back)


def _thinned(
    value: dict[str, Array], piece: NDArray[np.int64], held: set[str], factor: int, sampled: bool
) -> tuple[dict[str, Array], NDArray[np.int64]]:
    """Values (m,) of tags, (n,) each, by ``factor`` rows, and the pieces (m,): as ``resampled`` takes them.

    Row k has the means of what is ``held`` from its time on, and of the others up to its time; all at its own time
    where they are ``sampled``.
    """
    if factor == 1:
        return value, piece
    place = np.arange(len(piece)) - np.searchsorted(piece, piece)
    row = np.flatnonzero(place % factor == factor - 1)
    row = row[row + factor <= len(piece)]
    row = row[piece[row + factor - 1] == piece[row]]
    if sampled:
        return {tag: v[row] for tag, v in value.items()}, piece[row]
    return {tag: _means(v, row if tag in held else row - factor + 1, factor) for tag, v in value.items()}, piece[row]


def _means(v: Array, first: NDArray[np.int64], n: int) -> Array:
    """Means over n rows of v from each of ``first`` on; NaN where less than half of them are known."""
    known = np.isfinite(v)
    middle = float(np.mean(v[known])) if known.any() else 0.0
    total, count = np.r_[0.0, np.cumsum(np.where(known, v - middle, 0.0))], np.r_[0, np.cumsum(known)]
    have = count[first + n] - count[first]
    return np.where(2 * have >= n, middle + (total[first + n] - total[first]) / np.maximum(have, 1), np.nan)


def _answers(model: Linear, spans: Array, n_mv: int) -> dict[int, tuple[bool, float]]:
    """MV -> whether its clear answer settles, and the rows that it takes to; of a ramp, to get going and to stop."""
    courses = {i: model.step_response(i) for i in range(len(spans)) if model.strength[i] > CLEAR_ANSWER}
    sizes = {i: float(np.ptp(y)) * spans[i] for i, y in courses.items() if np.isfinite(y).all()}
    found: dict[int, tuple[bool, float]] = {}
    for i, size in sizes.items():
        if i >= n_mv or size < A_PART * max(sizes.values()):
            continue
        rows = model.settling(i)
        if rows:
            found[i] = (True, float(rows))
        elif _goes_on(courses[i]):
            found[i] = (False, _late(courses[i]))
    return found


def _goes_on(course: Array) -> bool:
    """Whether a step response (n,) ends with a steady slope."""
    _, middle, end = map(float, slope_thirds(np.diff(course)))
    return end != 0 and SLOPE_KEPT < middle / end < 1 / SLOPE_KEPT


def _late(course: Array) -> float:
    """LATENESS times the rows by which a ramp comes later than one that begins at once: dead time and lags together."""
    first, last = RAMP_LINE
    slope = (course[last] - course[first]) / (last - first)
    late = ramp_delay(last, course[last], slope) if slope else 0.0
    return LATENESS * max(float(late), 0.5)


def _settling(rows: Sequence[tuple[int, bool, float]]) -> tuple[float, bool]:
    """Steps in which an answer settles, of (factor, whether it settles, rows) from the finest on; 0 where none is sure.

    And whether the rows as they are show the same. The sparsest rows say whether it settles at all, since noise makes a
    ramp seem to end. A thinned fit must agree with the finer one before it, and both count; where loads that nobody
    measures bend the sparsest fits, finer ones do.
    """
    settles = rows[-1][1]
    same = [(factor * n, n) for factor, kind, n in rows if kind is settles]
    at = max((i for i, (_, n) in enumerate(same) if n >= RESOLVED), default=0)
    if not settles and same[at][1] < RESOLVED:  # a ramp that begins at once, by rows of any rate
        return min(n for n, _ in same), True
    finest, first, own = rows[0]
    if at == 0:
        return (same[0][0], True) if finest == 1 and first is settles else (0.0, False)
    for place in range(at, 0, -1):
        (before, _), (steps, n) = same[place - 1], same[place]
        row = steps / n
        if (steps - row) / AGREES < before < (steps + row) * AGREES:
            both = float(np.sqrt(before * steps))
            if place < at and both <= FINE_EXPORT:  # less sure, and no reason to leave the export's step
                break
            shown = finest == 1 and first is settles and 1 / AGREES < own / both < AGREES
            return (own, True) if shown else (both, False)
    return 0.0, False


def _span(v: Array) -> float:
    """From the 1 % to the 99 % quantile."""
    known = v[np.isfinite(v)]
    return float(np.ptp(np.quantile(known, [0.01, 0.99]))) if known.size else 0.0


def _hold(u: Array, piece: NDArray[np.int64]) -> float:
    """Rows that an MV u (n,) is usually held for, at least: the 10 % quantile; infinite where it is not."""
    step = np.abs(np.diff(u))
    at = np.flatnonzero((step > MV_MOVE * _span(u)) & (piece[1:] == piece[:-1]))
    return float(np.quantile(np.diff(at), 0.1)) if len(at) > 1 else np.inf


def _is_multiple(n: float, step_s: float) -> bool:
    return n > step_s * (1 - 1e-6) and abs(n / step_s - round(n / step_s)) < 1e-6
