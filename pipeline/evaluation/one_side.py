"""The side of a turn on which controllers stay: where an MV's gain turns its sign, a loop beyond it locks up.

A controller that goes over the top of a curve moves the MV on and on, as each move makes its error larger.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.plants.simulator import Array, Signals

LEAST_SIDE = 0.1  # of the range that may be commanded, that a side must leave
TURNS = 0.02  # of a curve's way, by which it comes back behind its turn: less is a curve that has become flat

LATER_WAY, LATER_WAY_VISITED = 0.1, 3.0
"""Way that a model goes on after its answer, of its whole curve's and over that in the visited part: it is not slow."""

Regions = Sequence[Mapping[str, Any]]


def on_one_side(signals: Signals, proof: Mapping[str, Any], median: float) -> Signals:
    """The signals of a plant of one MV, whose range ends where the gain turns; the same where it does not.

    ``proof`` of the model's figures has the regions of the MV's range by the gain there; ``median`` is that of the MV
    in the record, within the range that may be commanded. Plants of several MVs stay as they are: what one cannot do
    there the others may. So does a plant of which less than ``LEAST_SIDE`` of its range would be left.
    """
    if len(signals.mv) != 1 or len(signals.sp) != 1:
        return signals
    mv = signals.mv[0]
    found = ((proof.get("answers") or {}).get(signals.sp[0].name) or {}).get(mv.name) or {}
    low, high = side_of(found.get("regions") or (), median)
    low, high = (mv.low if low is None else max(low, mv.low)), (mv.high if high is None else min(high, mv.high))
    return _within(signals, low, high)


def before_turns(signals: Signals, values: Array, curves: Array, rests: Array, visited: tuple[float, float]) -> Signals:
    """The signals of a plant of one MV, whose range ends where a model of the record turns first, or does not rest.

    ``curves`` (models, n) are what the models' CV reaches under rising values (n,) of the MV as far as the answer is
    known, ``rests`` (models, n) long after. The ``visited`` part (lowest, highest) remains: there the
    record judges, see ``on_one_side``. Outside of it nobody knows whether the turn is the plant's, but a law on that
    model locks up behind it; and so it does where the model leaves what it had reached.
    """
    mv, (first, middle, last) = signals.mv[0], np.searchsorted(values, [visited[0], 0.5 * sum(visited), visited[1]])
    first, last = max(min(first, middle - 1), 0), min(max(last, middle + 1), len(values) - 1)
    rising = curves * np.sign(curves[:, [last]] - curves[:, [first]])
    way = np.ptp(curves, axis=1)
    on = np.abs(rests - curves)
    # What a slow model still has to go grows with the move.
    half = 0.5 * (values[last] - values[first])
    farther = np.maximum(1.0, np.abs(values - 0.5 * (values[last] + values[first])) / half)
    away = on > np.maximum(
        LATER_WAY * way[:, None], LATER_WAY_VISITED * on[:, first : last + 1].max(axis=1)[:, None] * farther
    )
    below = [*_turns(-rising[:, middle::-1], TURNS * way), *_ends(away[:, middle::-1])]
    above = [*_turns(rising[:, middle:], TURNS * way), *_ends(away[:, middle:])]
    low = max([mv.low, *(values[middle - back] for back in below)])
    high = min([mv.high, *(values[middle + ahead] for ahead in above)])
    return _within(signals, min(float(low), visited[0]), max(float(high), visited[1]))


def _turns(rising: Array, least: Array) -> list[int]:
    """Places of the first tops behind which curves (models, n) come back by more than ``least`` (models,)."""
    found = []
    for curve, enough in zip(rising, least, strict=True):
        lost = np.maximum.accumulate(curve) - curve > enough
        if lost.any():
            found.append(int(curve[: lost.argmax()].argmax()))
    return found


def _ends(away: NDArray[np.bool_]) -> list[int]:
    """The last places before the first that is away, of the rows (models, n) that have one."""
    return [max(int(row.argmax()) - 1, 0) for row in away if row.any()]


def _within(signals: Signals, low: float, high: float) -> Signals:
    """The signals with the MV's range from low to high, unless less than ``LEAST_SIDE`` of it is left."""
    mv = signals.mv[0]
    if high - low < LEAST_SIDE * (mv.high - mv.low):
        return signals
    return replace(signals, mv=(replace(mv, low=low, high=high),))


def side_of(regions: Regions, median: float) -> tuple[float | None, float | None]:
    """(lowest, highest) value of an MV on the side of a turn where it mostly was; None where there is no turn.

    A turn lies between two regions whose gains the record proves, and which are of opposite signs. A small region
    between them is left out, but for values up to the median.
    """
    proven = [i for i, of in enumerate(regions) if not of["small"] and of["verdict"] == "proven"]
    if not proven:
        return None, None
    own = min(proven, key=lambda i: _distance(regions[i], median))
    sign = regions[own]["model"] > 0

    def end(order: Sequence[int], key: str) -> float | None:
        alike = list(takewhile(lambda i: i not in proven or (regions[i]["model"] > 0) is sign, order))
        last = max((i for i in (own, *alike) if i in proven), key=lambda i: abs(i - own))
        return None if len(alike) == len(order) else float(regions[last][key])

    low, high = end(range(own - 1, -1, -1), "from"), end(range(own + 1, len(regions)), "to")
    return (None if low is None else min(low, median)), (None if high is None else max(high, median))


def _distance(region: Mapping[str, Any], value: float) -> float:
    """How far a value lies outside a region."""
    return max(float(region["from"]) - value, value - float(region["to"]), 0.0)
