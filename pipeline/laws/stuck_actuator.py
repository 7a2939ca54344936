"""The move that a law in velocity form need not take back after an actuator stood still."""

from __future__ import annotations

import torch
from torch import Tensor


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
