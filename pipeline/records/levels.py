"""The values that an input takes, where they are so few that nothing lies between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopwright.pipeline.metrics import Array

MOST = 3
NEAR = 1e-3  # of the span: values of one level
ROWS = 0.99  # of the rows at the levels; a mean over a period in which the input was moved lies between two


def levels_of(values: Array) -> tuple[float, ...]:
    """The two or three values at which ``values`` (n,) stand in nearly all rows, ascending; empty where they are more.

    Empty too where all are one.
    """
    span = float(np.ptp(values)) if values.size else 0.0
    if span <= 0:
        return ()
    place, count = np.unique(np.round((values - values.min()) / (NEAR * span)), return_counts=True)
    first = np.argsort(-count, kind="stable")[:MOST]
    for n in range(2, len(first) + 1):
        if count[first[:n]].sum() >= ROWS * len(values):
            return tuple(float(values.min() + NEAR * span * p) for p in np.sort(place[first[:n]]))
    return ()


def only_between(name: str, levels: Sequence[float], unit: str = "") -> str:
    """Range that an input of so few levels leaves unseen."""
    values = f"{', '.join(f'{v:.4g}' for v in levels[:-1])} and {levels[-1]:.4g} {unit}".rstrip(" -")
    return f"{name} moves between {len(levels)} values only ({values}): a curve between them cannot be seen"
