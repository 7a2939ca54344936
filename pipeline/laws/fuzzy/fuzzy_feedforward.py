"""Feedforward through the inverse of a hybrid fuzzy model: the paper's law, which trusts its model alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from pipeline.laws.fuzzy.fuzzy_law import FuzzyLaw, require_numbers
from pipeline.models.fuzzy.hybrid_fuzzy import HybridFuzzy
from pipeline.plants.signals import Signals


class FuzzyFeedforward(FuzzyLaw):
    """Inverse of the model along the model's own course: no measurement after the first.

    Core and jacket of the model start where the plant is and then follow the MVs that the plant
    received. Each step aims the core at the set point two samples ahead, takes of it what the model
    can do (``FuzzyLaw``), and tells that as the adjusted reference. Where the model is the plant,
    the core is at the adjusted reference two samples later to rounding; where it is not, nothing
    corrects the difference.

    Source: [karer, eqs. 18-23].
    """

    name: ClassVar[str] = "fuzzy_feedforward"
    title: ClassVar[str] = "Fuzzy feedforward"

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params:
        """Numbers of the law.

        ``part`` names the model of the set (None: its only one). ``jacket_low`` and ``jacket_high``
        [degC] are what the jacket may have. ``switch_penalty`` [degC] is how much nearer another mode
        must come to the wanted jacket temperature to be taken. ``mv_rate`` is the throttle's largest
        change a sample, None unlimited.
        """

        part: str | None = None
        jacket_low: float
        jacket_high: float
        switch_penalty: float = 0.0
        mv_rate: float | None = None

        def __post_init__(self) -> None:
            require_numbers(self)

    def __init__(self, signals: Signals, model: HybridFuzzy, params: Params) -> None:
        super().__init__(signals, model, params)
        self.n_state = 6  # started, T(k), both modes' T_w(k) at k_M = 0, and what k_M = 1 adds to each
        self.info = ("adjusted_reference", "wanted_jacket", "reached_jacket", "mode")

    def forward(
        self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as in ControlLaw."""
        started, t, line = torch.split(state, [1, 1, 4], dim=-1)
        side = self.side(started, mv_applied)
        course = torch.cat([t, self.followed(line, side, mv_applied)], dim=-1)
        # A measurement that is not a number stops this law like any other, although it needs only the first.
        x = torch.where(started > 0, course, pv) + 0.0 * pv
        t, t_w = torch.split(x, 1, dim=-1)
        t_next = self.model.core_next(t, t_w)
        wanted = self.allowed(self.wanted(sp, t_next))
        reach = self.model.jacket(t, t_w)
        mv, reached = self.move(reach, wanted, side, mv_applied)
        adjusted = self.model.core_next(t_next, reached)
        state = torch.cat([torch.ones_like(t), t_next, *reach], dim=-1)
        return mv, state, torch.cat([adjusted, wanted, reached, mv[..., 1:]], dim=-1)
