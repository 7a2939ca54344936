"""The part of a PV that the inputs alone explain: its answer to their past, without its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.linear import (
    BLOCKS,
    LEAST_ROWS,
    Blocks,
    answer_of,
    blocks_of,
    least_squares,
    rows_of,
    whole,
)
from loopwright.pipeline.metrics import Array

SLOW = ((41, 81), (81, 161), (161, 321))  # lags beyond BLOCKS that share a coefficient; the last are left out first
SETTLED = 0.15
WEAK = 0.01  # part in the answer, over the strongest input's
MOST_SHARE = 0.05  # of the rows: longer lags explain by chance what the inputs did not cause
CHUNK = 200_000  # rows


def explained(y: Array, u: Sequence[Array], piece: NDArray[np.int64]) -> tuple[Array, int]:
    """The answer (n,) to the inputs' past, NaN where a part of it is missing, and its settling time [rows].

        y_hat(k+1) = c + sum_j sum_blocks b_jl mean(u_j over block l),     by robust least squares

    y (n,), each input (n,), piece (n,). All NaN, and 0, where the rows are too few for four blocks.
    """
    out = np.full(len(y), np.nan)
    blocks: Blocks = (*BLOCKS, *SLOW)
    while len(blocks) > len(BLOCKS) and blocks[-1][1] > MOST_SHARE * len(y):
        blocks = blocks[:-1]
    while True:
        rows = rows_of(y, u, piece, blocks[-1][1] - 1)
        if len(rows) >= max(LEAST_ROWS, 6 * len(u) * len(blocks)):
            break
        if len(blocks) <= 4:
            return out, 0
        blocks = blocks[:-1]
    centre = np.array([float(np.mean(c[rows])) for c in u])
    table = _inputs(u, centre, rows, blocks)
    theta = least_squares(table, y[rows + 1])[0]
    parts = (table[:, :-1] * theta[:-1]).reshape(len(rows), len(u), len(blocks)).sum(axis=2).std(axis=0)
    # An input without a part costs as much time as one with it.
    strong = [i for i, part in enumerate(parts) if part >= WEAK * parts.max()]
    answers = theta[:-1].reshape(len(u), len(blocks))
    back = blocks[-1][1] - 1
    bad = np.r_[0, np.cumsum(~whole(*u), dtype=np.int32)]
    for start in range(back, len(y) - 1, CHUNK):
        end = min(start + CHUNK, len(y) - 1)
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
    """Rows after which the answer to a step of the strongest input stays within SETTLED of its largest value."""
    answers = np.cumsum(theta[:-1].reshape(len(motion), len(blocks)), axis=1)
    strongest = answers[int(np.argmax(np.abs(answers).max(axis=1) * motion))]
    outside = np.flatnonzero(np.abs(strongest - strongest[-1]) > SETTLED * np.abs(strongest).max())
    return blocks[min(int(outside[-1]) + 1, len(blocks) - 1)][1] - 1 if outside.size else 1
