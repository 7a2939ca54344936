"""Operators' changes of a running predictive law: ranges, uses, ranks, resting values, costs, speed, caution."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from loopwright.pipeline.config.operator_defaults import MOST_COST, MOST_RANKS
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import Rates, hold_numbers, rates_of
from loopwright.pipeline.laws.predictive.horizon import Moves
from loopwright.pipeline.laws.predictive.qp_solver import OperatedPlan
from loopwright.pipeline.laws.predictive.soft_limits import PRICE
from loopwright.pipeline.models.memory import AffineMap, Named
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import Group, OperateEntry, Signal, What
from loopwright.serving.operating import Operate

USUAL_RANK = 3  # rank of a range of which nobody says one: its price is that of a soft limit, and those are solved fast
# A range's price over the next rank's. On 19 pairs of ranges at odds, on random 3x3 plants with gains from .3 to 2,
# the higher rank kept 99 % with a ratio of 4 on 11, of 10 on 18, of 30 on all; with the solver before `BoundedMinimum`.
RANK_RATIO = 10.0
LEAST_FACTOR, MOST_FACTOR = 0.25, 4.0  # of the designed speed and caution
LEAST_MOVE = 1e-4  # of an MV's range a period: less is `use` 0
# Times the designed weight of a set point. On random 2x2 plants (seeds 3, 4, 8, 11, 12) with one MV out of use the set
# point that weighs 10 times the other kept 9 to 35 % of its error, at 100 times 1 to 7 %.
LEAST_WEIGHT, MOST_WEIGHT = 0.1, 10.0
REST_WEIGHT = 0.01  # of a squared half range away from a resting value, a sample: a set point feels nothing of it
COST_SLOPE = 0.03  # of the dearest signal, a sample and scaled unit: costs move a set point by .05 % of its range
TINY_COST = 1e-12  # costs below it are none
# Standard deviations of the estimated output over which the price of a range without a set point grows, and by which
# the output is kept inside. Where a set point pulls with all its weight it ends 3.7 of them beyond where the price
# begins. With 0 and 2 noise threw three models back from a range that a cost pushed against by up to 60 % of it. Chosen
# on day 901 of the furnace and the column of the benchmark of plants under ranges and costs, of 5 to 20 and 2 to 5: in
# range for 85 and 95 % of the time, with 10 and 2 for 63 and 79 %.
BLUR_SDS, MARGIN_SDS = 20.0, 5.0


def entries_of(
    signals: Signals,
    outputs: int,
    cv_low: Sequence[float | None],
    cv_high: Sequence[float | None],
    defaults: Mapping[str, float],
    mv_rate: Rates = None,
) -> tuple[OperateEntry, ...]:
    """The entries of ``operate`` of a law whose first ``outputs`` PVs have ranges; those with set points stand first.

    By default all is as without ``operate``: every signal in use, set points tracked, ranges from ``cv_low`` to
    ``cv_high`` [pv], or as wide as the signals' where these are None or too few, no resting values, no costs; and then
    ``defaults`` by name, in engineering units. No MV moves faster than ``mv_rate`` [mv]. LawError for an unknown name,
    a default that operators may not set, or a limit given twice.
    """
    found = []
    both = {s.name for s in signals.pv[:outputs]} & {s.name for s in signals.mv}
    if both:
        raise LawError(
            f"law 'predictive': {', '.join(sorted(both))} names a PV and an MV; with `operate` give each its own name"
        )

    def add(
        group: Group, s: Signal | None, what: What, default: float, low: float, high: float, unit: str = ""
    ) -> None:
        found.append(OperateEntry(group, "" if s is None else s.name, what, unit, default, low, high))

    for i, s in enumerate(signals.pv[:outputs]):
        tracked = float(i < len(signals.sp))
        add("cv", s, "use", 1.0, 0.0, 1.0)
        add("cv", s, "track", tracked, 0.0, tracked)
        least, most = (LEAST_WEIGHT, MOST_WEIGHT) if tracked else (1.0, 1.0)  # without a set point it has no meaning
        add("cv", s, "weight", 1.0, least, most)
        low, high = (of[i] if i < len(of) else None for of in (cv_low, cv_high))
        for end, limit in (("low", low), ("high", high)):
            if limit is not None and f"{s.name}.{end}" in defaults:
                raise LawError(
                    f"law 'predictive': cv_{end} gives {limit} for {s.name}, and operate {s.name}.{end} = "
                    f"{defaults[f'{s.name}.{end}']}; leave one of them out"
                )
        add("cv", s, "low", s.low if low is None else low, s.low, s.high, s.unit)
        add("cv", s, "high", s.high if high is None else high, s.low, s.high, s.unit)
        add("cv", s, "rank", float(USUAL_RANK), 1.0, float(MOST_RANKS))
        add("cv", s, "cost", 0.0, -MOST_COST, MOST_COST, f"1/{s.unit}")
    rates = rates_of(signals, mv_rate) or (math.inf,) * len(signals.mv)
    for s, rate in zip(signals.mv, rates, strict=True):
        fastest = min(rate, s.high - s.low)
        add("mv", s, "use", 1.0, 0.0, 1.0)
        add("mv", s, "low", s.low, s.low, s.high, s.unit)
        add("mv", s, "high", s.high, s.low, s.high, s.unit)
        add("mv", s, "max_move", fastest, min(LEAST_MOVE * (s.high - s.low), fastest), fastest, s.unit)
        add("mv", s, "rest", s.middle, s.low, s.high, s.unit)
        add("mv", s, "rest_use", 0.0, 0.0, 1.0)
        add("mv", s, "cost", 0.0, -MOST_COST, MOST_COST, f"1/{s.unit}")
    add("law", None, "speed", 1.0, LEAST_FACTOR, MOST_FACTOR)
    add("law", None, "caution", 1.0, LEAST_FACTOR, MOST_FACTOR)
    return _with_defaults(found, defaults)


def _with_defaults(entries: Sequence[OperateEntry], defaults: Mapping[str, float]) -> tuple[OperateEntry, ...]:
    operate = Operate(entries)
    try:
        values = operate.with_values(defaults)
    except LoopwrightError as error:
        raise LawError(f"law 'predictive': {error}") from error
    return tuple(replace(entry, default=float(v)) for entry, v in zip(entries, values, strict=True))


@dataclass(frozen=True, slots=True)
class OperateScales:
    """Scales of the law: outputs' centre and spread (n_o,) [pv], MVs' middle and half range (n_mv,) [mv]."""

    y_center: Tensor
    y_scale: Tensor
    mv_middle: Tensor
    mv_half: Tensor


class Operation(nn.Module):
    """From ``operate`` to the numbers of a plan over N samples.

    The price of a range of rank r is rho 10^(3 - r), rho that of a soft limit times the largest ``weight`` above 1:
    a range of rank 1 is kept at the expense of all later ones. An MV out of use keeps the applied value over the whole
    plan, and what it does is known to the model. Costs are scaled by their largest, so that their ratios alone count,
    and are small beside errors and prices: they decide where neither does, as resting values do.
    """

    slope: Tensor  # (1,)
    margin: Tensor  # (1,)
    blur: Tensor  # (1,)
    usual: Tensor  # (1,) logarithm of the price of a range of the usual rank
    others: Tensor  # the places of all entries but the weights
    weights: Tensor  # those of the weights

    def __init__(
        self, entries: Sequence[OperateEntry], scales: OperateScales, moves: Moves, most_weight: float
    ) -> None:
        super().__init__()
        self.horizon, self.n_moves, self.scales = moves.horizon, len(moves.starts), scales
        hold_numbers(self, slope=COST_SLOPE, margin=MARGIN_SDS, blur=BLUR_SDS, usual=math.log(PRICE * most_weight))
        # Apart from the others, whose sums are then the same to the bit as in a law without weights.
        self.register_buffer("weights", torch.tensor([i for i, e in enumerate(entries) if e.what == "weight"]))
        self.register_buffer("others", torch.tensor([i for i, e in enumerate(entries) if e.what != "weight"]))
        entries = [e for e in entries if e.what != "weight"]
        groups: tuple[Group, ...] = ("cv", "mv")
        whats = [list(dict.fromkeys(e.what for e in entries if e.group == g)) for g in groups]
        n_cv, n_mv = (len(of) * len(s) for of, s in zip(whats, (scales.y_scale, scales.mv_half), strict=True))
        held = torch.from_numpy(moves.profile.sum(axis=0)).repeat_interleave(len(scales.mv_half))
        starts = torch.tensor(moves.starts, dtype=torch.float64)
        until = starts.repeat_interleave(len(scales.mv_half)) + 1

        def formulas(p: Named) -> Named:
            cv = _columns(p["operate"][..., :n_cv], whats[0])
            mv = _columns(p["operate"][..., n_cv : n_cv + n_mv], whats[1])
            low, high = ((cv[end] - scales.y_center) / scales.y_scale for end in ("low", "high"))
            first, last, rest = ((mv[at] - scales.mv_middle) / scales.mv_half for at in ("low", "high", "rest"))
            fastest = self._each_move(mv["max_move"] / scales.mv_half)
            rank = math.log(PRICE * most_weight) + math.log(RANK_RATIO) * (USUAL_RANK - cv["rank"])
            return {
                "use": self._samples(cv["use"]),
                "track": self._samples(cv["track"]),
                "low": self._samples(low),
                "high": self._samples(high),
                "rank": self._samples(rank),
                "y_cost": self._samples(cv["cost"] * scales.y_scale),
                "y_each": cv["cost"] * scales.y_scale,
                "free": 1 - cv["track"],
                "width": 0.5 * (high - low),
                "mv_use": mv["use"],
                "mv_move": mv["max_move"],
                "mv_low": mv["low"],
                "mv_high": mv["high"],
                "z_use": self._each_move(mv["use"]),
                "z_low": self._each_move(first),
                "z_high": self._each_move(last),
                "reach": fastest * until,
                "rest": self._each_move(rest),
                "rest_weight": self._each_move(REST_WEIGHT * mv["rest_use"]) * held,
                "z_cost": self._each_move(mv["cost"] * scales.mv_half) * held,
                "z_each": mv["cost"] * scales.mv_half,
                "speed": p["operate"][..., n_cv + n_mv : n_cv + n_mv + 1],
            }

        self.numbers = AffineMap({"operate": len(entries)}, formulas)

    def forward(self, operate: Tensor, stands: Tensor, off: Tensor, sd: Tensor) -> OperatedPlan:
        """The numbers of ``operate`` (..., 1, n), which is as the manifest lists it.

        ``stands`` (..., 1, m), scaled: where the MVs go on from, and ``off`` by how much they stand off that. ``sd``
        (..., 1, n_o), scaled, of the estimated outputs: a variable that follows no set point is kept ``MARGIN_SDS`` of
        them inside its range, or noise would have it outside half of the time.
        """
        p, weights = self.numbers(operate.index_select(-1, self.others)), operate.index_select(-1, self.weights)
        # Only ratios of costs count: the largest, per scaled unit, becomes the slope.
        largest = torch.cat([p["y_each"], p["z_each"]], dim=-1).abs().amax(dim=-1, keepdim=True)
        by = self.slope / torch.clamp(largest, min=TINY_COST)
        # A range stays dearer than every set point.
        heaviest = torch.clamp(weights.amax(dim=-1, keepdim=True), min=1.0)
        unsure = sd * p["free"]
        # A dearer range is kept as much more strictly.
        sharper = torch.exp(torch.clamp(self.usual - p["rank"], max=0.0))
        margin = self._samples(torch.minimum(self.margin * unsure, p["width"]))
        return OperatedPlan(
            track=p["track"] * p["use"] * self._samples(weights),
            low=p["low"],
            high=p["high"],
            low_inside=p["low"] + margin,
            high_inside=p["high"] - margin,
            blurred=self._samples(self.blur * unsure) * sharper,
            price=torch.exp(p["rank"]) * p["use"] * heaviest,
            y_cost=by * p["y_cost"] * p["use"],
            stands=stands,
            off=off,
            z_low=p["z_low"],
            z_high=p["z_high"],
            reach=p["reach"] * p["z_use"],
            rest=p["rest"],
            rest_weight=p["rest_weight"],
            z_cost=by * p["z_cost"],
            stiffness=1 / (p["speed"] * p["speed"]),
            mv_low=p["mv_low"],
            mv_high=p["mv_high"],
            mv_move=p["mv_move"] * p["mv_use"],
        )

    @staticmethod
    def load_share(operate: Tensor) -> Tensor:
        """Variance (..., 1, 1) of the loads' changes over the designed one."""
        caution = operate[..., -1:]
        return 1 / (caution * caution)

    def _samples(self, values: Tensor) -> Tensor:
        """A value of each output at every sample of the horizon."""
        return values.repeat(*(1 for _ in values.shape[:-1]), self.horizon)

    def _each_move(self, values: Tensor) -> Tensor:
        """A value of each MV at every move."""
        return values.repeat(*(1 for _ in values.shape[:-1]), self.n_moves)


def _columns(block: Tensor, whats: Sequence[str]) -> dict[str, Tensor]:
    """Each ``what`` (..., signals) of a block that lists them signal by signal."""
    return {what: block[..., i :: len(whats)] for i, what in enumerate(whats)}
