"""Whether a controller of several loops stands what a record leaves open of a few answers.

Of a plant of several MVs an answer may be too small beside the noise to be certain in sign, and decide nothing: a
controller that takes it for the model's goes to the set points all the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from pipeline.models.identified.proof import UNCERTAIN, Answer
from pipeline.plants.simulator import Array

MOST_OPEN = 8  # answers that are open together


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
