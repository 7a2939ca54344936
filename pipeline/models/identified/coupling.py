"""Whether a controller of several loops stands what a record leaves open of a few answers.

Of a plant of several MVs an answer may be too small beside the noise to be certain in sign, and decide nothing: a
controller that takes it for the model's goes to the set points all the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from pipeline.models.identified.proof import UNCERTAIN, Answer
from pipeline.models.identified.structure import Structure
from pipeline.plants.simulator import Array

MOST_OPEN = 8  # answers that are open together


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

    over the corners of the box in which each uncertain answer is the one of one-step predictions plus or minus ``sds``
    of its standard deviations, all others as the model has them. 1 where G' is G. Above zero slow integral action whose
    moves are G^+ of the errors is stable on each corner; below it runs away on one. ``rest`` (n_y, n_mv) holds the
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
    inverse, least = np.linalg.pinv(gains), 1.0
    for signs in product((-1.0, 1.0), repeat=len(open_to)):
        plant = gains.copy()
        for sign, (place, direct, width) in zip(signs, open_to, strict=True):
            plant[place] = direct + sign * width
        # Of more outputs than MVs only as many can be held: the others have eigenvalues of zero.
        found = np.linalg.eigvals(inverse @ plant if gains.shape[0] > gains.shape[1] else plant @ inverse)
        least = min(least, float(found.real.min()))
    return least
