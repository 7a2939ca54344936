"""A controller of several loops beside a few answers that the record leaves open: its worth on all such plants."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from loopwright.pipeline.models.identified.model_validation import UNCERTAIN, ProvenAnswer
from loopwright.pipeline.models.identified.structure import Structure
from loopwright.pipeline.plants.simulator import Array

MOST_OPEN = 8  # answers that are open together
DIRECTIONS = 2_000  # in which the plants that a record leaves open are looked at in each round
NEARER = (1.0, 0.3, 0.1, 0.03)  # how far the directions of a round lie about the worst one of the rounds before


def unused_answers(
    answers: Mapping[tuple[int, int], ProvenAnswer], unit: Array, structure: Structure, shape: tuple[int, int]
) -> Array:
    """Answers (n_cv, n_mv), scaled, of the pairs that no controller uses, 0 of the others.

    ``unit`` (n_v, length, n_y) are the model's answers to unit steps. Each is the mean over the rows of the strongest
    answer of its output, so that all of one output are of one age.
    """
    found = np.zeros(shape)
    for i in range(shape[0]):
        used = {j: answer for (of, j), answer in answers.items() if of == i}
        if not used:
            continue
        strongest = max(used.values(), key=lambda answer: abs(answer.model))
        for j in set(range(shape[1])) - set(used):
            late = 1 + structure.delays[j] - int(structure.same_row)  # row of the first point
            first, last = (max(row - late, 0) for row in (strongest.first, strongest.last))
            found[i, j] = unit[j, first : last + 1, i].mean() if strongest.last >= late else 0.0
    return found


def sign_margin(answers: Mapping[tuple[int, int], ProvenAnswer], rest: Array, sds: float) -> float:
    """The least that integral action on the model's gains G is worth on plants G' that the record leaves open.

        min Re eig(G' G^+)

    over the uncertain answers that are together ``sds`` standard deviations off those of one-step predictions,

        sum_i (g'_i - g_i)^2 / sd_i^2 = sds^2

    all others as the model has them. 1 where none is uncertain. Above zero slow integral action whose moves are G^+ of
    the errors is stable on each of these plants; below it runs away on one. All answers at their ends at once would be
    far less likely than one alone. ``rest`` (n_y, n_mv) holds the
    answers that no controller uses. Minus infinity where one-step predictions find no number, or more than
    ``MOST_OPEN`` answers are open.

    Source: M. Morari, E. Zafiriou, Robust Process Control, 1989, section 14.3 (integral controllability).
    """
    gains = rest.copy()
    for place, answer in answers.items():
        gains[place] = answer.model
    uncertain = [(place, a) for place, a in answers.items() if a.verdict == UNCERTAIN]
    open_to = [(place, a.direct, sds * a.sd) for place, a in uncertain if a.direct is not None and a.sd is not None]
    if len(open_to) < len(uncertain) or len(open_to) > MOST_OPEN or not np.all(np.isfinite(gains)):
        return -np.inf
    if not open_to:
        return 1.0
    inverse, plants, rng = np.linalg.pinv(gains), np.tile(gains, (DIRECTIONS, 1, 1)), np.random.default_rng(0)
    least, worst = 1.0, np.zeros(len(open_to))
    for aside in NEARER:
        ways = worst + aside * rng.normal(size=(DIRECTIONS, len(open_to)))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        for way, ((i, j), direct, width) in zip(ways.T, open_to, strict=True):
            plants[:, i, j] = direct + way * width
        # Of more outputs than MVs only as many can be held: the others have eigenvalues of zero.
        found = np.linalg.eigvals(inverse @ plants if gains.shape[0] > gains.shape[1] else plants @ inverse)
        margins = found.real.min(axis=1)
        if margins.min() < least:
            least, worst = float(margins.min()), ways[margins.argmin()]
    return least


def sign_margins(
    answers: Mapping[tuple[int, int], ProvenAnswer], unit: Array, structure: Structure, n_cv: int, n_mv: int, sds: float
) -> dict[int, float]:
    """The ``sign_margin`` of each output whose open answers it can judge; of one MV there is none to outweigh them.

    Outputs below ``n_cv`` have set points: one margin of them all. A further one has a range alone, which is at work at
    times, beside any of the others, or without them where operators take these out. Its margin is the least over all
    groups of outputs with it that the MVs can hold at once. ``unit`` (n_v, length, n_y) are the model's answers to
    unit steps.
    """
    if n_mv < 2:
        return {}
    n_y = unit.shape[2]
    rest = unused_answers(answers, unit, structure, (n_y, n_mv))
    known = dict[tuple[int, ...], float]()

    def of(group: tuple[int, ...]) -> float:
        if group not in known:
            rows = {i: row for row, i in enumerate(group)}
            found = {(rows[i], j): answer for (i, j), answer in answers.items() if i in rows}
            known[group] = sign_margin(found, rest[list(group)], sds)
        return known[group]

    controlled, found = tuple(range(n_cv)), dict[int, float]()
    for i in range(n_y):
        if i < n_cv:
            found[i] = of(controlled)
            continue
        others = [k for k in range(n_y) if k != i]
        groups = (tuple(sorted((i, *more))) for size in range(min(n_mv, n_y)) for more in combinations(others, size))
        uncertain = any(of_output == i and answer.verdict == UNCERTAIN for (of_output, _), answer in answers.items())
        found[i] = min(map(of, groups)) if uncertain else 1.0
    return {i: margin for i, margin in found.items() if np.isfinite(margin)}
