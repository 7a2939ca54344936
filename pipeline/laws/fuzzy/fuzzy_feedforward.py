"""Feedforward through the inverse of a hybrid fuzzy model: the paper's law, and with a PI controller around it."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any, ClassVar

import torch
from torch import Tensor

from loopwright.pipeline.laws.base import Stepped, hold_numbers
from loopwright.pipeline.laws.fuzzy.fuzzy_law import FuzzyLaw, FuzzyParams, require_shares
from loopwright.pipeline.models.hybrid_fuzzy import HybridFuzzy
from loopwright.pipeline.plants.simulator import Signals


class FuzzyFeedforward(FuzzyLaw):
    """Inverse of the model along the model's own course: no measurement after the first.

    Core and jacket of the model start where the plant is and then follow the MVs that the plant
    received. Each step aims the core at the set point two samples ahead, takes of it what the model
    can do (``FuzzyLaw``), and gives that as the adjusted reference. Where the model is the plant,
    the core is at the adjusted reference two samples later to rounding; where it is not, nothing
    corrects the difference.

    Source: [karer, eqs. 18-23].
    """

    name: ClassVar[str] = "fuzzy_feedforward"
    title: ClassVar[str] = "Fuzzy feedforward"
    Params: ClassVar[type[Any]] = FuzzyParams

    def __init__(self, signals: Signals, model: HybridFuzzy, params: FuzzyParams) -> None:
        super().__init__(signals, model, params)
        self.n_state = 6  # started, T(k), both modes' T_w(k) at k_M = 0, and what k_M = 1 adds to each

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
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


class FuzzyFeedforwardPi(FuzzyLaw):
    """Feedforward along an adjusted reference R of the core, plus a PI controller on the core's distance to it.

        e(k) = R(k) - T(k),   I(k) = I(k-1) + (kc h / ti) e(k),   u(k) = kc e(k) + I(k)
        T_w,des = clip([R + g (T_ref - R) - c_t R] / c_w + u(k)),     R = R(k+1)
        R(k+2)  = c_t R + c_w (T_w,adj - u(k))

    with h the period and g the share of the reference's distance to the set point that is to be made
    up in a sample. The part of T_w,des that the modes reach (``FuzzyLaw``) counts from the measured core and
    the model's jacket, which follows the applied MVs and is corrected by the share k_jacket of its
    distance to the measured one: a model whose throttle does too little or too much would ring with
    the measured jacket alone. Where the jacket gives all that was asked for, R approaches the set
    point; where it does not, R takes what is left beside the controller's share, so that a core
    that lags draws R along and the integral does not wind up. R(k+1) is formed at sample k, with the
    jacket temperature that the model reaches under the applied MVs: a stuck throttle holds R too.

    Source: [karer, section 2], which splits the law so and leaves this part
    open; ours.
    """

    name: ClassVar[str] = "fuzzy_feedforward_pi"
    title: ClassVar[str] = "Fuzzy feedforward with PI"

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Params(FuzzyParams):
        """Parameters of FuzzyParams, and the numbers of the class.

        ``kc`` [degC of the jacket per degC of the core] and ``ti_s`` [s] are the PI controller's,
        ``approach`` (g) and ``k_jacket`` the shares above, in 0..1 [-], g above 0.
        """

        kc: float
        ti_s: float
        approach: float
        k_jacket: float

        def __post_init__(self) -> None:
            FuzzyParams.__post_init__(self)
            require_shares(self, "approach", "k_jacket")
            if not (isfinite(self.kc) and self.kc >= 0 and isfinite(self.ti_s) and self.ti_s > 0):
                raise ValueError(f"kc is {self.kc} and ti_s {self.ti_s}; give kc of 0 or above and ti_s above 0")

    kc: Tensor  # (1,)
    integral: Tensor  # (1,) kc h / ti
    approach: Tensor  # (1,)
    k_jacket: Tensor  # (1,)

    def __init__(self, signals: Signals, model: HybridFuzzy, params: Params) -> None:
        super().__init__(signals, model, params)
        integral = params.kc * signals.period_s / params.ti_s
        hold_numbers(self, kc=params.kc, integral=integral, approach=params.approach, k_jacket=params.k_jacket)
        # started, R(k), R(k+1) less the jacket's share, I(k-1), both modes' T_w(k) at k_M = 0 and what k_M = 1 adds
        self.n_state = 8
        self.info = (*FuzzyLaw.info, "integral")

    def forward(self, sp: Tensor, pv: Tensor, dv: Tensor, mv_applied: Tensor, state: Tensor) -> Stepped:
        """One step; shapes as in ControlLaw."""
        started, now, left, integral, line = torch.split(state, [1, 1, 1, 1, 4], dim=-1)
        t, measured = torch.split(pv, 1, dim=-1)
        side = self.side(started, mv_applied)
        followed = self.followed(line, side, mv_applied)
        t_w = torch.where(started > 0, followed, measured)
        t_w = t_w + self.k_jacket * (measured - t_w)
        now = torch.where(started > 0, now, t)
        reference = torch.where(started > 0, left + self.model.core[:1] * followed, self.model.core_next(t, t_w))
        error = now - t
        integral = integral + self.integral * error
        u = self.kc * error + integral
        target = reference + self.approach * (sp - reference)
        wanted = self.allowed(self.wanted(target, reference) + u)
        reach = self.model.jacket(t, t_w)
        mv, reached = self.move(reach, wanted, side, mv_applied)
        left = self.model.core_next(reference, -u)
        adjusted = left + self.model.core[:1] * reached
        state = torch.cat([torch.ones_like(t), reference, left, integral, *reach], dim=-1)
        return mv, state, torch.cat([adjusted, wanted, reached, mv[..., 1:], integral], dim=-1)
