"""Fuzzy feedforward with offset observers of core and jacket: what the model gets wrong is learnt on the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from loopwright.pipeline.laws.base import Stepped, hold_numbers
from loopwright.pipeline.laws.fuzzy.fuzzy_law import FuzzyLaw, FuzzyParams, require_shares
from loopwright.pipeline.models.hybrid_fuzzy import HybridFuzzy, JacketAffine
from loopwright.pipeline.plants.simulator import Signals


class FuzzyFeedforwardObserver(FuzzyLaw):
    """The inverse of the model plus what it was wrong by, around an adjusted reference.

    Core and jacket are each predicted by the model plus an offset and corrected by what is measured:

        T^ = T^- + k_core e_c,        d_c(k) = d_c(k-1) + l_core e_c,    e_c = T - T^-
        T_w^ = T_w^- + k_jacket e_w,  d_w(k) = d_w(k-1) + l_jacket e_w,  e_w = T_w - T_w^-

    The adjusted reference R(k+1) of the core is where the law wants it at the next sample. It is to
    come nearer to the set point by the share g, and the core nearer to it by the share c:

        T_w,des = clip([R + g (T_ref - R) - c_t R + c (R - T^(k+1)) - d_c] / c_w),   R = R(k+1)

    of which the modes, each d_w warmer than the model says, reach T_w,adj (``FuzzyLaw``). R takes
    what of that was not spent on the core's distance to it,

        R(k+2) = c_t R + c_w T_w,adj - c (R - T^(k+1)) + d_c,

    which is the reference's own target where T_w,des is within reach. Elsewhere R follows the core, so that
    nothing winds up. R(k+1) is formed at sample k, with the jacket temperature
    that the model reaches under the applied MVs: a stuck throttle holds R too. With g = 1 as in the
    feedforward alone, a jacket that lies in the gap between the modes makes R overcorrect, and the
    modes alternate.

    Source: the feedback part that [karer, section 6] leaves open; ours.
    """

    name: ClassVar[str] = "fuzzy_feedforward_observer"
    title: ClassVar[str] = "Fuzzy feedforward with offset observers"

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params(FuzzyParams):
        """Parameters of FuzzyParams, and the shares of the observers and of the approach, in 0..1 [-], g above 0.

        ``k_jacket``, ``k_core`` are the shares of an innovation that correct an estimate, ``l_jacket``,
        ``l_core`` those that go into its offset; ``core_gain`` (c) is the share of the core's distance to
        its adjusted reference, ``approach`` (g) that of the reference's to the set point, to be made up in
        a sample.
        """

        k_jacket: float
        l_jacket: float
        k_core: float
        l_core: float
        core_gain: float
        approach: float

        def __post_init__(self) -> None:
            FuzzyParams.__post_init__(self)
            require_shares(self, "k_jacket", "l_jacket", "k_core", "l_core", "core_gain", "approach")

    correct: Tensor  # (2,) shares of the innovations (core, jacket) for the estimates
    learn: Tensor  # (2,) and for the offsets
    core_gain: Tensor  # (1,)
    approach: Tensor  # (1,)

    def __init__(self, signals: Signals, model: HybridFuzzy, params: Params) -> None:
        super().__init__(signals, model, params)
        correct, learn = [params.k_core, params.k_jacket], [params.l_core, params.l_jacket]
        hold_numbers(self, correct=correct, learn=learn, core_gain=params.core_gain, approach=params.approach)
        # started, predicted T(k), R(k+1) less the jacket's share, both modes' T_w(k) at k_M = 0 and what k_M = 1 adds,
        # offsets (core, jacket)
        self.n_state = 9
        self.info = (*FuzzyLaw.info, "core_offset", "jacket_offset")

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        started, t, left, line, offsets = torch.split(state, [1, 1, 1, 4, 2], dim=-1)
        side = self.side(started, mv_applied)
        followed = self.followed(line, side, mv_applied)
        predicted = torch.cat([t, followed], dim=-1)
        predicted = torch.where(started > 0, predicted, pv)
        innovation = pv - predicted
        x = predicted + self.correct * innovation
        offsets = offsets + self.learn * innovation
        core_offset, jacket_offset = torch.split(offsets, 1, dim=-1)
        t, t_w = torch.split(x, 1, dim=-1)
        t_next = self.model.core_next(t, t_w) + core_offset
        reference = torch.where(started > 0, left + self.model.core[:1] * followed, t_next)
        spent = self.core_gain * (reference - t_next) - core_offset
        target = reference + self.approach * (sp - reference)
        wanted = self.allowed(self.wanted(target + spent, reference))
        reach = self.model.jacket(t, t_w)
        reach = JacketAffine(reach.base + jacket_offset, reach.gain)
        mv, reached = self.move(reach, wanted, side, mv_applied)
        left = self.model.core[1:] * reference - spent
        adjusted = left + self.model.core[:1] * reached
        state = torch.cat([torch.ones_like(t), t_next, left, *reach, offsets], dim=-1)
        return mv, state, torch.cat([adjusted, wanted, reached, mv[..., 1:], offsets], dim=-1)
