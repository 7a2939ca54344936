"""Whether a controller of several loops stands what a record leaves open of a few answers.

With several MVs an answer may be too small beside the noise to be certain in sign, and decide nothing: a
controller that takes it for the model's goes to the set points all the same.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopwright.pipeline.models.identified.proof import UNCERTAIN, Answer
from loopwright.pipeline.models.identified.structure import Structure
from loopwright.pipeline.plants.simulator import Array

MOST_OPEN = 8  # answers that are open together
DIRECTIONS = 2_000  # in which the plants that a record leaves open are looked at in each round
NEARER = (1.0, 0.3, 0.1, 0.03)  # how far the directions of a round lie about the worst one of the rounds before


def unused_answers(
    answers: Mapping[tuple[int, int], Answer], unit: Array, structure: Structure, shape: tuple[int, int]
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


def sign_margin(answers: Mapping[tuple[int, int], Answer], rest: Array, sds: float) -> float:
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
