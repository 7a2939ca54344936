"""Whether an identified model is stable over the range that its record visits, not only at a few rests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from loopwright.pipeline.historian.settling import MOST_PERIODS
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.rests import settle
from loopwright.pipeline.plants.simulator import Array

PLACES = 2000
"""Most visited rows at which the local poles are taken."""

RESTS = 60
"""Constant inputs under which it must settle."""

SLOWEST = 0.2 / MOST_PERIODS
"""Distance of the growth a period from 1 of an integrator: as far as a law looks ahead, a fifth is gained or lost."""


def stability_figures(model: Dynamics, states: Sequence[Array], inputs: Sequence[Array]) -> dict[str, Any]:
    """Local and global stability over visited rows: states (n, n_x) under inputs (n, n_v), stretch by stretch.

    ``largest_pole`` and ``median_pole`` of dF/dx over these rows and ``unstable_share``, those beyond 1: a pole
    beyond 1 in passing does no harm. ``growth`` is the mean factor a period by which two nearby runs part along the
    record (the largest Lyapunov exponent's), ``settles`` the share of the record's inputs under which, held constant,
    the model comes to rest. ``stable`` and ``verdict`` judge by the last two, for an integrator by growth alone.
    """
    x, v = np.concatenate(list(states)), np.concatenate(list(inputs))
    places = np.linspace(0, len(x) - 1, min(PLACES, len(x))).astype(np.int64)
    slopes = np.broadcast_to(model.slopes(x[places], v[places])[0], (len(places), model.n_x, model.n_x))
    radius = np.abs(np.linalg.eigvals(slopes)).max(axis=1)
    growth = _growth(model, states, inputs)
    rows = np.linspace(0, len(v) - 1, RESTS).astype(np.int64)
    settles = float(settle(model, v[rows])[1].mean())
    integrates = abs(growth - 1) < SLOWEST and settles < 1
    stable = integrates or (growth < 1 and settles == 1)
    if integrates:
        words = "integrates: differences between two runs hardly fade or grow as far as a law looks ahead"
    elif stable:
        words = "stable: it settles under every constant input of the record, and nearby runs approach each other"
    elif growth > 1:
        words = f"unstable: nearby runs part by a factor of {growth:.4g} a period along the record"
    else:
        words = f"doubtful: under {1 - settles:.0%} of the record's inputs, held constant, it does not come to rest"
    return {
        "stable": bool(stable),
        "verdict": words,
        "largest_pole": float(radius.max()),
        "median_pole": float(np.median(radius)),
        "unstable_share": float(np.mean(radius > 1)),
        "growth": growth,
        "settles": settles,
    }


def _growth(model: Dynamics, states: Sequence[Array], inputs: Sequence[Array]) -> float:
    """Exp of the mean logarithm of the factor by which a small difference grows a period along the stretches."""
    total, rows = 0.0, 0
    for x, v in zip(states, inputs, strict=True):
        tangent = np.ones(model.n_x) / np.sqrt(model.n_x)
        slopes = np.broadcast_to(model.slopes(x, v)[0], (len(x), model.n_x, model.n_x))
        for slope in slopes:
            tangent = slope @ tangent
            size = float(np.linalg.norm(tangent))
            if not 0 < size < np.inf:
                return 0.0 if size == 0 else float("inf")
            total += np.log(size)
            tangent /= size
        rows += len(x)
    return float(np.exp(total / max(rows, 1)))
