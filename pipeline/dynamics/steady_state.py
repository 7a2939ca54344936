"""Rests by running long: states go on under constant inputs until they stand still, or a number of periods has passed.

The bands and the longest runs of those that ask stand side by side here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# ------------------------------------------------------------------------------------------------ bands and lengths
# Simulators of any kind, whose states have units of their own. Used by: tests of own plants, local gains, bounds
RESTING = 2_000  # periods that a plant is given to come to rest
REST_LOOK = 100  # periods between two looks whether it has
STILL_STATE = 1e-7  # of the largest state, or of 1 where that is less: a change in one period that is none
# Identified models, whose states are scaled, many runs side by side in compiled loops. Used by: the choice of a model,
# its figures, the map of its rests
MOST_REST_PERIODS = 3_000  # periods that a model is given; compiled ones cost little
HELD_PERIODS = 50  # periods of one compiled call
STILL_SCALED, STANDS_STILL = 1e-7, 1e-5  # scaled, change in a period: where a run may end, and what counts as a rest
STILL_WITHIN = 1e3  # scaled state, hidden ones included, beyond which a model runs away; of identified plants, too
# The start of an identified plant, whose state is scaled. Loops begin there, and a start that moves acts as a load
START_REST_PERIODS = 2_000  # periods; a slower plant is brought to its rest by Newton's method
STATE_CHANGE = 1e-10  # scaled, change of the state in a period that is none


def run_to_rest(
    hold: Callable[[Array], tuple[Array, Array]],
    x: Array,
    looks: int,
    still: float,
    *,
    relative: bool = False,
    within: float | None = None,
) -> tuple[Array, Array]:
    """States, and their change in the last period, when all stand still, or after ``looks`` calls of ``hold``.

        |x(k) - x(k-1)| <= still s,   s = 1, or max(|x(k)|, 1) where ``relative``, the largest over all states

    Parameters
    ----------
    hold
        x -> (x some periods later, the changes in the last of them, not negative), under constant inputs.
    x
        States at the start, of any shape.
    looks
        Calls of ``hold`` at most, 1 or more.
    still
        Change in a period that is none, in the unit of the state.
    relative
        Whether it is in shares of the largest state instead.
    within
        Size of a state beyond which the run ends, for it runs away; default: none.
    """
    moved = np.full(1, np.inf)
    for _ in range(looks):
        x, moved = hold(x)
        if within is not None and not np.all(np.abs(x) < within):
            break
        size = max(float(np.max(np.abs(x))), 1.0) if relative else 1.0
        if not np.any(moved > still * size):
            break
    return x, moved
