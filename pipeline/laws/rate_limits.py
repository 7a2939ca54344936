"""The largest change a sample that a law may ask of each MV: the plant's limit, and the law's own where it is less."""

from __future__ import annotations

from math import inf, isinf
from typing import TypeAlias

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.signals import Signals

Rates: TypeAlias = float | tuple[float | None, ...] | None
"""``mv_rate`` of a law [mv]: one number for all MVs, one for each with None for no limit, or None for none at all."""


def rates_of(signals: Signals, mv_rate: Rates) -> tuple[float, ...] | None:
    """The largest change of each MV a sample (n_mv,) [mv], infinite without a limit; None where no MV has one.

    An MV's limit is the lesser of ``max_move`` of its signal and of ``mv_rate``. LawError for another number of rates
    than of MVs, or for one that is not above 0.
    """
    names = ", ".join(s.name for s in signals.mv)
    given = mv_rate if isinstance(mv_rate, tuple) else (mv_rate,) * len(signals.mv)
    if len(given) != len(signals.mv):
        raise LawError(
            f"mv_rate has {len(given)} entries; give one number for all MVs, or one for each ({names}), null for no "
            "limit"
        )
    if any(rate is not None and not rate > 0 for rate in given):
        shown = list(mv_rate) if isinstance(mv_rate, tuple) else mv_rate
        raise LawError(f"mv_rate is {shown}; give the largest MV change a sample, above 0, or leave it out")
    both = [(inf if r is None else r, s.max_move or inf) for r, s in zip(given, signals.mv, strict=True)]
    # An on-off valve has no positions between, so no rate.
    rates = tuple(inf if s.values else min(pair) for s, pair in zip(signals.mv, both, strict=True))
    return None if all(map(isinf, rates)) and all(rate is None for rate in given) else rates
