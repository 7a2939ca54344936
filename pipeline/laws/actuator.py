"""Actuators as laws see them: their largest move a sample, and what one that stood still has never received."""

from __future__ import annotations

from math import inf, isinf
from typing import TypeAlias

import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.simulator import Signals

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


def stood_still(mv_applied: Tensor, applied_before: Tensor, given: Tensor, near: Tensor) -> Tensor:
    """Whether the actuator did not move although the law asked for a move, bool (..., 1).

    ``mv_applied`` and ``applied_before`` [mv] are what the plant received over the last period and over the one
    before it, ``given`` [mv] what the law asked for over the last period, each (..., 1). Differences up to ``near``
    [mv] count as none. An actuator that moves, but lags behind, does not stand still.
    """
    return ((mv_applied - given).abs() > near) & ((mv_applied - applied_before).abs() <= near)


def never_given(sp_move: Tensor, error_before: Tensor) -> Tensor:
    """The part of the last error that a move of the set point cancels, (..., 1), in the unit of the arguments.

        clip(-(r - r1), 0 and e1),   e1 = r1 - y1

    A set point that moves towards the process variable takes the proportional action of e1 out of the MV. An
    actuator that stood still has never received that action, and to take it out is a kick. The law adds this
    part to its set-point move in such a sample, and starts from the MV that the actuator holds. A move away from
    the process variable, or beyond it, keeps its proportional action.

    ``sp_move`` is r - r1, ``error_before`` e1, both (..., 1) and both with the same factor (a gain, a weight).
    """
    nothing = torch.zeros_like(error_before)
    low, high = torch.minimum(error_before, nothing), torch.maximum(error_before, nothing)
    return torch.minimum(torch.maximum(-sp_move, low), high)
