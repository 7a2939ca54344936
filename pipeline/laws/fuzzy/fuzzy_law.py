"""Shared parts of the laws over a hybrid fuzzy model: its inverse in every mode, the choice of the mode."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import ControlLaw, hold_numbers
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.hybrid_fuzzy import HybridFuzzy, JacketAffine
from loopwright.pipeline.plants.simulator import Signals, Simulator

TIE = 1e-9  # [degC] what two modes may differ by through rounding alone


class Move(NamedTuple):
    """The MVs of one step (..., 2), and the jacket temperature (..., 1) [degC] that the model then reaches."""

    mv: Tensor
    reached: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class FuzzyParams:
    """Settings of every law of this family.

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
        low, high = self.jacket_low, self.jacket_high
        if not (isfinite(low) and isfinite(high) and low < high):
            raise ValueError(f"jacket_low is {low} and jacket_high {high}; give two temperatures, the lower one first")
        if not (isfinite(self.switch_penalty) and self.switch_penalty >= 0):
            raise ValueError(f"switch_penalty is {self.switch_penalty}; it must be 0 or above")


class FuzzyLaw(ControlLaw):
    """A cascade over a hybrid fuzzy model: core from jacket, jacket from throttle and mode.

    The core of the next sample is fixed already, so the law looks two samples ahead. The jacket
    temperature that brings the core from T(k+1) to T_ref(k+2), within what the jacket may have, is

        T_w,des = clip((T_ref(k+2) - c_t T(k+1)) / c_w, jacket_low, jacket_high)

    with (c_w, c_t) the weights of T_w and T in the core's next temperature. Mode d reaches from
    k_M = 0 to k_M = 1 all between base_d and base_d + gain_d, as T_w(k+1) = base_d + gain_d k_M; the
    nearest to T_w,des that it reaches is adj_d. The mode with the least

        |adj_d - T_w,des| + switch_penalty [d is not the present mode]

    is taken, the present one where two are equal, and with it k_M = (adj_d - base_d) / gain_d. The jacket's reach, and
    the core after it, are the adjusted reference, from which the law goes on.

    Source: [karer, eqs. 13-23 and section 4.2]; the switching cost, and the
    two samples, which the printed cascade needs, are ours.

    Raises LawError for a model whose gain is 0 or changes its sign, as no inverse exists there.
    """

    one_loop: ClassVar[bool] = False  # one variable by two MVs
    parts: ClassVar[Mapping[str, str]] = {"PART": "kind hybrid_fuzzy, of the name that `part` gives"}
    info: tuple[str, ...] = ("adjusted_reference", "wanted_jacket", "reached_jacket", "mode")
    model: HybridFuzzy
    limits: Tensor  # (2,) [degC] of the jacket
    modes: Tensor  # (2,) values of the mode's signal
    stay: Tensor  # (1,) [degC] what the present mode is ahead by: the switch's penalty and the tie
    mode_middle: Tensor  # (1,) between the modes' values
    mode_half: Tensor  # (1,) half of their distance

    def __init__(self, signals: Signals, model: HybridFuzzy, params: FuzzyParams) -> None:
        super().__init__(signals, params.mv_rate)
        _require_signals(signals, self.name)
        _require_inverse(model, self.name)
        values = signals.mv[1].values or ()
        self.model = model
        hold_numbers(
            self,
            limits=[params.jacket_low, params.jacket_high],
            modes=values,
            stay=params.switch_penalty + TIE,
            mode_middle=(values[0] + values[1]) / 2,
            mode_half=(values[1] - values[0]) / 2,
        )

    @classmethod
    def needs(cls, params: Any, given: Collection[str] = ()) -> tuple[str, ...]:
        """The part that ``params.part`` names, if it does."""
        return () if params.part is None else (params.part,)

    @classmethod
    def design(cls, params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None) -> Self:
        """The law over the part that ``params.part`` names, or the set's only hybrid fuzzy model; raises LawError."""
        return cls(signals, _chosen(models, params.part, cls.name), params)

    def wanted(self, target: Tensor, t_next: Tensor) -> Tensor:
        """T_w(k+1), unlimited, that takes a core at ``t_next`` = T(k+1) to ``target`` = T(k+2), all (..., 1)."""
        return (target - self.model.core[1:] * t_next) / self.model.core[:1]

    def allowed(self, t_w: Tensor) -> Tensor:
        """A jacket temperature within its limits."""
        return torch.minimum(torch.maximum(t_w, self.limits[:1]), self.limits[1:])

    def side(self, started: Tensor, mv_applied: Tensor) -> Tensor:
        """-1 in the first mode, 1 in the second, 0 without a past, shape (..., 1)."""
        return started * ((mv_applied[..., 1:] - self.mode_middle) / self.mode_half)

    def followed(self, line: Tensor, side: Tensor, mv_applied: Tensor) -> Tensor:
        """T_w (..., 1) after the applied MVs, from both modes' bases and gains, ``line`` (..., 4)."""
        base, base_2, gain, gain_2 = torch.split(line, 1, dim=-1)
        second = side > 0
        return torch.where(second, base_2, base) + torch.where(second, gain_2, gain) * mv_applied[..., :1]

    def move(self, line: JacketAffine, wanted: Tensor, side: Tensor, mv_applied: Tensor) -> Move:
        """Mode and throttle for a wanted jacket temperature (..., 1) within its limits."""
        other_end = line.base + line.gain
        low, high = torch.minimum(line.base, other_end), torch.maximum(line.base, other_end)
        nearest = torch.minimum(torch.maximum(wanted, low), high)
        missed, missed_2 = torch.split((nearest - wanted).abs(), 1, dim=-1)
        ahead = missed - missed_2 + self.stay * side
        second = ahead > 0
        throttle, throttle_2 = torch.split((nearest - line.base) / line.gain, 1, dim=-1)
        k_m = torch.where(second, throttle_2, throttle)
        # What is not a number must not become a mode.
        mode = torch.where(second, self.modes[1:], self.modes[:1]) + 0.0 * ahead
        mv = self.limited(torch.cat([k_m, mode], dim=-1), mv_applied)
        (base, base_2), (gain, gain_2) = (torch.split(values, 1, dim=-1) for values in line)
        return Move(mv, torch.where(second, base_2, base) + torch.where(second, gain_2, gain) * mv[..., :1])


def require_shares(params: Any, *names: str) -> None:
    """Refuse a share that is not within 0..1, and an approach of 0, which never aims at a set point; raises ValueError.

    Any observer of such shares is stable over a model that is: 0 learns nothing, 1 takes all.
    """
    for name in names:
        if not 0 <= getattr(params, name) <= 1:
            raise ValueError(f"{name} is {getattr(params, name)}; it must be within 0..1")
    if not params.approach > 0:
        raise ValueError(f"approach is {params.approach}; it must be above 0, or no set point is ever approached")


def _chosen(models: Mapping[str, Model], part: str | None, law: str) -> HybridFuzzy:
    fuzzy = {name: model for name, model in models.items() if isinstance(model, HybridFuzzy)}
    known = ", ".join(sorted(fuzzy)) or "none"
    if part is None and len(fuzzy) == 1:
        return next(iter(fuzzy.values()))
    needs = f"law {law!r} needs a part of kind 'hybrid_fuzzy'"
    if part is None:
        raise LawError(f"{needs}; name it as `part`: the model set has {known}")
    if part not in fuzzy:
        raise LawError(f"{needs}, which {part!r} is not; the model set has {known}")
    return fuzzy[part]


def _require_signals(signals: Signals, law: str) -> None:
    discrete = [s.values for s in signals.mv]
    if (len(signals.sp), len(signals.pv), len(signals.mv)) != (1, 2, 2) or discrete[0] or len(discrete[1] or ()) != 2:
        raise LawError(
            f"law {law!r} needs one set point, the PVs core and jacket, and the MVs throttle and mode (two values); "
            f"got {len(signals.sp)} set points, {len(signals.pv)} PVs and the MVs "
            + ", ".join(f"{s.name} ({'continuous' if s.values is None else list(s.values)})" for s in signals.mv)
        )


def _require_inverse(model: HybridFuzzy, law: str) -> None:
    gains = model.consequents[:, 2]  # (modes, K): what lies between two centres lies between their values
    if len(gains) != 2 or not bool(((gains > 0).all(dim=1) | (gains < 0).all(dim=1)).all()):
        raise LawError(
            f"law {law!r} needs two modes, in each of which k_M moves the jacket one way at every temperature; the "
            f"model's coefficients b at {model.centres.tolist()} degC are {gains.tolist()}"
        )
