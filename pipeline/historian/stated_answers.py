"""An engineer's statements on how a PV answers to an input, beside the record: sign, gain, and dead time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement, pairwise, product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular, toeplitz

from loopwright.pipeline.config.known import CONTRADICTION_SDS, NO_ANSWER, NONE, Known, periods_of
from loopwright.pipeline.historian.answers import COVARIANCE_RIDGE, DirectModel, blocks_to
from loopwright.pipeline.historian.arx_model import Blocks
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record

STATEMENT_WINDOWS = ((20, 30), (40, 60), (60, 90))
"""Rows after a step over which an answer is taken; the last ones come nearest to the gain."""

STATEMENT_SETTLED = 0.1
"""Share of an answer by which it may still change from the last window but one to the last where it has settled."""

ANY_ANSWER = 1e3
"""Change of a PV by a move of an input, both over their deviations: beyond it a model explodes and says nothing."""


@dataclass(frozen=True, slots=True)
class DeadTimeBounds:
    """The dead times [periods] that a record leaves: not less than ``least``, and not more than ``most``.

    ``most`` None: no answer is certain. With a dead time of d periods a move of row k first acts on row k + d + 1.
    ``slow`` periods of the lags look like dead time to who reads it off a step test.
    """

    least: int = 0
    most: int | None = None
    slow: int = 0

    def object_to(self, first: int, last: int) -> bool:
        """Whether no dead time from ``first`` to ``last`` [periods] is left, a period more or less.

        A dead time of d periods is one from d to d + 1 in seconds. One that is read off a step test holds the first
        part of the lags, which ``slow`` lets pass.
        """
        return self.least > last + 1 or (self.most is not None and self.most + self.slow < first - 1)

    def within(self, first: int, last: int) -> bool:
        """Whether all dead times that are left lie from ``first`` to ``last`` [periods], a period more or less."""
        return self.most is not None and self.most <= last + 1 and self.least >= first - 1


@dataclass(frozen=True, slots=True)
class Beside:
    """A statement beside the record: the ``answer`` (value, standard deviation) [PV/input] that is most certain.

    None where the rows are too few, or where their model explodes. ``objection`` is the answer that contradicts the
    statement for certain; None where none does. ``dead`` are the dead times that the record leaves, of a record with
    ``period_s`` [s]; None where none is stated, or where the rows are too few.
    """

    known: Known
    answer: tuple[float, float] | None = None
    objection: tuple[float, float] | None = None
    dead: DeadTimeBounds | None = None
    period_s: float = 1.0

    @property
    def question(self) -> str:
        """The question on sign and gain; empty where nothing speaks against them."""
        return "" if self.objection is None else self.known.question(*self.objection)

    @property
    def dead_question(self) -> str:
        """The question on the dead time; empty where nothing speaks against it."""
        return self.known.dead_question(*self.dead_s) if self.dead_objects else ""

    @property
    def questions(self) -> list[str]:
        """The questions to ask; empty where nothing speaks against the statement."""
        return [words for words in (self.question, self.dead_question) if words]

    @property
    def unopposed(self) -> Known | None:
        """The statement without the parts that the record contradicts; None where nothing is left of it."""
        sign, gain = ("", None) if self.question else (self.known.sign, self.known.gain)
        dead_s = None if self.dead_question else self.known.dead_s
        return replace(self.known, sign=sign, gain=gain, dead_s=dead_s) if sign or gain or dead_s else None

    @property
    def agrees(self) -> bool:
        """Whether the record by itself is certain of the sign that is said."""
        return self.answer is not None and self.known.way * self.answer[0] >= CONTRADICTION_SDS * self.answer[1]

    @property
    def dead_s(self) -> tuple[float, float | None]:
        """Least and most dead time [s] that the record leaves; None: it is certain of no answer."""
        if self.dead is None:
            return 0.0, None
        most = None if self.dead.most is None else (self.dead.most + 1) * self.period_s
        return self.dead.least * self.period_s, most

    @property
    def dead_objects(self) -> bool:
        """Whether the record is certain of another dead time."""
        return self.dead is not None and self.dead.object_to(*periods_of(self.known, self.period_s))

    @property
    def dead_agrees(self) -> bool:
        """Whether the record by itself leaves no dead time but those that are said."""
        return self.dead is not None and self.dead.within(*periods_of(self.known, self.period_s))


def beside_record(known: Sequence[Known], record: Record) -> list[Beside]:
    """Each statement beside the record.

    A sign is contradicted by an answer that is certain to have the other one and keeps it in the last window; ``none``
    by one that is certain to be more than ``NO_ANSWER``. A stated gain can only be too large for an answer that has not
    settled. A dead time is contradicted where ``dead_times_left`` leaves none of those that are said.
    """
    pvs, inputs = [s.name for s in record.pv_signals], [s.name for s in (*record.mv_signals, *record.dv_signals)]
    moves, found = np.hstack([record.mv, record.dv]), list[Beside]()
    for one in known:
        i, j = pvs.index(one.pv), inputs.index(one.input)
        y, dead = record.pv[:, i], None
        if one.dead_s is not None:
            dead = dead_times_left(y, moves, record.run, j, periods_of(one, record.period_s))
        model = DirectModel.of(y, moves, record.run, STATEMENT_WINDOWS[-1][1])
        unit = float(y.std() / max(moves[:, j].std(), 1e-300))
        answers = (
            [] if model is None else [model.answer_within(j, *rows, ANY_ANSWER * unit) for rows in STATEMENT_WINDOWS]
        )
        known_answers = [a for a in answers if a is not None]
        if not known_answers or answers[-1] is None:
            found.append(Beside(one, dead=dead, period_s=record.period_s))
            continue
        surest = max(known_answers, key=lambda a: abs(a[0]) / a[1])
        objection = _objection(one, known_answers, NO_ANSWER * unit)
        found.append(Beside(one, surest, objection, dead, record.period_s))
    return found


def _objection(one: Known, answers: Sequence[tuple[float, float]], nothing: float) -> tuple[float, float] | None:
    """The answer that contradicts sign or gain of the statement; ``answers`` of the windows, the last one last."""
    last = answers[-1]
    if one.sign == NONE:
        return next((a for a in answers if one.excludes(*a, nothing)), None)
    other = [a for a in answers if one.way * a[0] < -CONTRADICTION_SDS * a[1]]
    if other and one.way * last[0] < 0:
        return max(other, key=lambda a: abs(a[0]) / a[1])
    if one.gain is None or not one.excludes(*last):
        return None
    settled = len(answers) > 1 and abs(last[0] - answers[-2][0]) <= max(STATEMENT_SETTLED * abs(last[0]), last[1])
    low, high = one.gains
    beyond = last[0] > max(high, 0.0) or last[0] < min(low, 0.0)  # further from 0 than any gain that is said
    return last if settled or beyond else None


# ----------------------------------------------------------------------------- the dead times that a record leaves open
LONGEST_STATED = 150  # periods: a later answer would need more lags than records have rows for
BESIDE_AN_END = 3  # lags on either side of a stated end, or of the likeliest dead time, with a coefficient of their own
LOOKS = 3  # fits, each with lags of their own near the likeliest dead time of the one before
LAGS_BEYOND = 30  # lags behind the stated most: an answer that begins there must not be taken for an earlier one
FEWEST_ANSWER_LAGS = 90  # lags: those of the answers that sign and gain are compared with
MOST_COMPARED_ROWS = 60_000  # rows: more tell nothing more, and take memory
LAGS_TRIED = (0.0, *np.geomspace(1.0, 200.0, 11).tolist(), 1e4)  # rows: from none to one that integrates
SWINGS_TRIED = tuple(np.geomspace(2.0, 60.0, 8).tolist())  # rows: 1 over the angular frequency of plants that swing
DAMPINGS_TRIED = (0.2, 0.5)  # damping ratios of plants that swing, no unit; above them three lags come as near
CLEAR_CHI_SQUARED = (
    30.0  # chi-squared by which an answer is better than none: many shapes are tried, and chance gives the best some
)
CERTAIN_LOSS = 14.0  # chi-squared by which a dead time is worse, of which some ten are told apart: 3.7 deviations
ZEROS_LOSS = 6.0  # chi-squared by which a plant without zeros is worse: the two coefficients that it lacks explain 2
MORE_LAGS = 0.25  # share of the rise: so much later do five equal lags look than three, and a tangent's dead time is
RISEN = 0.632  # share of an answer's last value: a lag has risen to it after its time constant
SHAPE_RIDGE = 1e-9  # share of the squares of shapes: lags that are as good as equal stay solvable


def dead_times_left(y: Array, u: Array, run: NDArray[np.int64], j: int, said: tuple[int, int]) -> DeadTimeBounds | None:
    """The dead times of a PV y (n,) behind input j of u (n, m) that the record leaves; None where rows are too few.

    ``said`` are the least and most periods of the statement: lags near them have coefficients of their own. With
    y = G u + H e, whatever the load and whoever moves u, one-step predictions

        y(k+1) = sum_l a_l y(k-l) + sum_l b_l u(k-l) + e(k+1)   have   b_l = g_l - sum_{i<l} a_i g_(l-1-i),

    g the answer to an impulse. The g of a dead time and three poles with any zeros are compared with a and b by
    chi-squared, over the misfit of the best: a dead time is left where it is not ``CERTAIN_LOSS`` worse. Zeros can
    stand in for a dead time; where a plant without any is as good, it says which ones are too early. More lags than
    three begin so slowly that they look like a later dead time: the least is earlier by ``MORE_LAGS`` of the rise.
    """
    if said[1] > LONGEST_STATED or len(y) < 2:
        return None
    y, u, run = y[:MOST_COMPARED_ROWS], u[:MOST_COMPARED_ROWS], run[:MOST_COMPARED_ROWS]
    longest = max(FEWEST_ANSWER_LAGS, 2 * said[1] + LAGS_BEYOND)
    blocks, ends = [blocks_to(longest)] * (1 + u.shape[1]), tuple[int, ...](said)
    for _ in range(LOOKS):  # lags that share a coefficient blur the dead time; near the likeliest none does
        blocks[1 + j] = _blocks_near(longest, ends)
        model = DirectModel.of_blocks(y, u, run, blocks)
        if model is None:
            return None
        found = _losses(model, j, 2 * longest // 3)
        if found is None:
            return DeadTimeBounds()
        loss, without_zeros, rise = found
        ends = (*said, int(loss.argmin()))
    left = np.flatnonzero(loss <= loss.min() + CERTAIN_LOSS)
    least = int(left[0])
    if without_zeros.min() <= loss.min() + ZEROS_LOSS:
        least = max(least, int((without_zeros <= without_zeros.min() + CERTAIN_LOSS).argmax()))
    slow = int(np.ceil(MORE_LAGS * rise))
    least = max(int(least - MORE_LAGS * rise), 0)
    most = None if left[-1] == len(loss) - 1 else int(left[-1])
    return DeadTimeBounds(least if most is None else min(least, most), most, slow)


def _losses(model: DirectModel, j: int, latest: int) -> tuple[Array, Array, int] | None:
    """Chi-squared (latest,) of dead times from 0 on, over the misfit of the best: with any zeros, and without zeros.

    And the rows in which the best answer without zeros rises to ``RISEN``. None where there is no clear answer.
    """
    m, n = len(model.blocks[0]), len(model.blocks[1 + j])
    first, longest = sum(map(len, model.blocks[: 1 + j])), model.blocks[1 + j][-1][1]
    sums, widths = np.zeros((n, longest)), [b - a for a, b in model.blocks[0]]
    for row, (begin, end) in zip(sums, model.blocks[1 + j], strict=True):
        row[begin:end] = 1.0
    by_own = np.repeat(np.eye(m) / widths, widths, axis=1)  # a of each coefficient of y's blocks
    b_of_g = sums @ (np.eye(longest) - _past(model.theta[:m] @ by_own))
    b = model.theta[first : first + n]
    shapes, three = _poles(longest)
    plain = _cascades(shapes, three)
    g: Array = np.asarray(np.linalg.lstsq(b_of_g, b, rcond=COVARIANCE_RIDGE)[0], dtype=np.float64)
    for last in (False, True):  # how open a leaves b depends on g
        jacobian = np.zeros((n, len(model.theta)))
        jacobian[:, first : first + n] = np.eye(n)
        jacobian[:, :m] = sums @ np.column_stack([_past(one) @ g for one in by_own])
        covariance = jacobian @ model.covariance @ jacobian.T
        try:
            factor = np.linalg.cholesky(covariance + COVARIANCE_RIDGE * np.diag(np.diag(covariance)))
        except np.linalg.LinAlgError:  # a PV or an input that stands still
            return None
        target = solve_triangular(factor, b, lower=True)
        white = solve_triangular(factor, b_of_g, lower=True)
        chi = np.column_stack([_left_over(target, _late(shapes, white, dead), three) for dead in range(latest)])
        if not last:
            one, dead = np.unravel_index(int(chi.argmin()), chi.shape)
            of = np.column_stack([np.zeros((3, dead)), shapes[three[one], : longest - dead]])
            g = np.asarray(np.linalg.lstsq(white @ of.T, target, rcond=SHAPE_RIDGE)[0] @ of, dtype=np.float64)
    least, nothing = float(chi.min()), float(target @ target)
    if nothing - least < CLEAR_CHI_SQUARED:
        return None
    alone = np.column_stack([nothing - (_late(plain, white, dead) @ target) ** 2 for dead in range(latest)])
    step = np.cumsum(plain[alone.min(axis=1).argmin()])
    misfit = max(1.0, least / max(n - 7, 1))
    return chi.min(axis=0) / misfit, alone.min(axis=0) / misfit, int((step >= RISEN * step[-1]).argmax())


def _late(shapes: Array, white: Array, dead: int) -> Array:
    """Coefficients (shapes, n) of answers (shapes, lags) behind a dead time, scaled to 1."""
    columns = shapes[:, : white.shape[1] - dead] @ white[:, dead:].T
    return np.asarray(columns / np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-300))


def _left_over(target: Array, columns: Array, three: NDArray[np.int64]) -> Array:
    """Chi-squared (t,) that ``three`` (t, 3) of columns (c, n) together leave of a target (n,)."""
    squares, along = columns @ columns.T, (columns @ target)[three]
    of = squares[three[:, :, None], three[:, None, :]] + SHAPE_RIDGE * np.eye(3)
    return np.asarray(target @ target - np.einsum("ti,ti->t", along, np.linalg.solve(of, along[..., None])[..., 0]))


def _poles(rows: int) -> tuple[Array, NDArray[np.int64]]:
    """Answers (shapes, rows) to an impulse, and the numbers (t, 3) of those that make plants of three poles.

    A lag has the answer exp(-t/T), a swing exp(-z w t) cos and sin of w sqrt(1 - z^2) t.
    """
    t, n = np.arange(rows), len(LAGS_TRIED)
    shapes = [np.exp(-t / lag) if lag else (t == 0).astype(float) for lag in LAGS_TRIED]
    three = list(combinations(range(n), 3))
    for slow, z in product(SWINGS_TRIED, DAMPINGS_TRIED):
        turned = np.sqrt(1 - z * z) * t / slow
        three += [(k, len(shapes), len(shapes) + 1) for k in range(n)]
        shapes += [np.exp(-z * t / slow) * np.cos(turned), np.exp(-z * t / slow) * np.sin(turned)]
    return np.array(shapes), np.array(three)


def _cascades(shapes: Array, three: NDArray[np.int64]) -> Array:
    """Answers (c, rows) to an impulse of up to three poles in a row, without a zero; see ``_poles``."""
    n = len(LAGS_TRIED)
    chains = list(combinations_with_replacement(range(n), 3))
    swings = [(int(k), int(one)) for k, _, one in three if one >= n]
    found = [_after(_after(shapes[a], LAGS_TRIED[b]), LAGS_TRIED[c]) for a, b, c in chains]
    return np.array(found + [_after(shapes[one], LAGS_TRIED[k]) for k, one in swings])


def _after(answer: Array, lag: float) -> Array:
    """An answer (rows,) behind one more lag [rows]."""
    from scipy.signal import lfilter  # half a second to load

    pole = float(np.exp(-1 / lag)) if lag else 0.0
    return np.asarray(lfilter([1.0], [1.0, -pole], answer))


def _past(a: Array) -> Array:
    """The matrix (n, n) that makes sum_{i<l} a_i g_(l-1-i) of g (n,)."""
    return np.asarray(toeplitz(np.r_[0.0, a[:-1]], np.zeros(len(a))))


def _blocks_near(longest: int, ends: tuple[int, ...]) -> Blocks:
    """Blocks of lags up to ``longest``: of one lag each first and near some ``ends``, wider ones between."""
    edges = {edge for block in blocks_to(longest) for edge in block}
    for end in ends:
        edges |= set(range(max(end - BESIDE_AN_END, 0), end + BESIDE_AN_END + 1))
    return tuple(pairwise(sorted(edge for edge in edges if edge <= longest)))
