"""Whether the MVs of a record follow its PVs: feedback, of a controller or of a careful operator.

A correlation of u(k) and y(k) beyond the past may be the controller's answer to y(k), or the plant's answer to u(k)
where it acts within the row. A controller pushes against what it sees: its share has the sign opposite to the answer
that the plant gives in later rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.answers import DirectModel
from loopwright.pipeline.metrics import Array

Runs = NDArray[np.int64]

OWN, SEEN_ROWS = 3, 3  # rows of an MV's own past, and of a PV's, that explain its moves
MOST_FEEDBACK_ROWS = 60_000  # rows: from twice as many on every second is taken; more cost time and decide nothing
FEEDBACK_F = 10.0  # F of a share, below which it is chance
PLANT_ANSWER_ROWS = (5, 30)  # rows after a move over which the plant's answer is told from the controller's
PLANT_ANSWER_SDS = 2.0  # standard deviations of that answer
INTEGRAL = 0.7  # weight of u's past in u(k), of which an integral has 1
CLIPPED = 5.0  # typical moves beyond which a move counts as this one: set points and hands move by far more
STANDING, LEAST_MOVING = 20, 0.1  # rows of one value of an MV that stands; share of the rows in which it has to move
FED_BACK = 0.1  # share of the clipped moves that the PVs' past explains


def follows(u: Array, y: Array, run: Runs) -> float:
    """Share of the variance of u(k) - u(k-1) that y(k) and the rows before explain beyond u's own past: feedback.

    Both (n,); 0 where the input never moves. The part that y(k-1) and the rows before explain, of a plant that answers
    within the row. Rows without a reading end a run.
    """
    u, y, run = _read(u, y, run)
    with_row, earlier = _shares(np.diff(u, prepend=u[:1]), u, y, run)
    return earlier if with_row > 2 * earlier and not _opposes(u, y, run) else with_row


def fed_back(u: Array, y: Array, run: Runs) -> bool:
    """Whether any MV of u (n, n_mv) follows any PV of y (n, n_pv) in the rows in which neither is moved by hand.

    Like ``follows``, of moves within ``CLIPPED`` typical ones: a step of a set point is rare and large, and hides what
    the controller does in all other rows. Rows in which the MV stands are those of a hand, or of a step test, and say
    nothing of a controller in the others; an MV that stands in nearly all of them follows nothing.
    """
    for column in u.T:
        moving = np.where(_stands(column, run), np.nan, column)
        for pv in y.T:
            own, seen, part = _read(moving, pv, run)
            if len(own) < LEAST_MOVING * len(column):
                continue
            move = np.diff(own, prepend=own[:1])
            if not len(own) or (typical := float(np.median(np.abs(move)))) <= 1e-9 * float(np.ptp(own)):
                continue
            clipped = np.clip(move, -CLIPPED * typical, CLIPPED * typical)
            with_row, earlier = _shares(clipped, own, seen, part)
            if earlier > FED_BACK or (with_row > FED_BACK and _opposes(own, seen, part)):
                return True
    return False


def _stands(u: Array, run: Runs) -> NDArray[np.bool_]:
    """Rows (n,) of an MV u (n,) that keeps its value for ``STANDING`` rows or more."""
    changes = np.r_[True, (np.diff(u) != 0) | (np.diff(run) != 0)]
    piece = np.cumsum(changes) - 1
    return np.asarray(np.bincount(piece)[piece] >= STANDING)


def _read(u: Array, y: Array, run: Runs) -> tuple[Array, Array, Runs]:
    """The rows in which both were read, and the runs that the others part."""
    good = np.isfinite(u) & np.isfinite(y)
    return u[good], y[good], (run + np.cumsum(~good))[good]


def _shares(move: Array, u: Array, y: Array, run: Runs) -> tuple[float, float]:
    """Shares of the moves (n,) that y explains beyond u's past: with its own row, and from the row before on."""
    back = max(OWN, SEEN_ROWS) + 1
    k = np.arange(back, len(u))
    k = k[run[k] == run[k - back]]
    k = k[:: max(1, len(k) // MOST_FEEDBACK_ROWS)]
    if len(k) < 60:
        return 0.0, 0.0
    own = np.column_stack([u[k - 1], *(u[k - i] - u[k - i - 1] for i in range(1, OWN)), np.ones(len(k))])
    total = _rest(own, move[k])
    if total <= 1e-12 * float(np.var(u)) or total <= 0:
        return 0.0, 0.0
    found = []
    for first in (0, 1):
        seen = np.column_stack([own, *(y[k - i] for i in range(first, first + SEEN_ROWS))])
        share = 1.0 - _rest(seen, move[k]) / total
        f = share * (len(k) - seen.shape[1]) / max(1 - share, 1e-9) / SEEN_ROWS
        found.append(float(share) if f > FEEDBACK_F else 0.0)
    return found[0], found[1]


def _opposes(u: Array, y: Array, run: Runs) -> bool:
    """Whether u(k) and y(k) move together, beyond their past, with the sign opposite to y's answer in later rows.

    Where that answer is not certain, whether u(k) goes on from u(k-1), as a controller's integral does.
    """
    k = np.arange(OWN + 1, len(u))
    k = k[run[k] == run[k - OWN - 1]]
    past = np.column_stack([*(z[k - i] for z in (u, y) for i in range(1, OWN + 1)), np.ones(len(k))])
    model = DirectModel.of(y, u[:, None], run)
    answer, sd = (0.0, 1.0) if model is None else model.answer(0, *PLANT_ANSWER_ROWS)
    if abs(answer) > PLANT_ANSWER_SDS * sd:
        both = np.column_stack([u[k], y[k]])
        left = both - past @ np.linalg.lstsq(past, both, rcond=1e-10)[0]
        return bool(float(left[:, 0] @ left[:, 1]) * answer < 0)
    goes_on = np.linalg.lstsq(np.column_stack([y[k], past]), u[k], rcond=1e-10)[0][1 : 1 + OWN]
    return bool(goes_on.sum() > INTEGRAL)


def _rest(x: Array, y: Array) -> float:
    """Variance of y (n,) that no combination of the columns of x (n, p) explains."""
    x = x / np.maximum(np.abs(x).max(axis=0), 1e-300)
    return float(np.var(y - x @ np.linalg.lstsq(x, y, rcond=None)[0]))
