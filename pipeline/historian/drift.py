"""Slow motion of a PV that its inputs do not explain: a drift, a jump, another span of the sensor, or loads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.step_response import SETTLED_BESIDE_DRIFT, settling_index
from loopwright.pipeline.historian.arx_model import (
    BLOCKS,
    LEAST_ARX_ROWS,
    NO_EFFECT,
    Blocks,
    Linear,
    answer_of,
    blocks_of,
    free_run,
    least_squares,
    rows_of,
    whole,
)
from loopwright.pipeline.historian.cleaning.findings import Finding
from loopwright.pipeline.historian.cleaning.outliers_and_units import usual
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record

# --------------------------------------------------------- the part of a PV that the past of the inputs alone explains

# lags beyond BLOCKS that share a coefficient; the last are left out first
SLOW_LAGS = ((41, 81), (81, 161), (161, 321))
WEAK_INPUT = 0.01  # part in the answer, over the strongest input's
MOST_LAG_SHARE = 0.05  # of the rows: longer lags explain by chance what the inputs did not cause
DRIFT_CHUNK = 200_000  # rows


def explained(y: Array, u: Sequence[Array], piece: NDArray[np.int64]) -> tuple[Array, int]:
    """The answer (n,) to the inputs' past, NaN where a part of it is missing, and its settling time [rows].

        y_hat(k+1) = c + sum_j sum_blocks b_jl mean(u_j over block l),     by robust least squares

    y (n,), each input (n,), piece (n,). All NaN, and 0, where the rows are too few for four blocks.
    """
    out = np.full(len(y), np.nan)
    blocks: Blocks = (*BLOCKS, *SLOW_LAGS)
    while len(blocks) > len(BLOCKS) and blocks[-1][1] > MOST_LAG_SHARE * len(y):
        blocks = blocks[:-1]
    while True:
        rows = rows_of(y, u, piece, blocks[-1][1] - 1)
        if len(rows) >= max(LEAST_ARX_ROWS, 6 * len(u) * len(blocks)):
            break
        if len(blocks) <= 4:
            return out, 0
        blocks = blocks[:-1]
    centre = np.array([float(np.mean(c[rows])) for c in u])
    table = _inputs(u, centre, rows, blocks)
    theta = least_squares(table, y[rows + 1])[0]
    parts = (table[:, :-1] * theta[:-1]).reshape(len(rows), len(u), len(blocks)).sum(axis=2).std(axis=0)
    # An input without a part costs as much time as one with it.
    strong = [i for i, part in enumerate(parts) if part >= WEAK_INPUT * parts.max()]
    answers = theta[:-1].reshape(len(u), len(blocks))
    back = blocks[-1][1] - 1
    bad = np.r_[0, np.cumsum(~whole(*u), dtype=np.int32)]
    for start in range(back, len(y) - 1, DRIFT_CHUNK):
        end = min(start + DRIFT_CHUNK, len(y) - 1)
        value = np.full(end - start, theta[-1])
        first = max(start - blocks[-1][1], 0)
        for i in strong:
            value += answer_of(u[i][first:end] - centre[i], np.arange(start, end) - first, blocks, answers[i])
        seen = piece[start - back : end - back] == piece[start + 1 : end + 1]
        seen &= bad[start + 1 : end + 1] == bad[start - back : end - back]
        out[start + 1 : end + 1] = np.where(seen, value, np.nan)
    return out, _settling(theta, np.array([float(np.std(c[rows])) for c in u]), blocks)


def _inputs(u: Sequence[Array], centre: Array, rows: NDArray[np.int64], blocks: Blocks) -> Array:
    first, last = int(rows[0]) - blocks[-1][1], int(rows[-1]) + 1
    first = max(first, 0)
    columns = [blocks_of(c[first:last] - m, rows - first, blocks) for c, m in zip(u, centre, strict=True)]
    return np.column_stack([*columns, np.ones(len(rows))])


def _settling(theta: Array, motion: Array, blocks: Blocks) -> int:
    """Rows after which the answer to a step of the strongest input stays within 15 % of its largest value."""
    answers = np.cumsum(theta[:-1].reshape(len(motion), len(blocks)), axis=1)
    strongest = answers[int(np.argmax(np.abs(answers).max(axis=1) * motion))]
    settled = int(settling_index(strongest, SETTLED_BESIDE_DRIFT * np.abs(strongest).max()))
    return blocks[settled][1] - 1 if settled else 1


# -------------------------------------------------------------------------------------------------- what is left of it
LEVEL_BLOCK = 20  # rows at least that one level is the mean of; more where the plant is slow
FEWEST_LEVELS, MOST_DRIFT_LEVELS = 12, 2_000  # blocks of which levels are taken: the fewest, and about the most
LEVEL_WANDERS = 0.015  # of the PV's span: standard deviation of the levels
OF_MEAN_NOISE = 3.0  # of what noise alone leaves in a mean
EXPLAINED = 0.7  # of the levels' variance, by a ramp or a jump
WANDERING = (
    "loads that nobody measures, or an answer far from linear: the model is less exact, feedback corrects the rest; "
    "make a tag that measures such a load dv, and where you know of none check the tag and its times"
)
UNEXPLAINED_CHANGE = 0.3  # of the standard deviation of an integrator's change from block to block
JUDGED_ROWS = 0.5  # of the rows, that are judged at least
FREE_RUN_SETTLINGS = 2  # settling times, after which a free run has come to the plant's level
SPLITS = 40  # places tried for a jump
SUDDEN = 0.6  # of a jump, within two blocks
STANDS_OUT, MOST_BLOCKS = 2.5, 0.75  # times what levels change over two blocks elsewhere, but for another jump
RATIO = 0.08  # by which the answer must change with the jump, to be another span


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Means of y about what is expected, of m blocks of rows in the order of time."""

    level: Array  # (m,)
    expected: Array  # (m,) means of what is expected
    z: Array  # (m,) the same, scaled
    curve: Array  # (m, 4) powers of z
    first: NDArray[np.int64]  # (m,) row at which each begins
    span: float  # of y
    least: float  # standard deviation from which on they wander: smaller ones may be noise, or matter little

    @property
    def wander(self) -> bool:
        """Whether they do, beyond what a static nonlinearity (a cubic of what is expected) explains."""
        rest = self.level - self.curve @ np.linalg.lstsq(self.curve, self.level, rcond=None)[0]
        return float(rest.std()) >= self.least

    @property
    def percent(self) -> float:
        """Their movement, in % of the span."""
        return 100 * float(np.ptp(self.level)) / self.span


def levels_of(y: Array, expected: Array, span: float, settling: int) -> Levels | None:
    """Levels of y (n,) about ``expected`` (n,), for a plant that settles in so many rows; None of too few rows."""
    ok = np.flatnonzero(np.isfinite(y) & np.isfinite(expected))
    length = max(LEVEL_BLOCK, min(settling, len(ok) // (2 * FEWEST_LEVELS)), len(ok) // MOST_DRIFT_LEVELS)
    m = len(ok) // length
    if m < FEWEST_LEVELS or span <= 0:
        return None
    rows = ok[: m * length].reshape(m, length)
    e = expected[rows].mean(axis=1)
    z = (e - e.mean()) / max(float(e.std()), 1e-300)
    noise = float(np.median(np.std(y[rows] - expected[rows], axis=1))) / np.sqrt(length)
    curve = np.column_stack([np.ones(m), z, z**2, z**3])
    least = max(LEVEL_WANDERS * span, OF_MEAN_NOISE * noise)
    return Levels(y[rows].mean(axis=1) - e, e, z, curve, rows[:, 0], span, least)


def of_levels(name: str, y: Array, expected: Array, span: float, settling: int) -> list[Finding]:
    """One finding where the levels of y (n,) wander about what the inputs explain, ``expected`` (n,); [] otherwise."""
    found = levels_of(y, expected, span, settling)
    return [Finding("drift", name, _words(found))] if found is not None and found.wander else []


def of_quick_models(
    findings: Sequence[Finding], record: Record, models: Mapping[str, Linear | None], tags: Mapping[str, str]
) -> list[Finding]:
    """The findings, without those of PVs that their quick models explain; ``tags`` are by the PV's name as models are.

    An answer slower than the lags of ``expected`` looks like wandering, but not beside a free run. A PV that
    integrates keeps every small load for ever, so its changes are judged in place of its levels.
    """
    u = [*record.mv.T, *record.dv.T]
    found = list(findings)
    for (name, model), y in zip(models.items(), record.pv.T, strict=True):
        own = [f for f in found if f.kind == "drift" and f.tag == tags[name]]
        if model is None or not (own or model.integrates):
            continue
        run = free_run(model, u, record.run)
        if model.integrates:
            still = of_changes(tags[name], y, run, record.run)
        else:
            still = own if _wanders(y, run, model, record.run) else []
        found = [f for f in found if f not in own] + still
    return found


def _wanders(y: Array, expected: Array, model: Linear, run: NDArray[np.int64]) -> bool:
    """Whether the levels of y (n,) wander about the free run, or the free run takes too long to tell."""
    settling = [model.settling(i) for i, strength in model.strength.items() if strength >= NO_EFFECT]
    begun = np.flatnonzero(np.diff(run, prepend=-1))[run]
    reached = np.arange(len(y)) - begun >= FREE_RUN_SETTLINGS * max(settling, default=0)
    if not settling or 0 in settling or reached.mean() < JUDGED_ROWS:
        return True
    own = np.where(reached, expected, np.nan)
    return bool(of_levels("", y, own, float(np.ptp(usual(y))), max(settling)))


def of_changes(name: str, y: Array, expected: Array, run: NDArray[np.int64]) -> list[Finding]:
    """One finding where the inputs leave much of the change of y (n,) from block to block to other causes."""
    ok = np.flatnonzero(np.isfinite(y) & np.isfinite(expected))
    m = len(ok) // LEVEL_BLOCK
    if m < FEWEST_LEVELS:
        return []
    rows = ok[: m * LEVEL_BLOCK].reshape(m, LEVEL_BLOCK)
    same = run[rows[1:, -1]] == run[rows[:-1, 0]]
    change = np.diff(y[rows].mean(axis=1))[same]
    rest = change - np.diff(expected[rows].mean(axis=1))[same]
    noise = float(np.median(np.std(y[rows] - expected[rows], axis=1))) * np.sqrt(2 / LEVEL_BLOCK)
    share = float(rest.std() / max(float(change.std()), 1e-300))
    if share < UNEXPLAINED_CHANGE or rest.std() < OF_MEAN_NOISE * noise:
        return []
    words = f"integrates, and its inputs do not explain {100 * min(share, 1.0) ** 2:.0f} % of its changes; {WANDERING}"
    return [Finding("drift", name, words)]


class Jump(NamedTuple):
    """A jump of levels: the row at which it is, its size, and by what share the answer changes with it."""

    row: int
    size: float
    more: float
    left: float  # sum of squares beside it


def jump_of(found: Levels) -> Jump | None:
    """The jump that leaves the least of the levels, from a little of them on.

    None where it leaves more, or is not sudden: a load that wanders has a best one, too.
    """
    level, z, m, best = found.level, found.z, len(found.level), None
    for s in np.unique(np.linspace(2, m - 2, SPLITS).astype(np.int64)):
        after = (np.arange(m) >= s).astype(np.float64)
        x = np.column_stack([found.curve, after, after * z])
        left, theta = _left(x, level)
        if best is None or left < best[0].left:
            more = float(theta[-1] / max(float(found.expected.std()), 1e-300))
            jump = Jump(int(found.first[s]), float(theta[-2]), more, left)
            best = jump, level - x @ theta + theta[-2] * after, int(s)
    if best is None or best[0].left > (1 - EXPLAINED) * _left(found.curve, level)[0]:
        return None
    jump, rest, at = best
    return jump if _is_sudden(rest, at, jump.size) else None


def _words(found: Levels) -> str:
    none = _left(found.curve, found.level)[0]
    ramp, slope = _left(np.column_stack([found.curve, np.linspace(-0.5, 0.5, len(found.level))]), found.level)
    jump = jump_of(found)
    left = none if jump is None else jump.left
    if min(ramp, left) > (1 - EXPLAINED) * none:
        share = f"{found.percent:.0f} % of its usual span"  # more than 100 where the inputs held it against that
        return f"wanders: what the inputs do not explain moves over {share}; {WANDERING}"
    if jump is None or ramp < left + 0.05 * none:
        change = float(slope[-1])
        share = f"{100 * abs(change) / found.span:.0f} % of its span"
        return f"drifts by {change:.4g} over the record, {share}, without its inputs"
    share = f"{100 * abs(jump.size) / found.span:.0f} % of its span"
    words = f"jumps by {jump.size:.4g} at row {jump.row}, {share}, without its inputs"
    if abs(jump.more) > RATIO:
        times = f"{1 + jump.more:.2f} times as strongly from there on"
        return f"{words}, and answers {times}: a sensor's new span, or another product"
    return f"{words}: a calibration, or another product"


def _is_sudden(rest: Array, s: int, jump: float) -> bool:
    """Whether most of a jump of levels (m,) lies within two blocks at about block s, and no other two change so."""
    change = np.abs(rest[2:] - rest[:-2])
    near = np.abs(np.arange(1, len(rest) - 1) - s) <= 1 + len(rest) // SPLITS
    largest = float(change[near].max(initial=0.0))
    return largest > SUDDEN * abs(jump) and largest > STANDS_OUT * float(np.quantile(change[~near], MOST_BLOCKS))


def _left(x: Array, target: Array) -> tuple[float, Array]:
    """Sum of squares that least squares leaves, and the coefficients."""
    theta = np.linalg.lstsq(x, target, rcond=None)[0]
    return float(np.sum((target - x @ theta) ** 2)), np.asarray(theta, dtype=np.float64)
