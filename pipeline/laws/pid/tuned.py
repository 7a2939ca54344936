"""The numbers of the PID: given, by a rule, or by a search in closed loop over a plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import ControlLaw, require_single_loop
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.simulator import Array, Signals, Simulator
from loopwright.pipeline.plants.steady import Linearization
from loopwright.pipeline.tuning import rules
from loopwright.pipeline.tuning.calm_choice import CALM_COST, calmest
from loopwright.pipeline.tuning.loop_search import DevelopmentLoops, Loops, calm, searched
from loopwright.pipeline.tuning.pairing import ONE_LOOP, Pairs, TunedPairing, gains_of, pairings
from loopwright.pipeline.tuning.reduction import LagWithDeadTime, start_lags
from loopwright.pipeline.tuning.responses import StepResponses
from loopwright.pipeline.tuning.rules import AllPole, PidSettings

DEVELOPMENT_HOLD = 100  # samples of a development set point
# where it lasts so many times as long as the plant takes to settle, or to cross its range
HOLD_SETTLING_TIMES, HOLD_RANGE_CROSSINGS = 2, 3
DEVELOPMENT_HOLDS = (60, 400)  # least and most


@dataclass(frozen=True, slots=True)
class TriedLoops:
    """Settings of each loop that a search tried, their cost, and what it is made of, over set points and loads.

        E = max(E_sp/E_sp*, E_load/E_load*)

    E* are the errors of the cheapest settings. The larger part counts: a set-point weight buys travel with the errors
    at set points alone, and their mean with those under loads let them grow by a tenth.
    """

    loops: Loops
    cost: float  # [% of the first CV's range], the price of travel in it
    set_points: float  # over that of the cheapest
    loads: float  # over that of the cheapest
    travel: float  # [% of the MVs' range a sample]

    @property
    def error(self) -> float:
        """E, over that of the cheapest."""
        return max(self.set_points, self.loads)

    def row(self) -> dict[str, float]:
        """The outcome of the settings, and their cost, by name."""
        return {n: getattr(self, n) for n in ("set_points", "loads", "travel", "error", "cost")}


@dataclass(frozen=True, slots=True)
class TunedLoops:
    """Settings of one loop, or of the loop of each pair; of several loops also the pairings that were tuned.

    The first of ``pairings`` is that of ``pairs``. ``calm`` stands for plants on which ``settings`` do not hold.
    ``tried`` are the settings that a search tried on the pairs, the cheapest first.
    """

    settings: PidSettings | Loops
    pairs: Pairs = ONE_LOOP
    pairings: tuple[TunedPairing, ...] = ()
    calm: Loops | None = None  # of a search: settings of last resort
    tried: tuple[TriedLoops, ...] = ()


class LawOf(Protocol):
    """The law with candidates for its settings side by side."""

    def __call__(self, settings: list[PidSettings] | list[Loops], *, pairs: Pairs = ONE_LOOP) -> ControlLaw:
        """One module for all of ``settings``."""


@runtime_checkable
class HoldsLinearization(Protocol):
    """A model that is a plant linearized at a steady state."""

    def linearization(self) -> Linearization:
        """The linearization, per second."""


def tuned(
    params: Any, models: Mapping[str, Model], signals: Signals, plant: Simulator | None, law_of: LawOf
) -> TunedLoops:
    """The numbers that ``params`` of the PID ask for; raises LawError where their tuning does not apply."""
    p, (given, *_) = params, params.given()
    pairs = given_pairs(p, signals)
    if p.tuning == "manual" and pairs is not None:
        require_numbers(p)
        of = dict(zip(p.pairs, p.given(), strict=True))
        return TunedLoops(tuple(of[signals.mv[j].name] for _, j in pairs), pairs)
    if plant is not None and by_simulation(p, plant):
        return _searched(p, signals, plant, law_of)
    require_single_loop(signals, "pid")
    if p.tuning == "manual":
        require_numbers(p)
        return TunedLoops(given)
    lin, dead_s = linearization(params, models, plant)
    if p.tuning == "itae":
        settings = rules.itae_pid(LagWithDeadTime.of(lin, dead_time_s=dead_s), signals.period_s, p.sampling)
    elif p.tuning == "simc":
        settings = rules.simc_pid(AllPole.of(lin, dead_time_s=dead_s), signals.period_s, p.lambda_s)
    elif p.tuning == "imc" and p.lambda_s is not None:
        settings = rules.imc_pid(AllPole.of(lin, dead_time_s=dead_s), p.lambda_s)
    elif p.tuning == "imc":
        settings = rules.robust_imc(lin, signals.period_s, dead_time_s=dead_s)
    elif p.tuning == "optimized":
        if plant is None:
            raise LawError("PID tuning `optimized` needs a simulator; take manual, imc, simc or itae")
        known, hold = (
            equations(plant, "PID tuning `optimized` on a linearized plant"),
            p.development_hold or DEVELOPMENT_HOLD,
        )
        loops = DevelopmentLoops.draw(known, p.development_seeds, p.development_set_points, hold)
        free = p.set_point_weight is None

        def cost(rows: Sequence[PidSettings]) -> Array:
            law = law_of(list(rows))
            return loops.run(law, law.n_state, len(rows), time_weighted=p.criterion == "itae").cost

        settings = rules.optimized_imc(AllPole.near(lin), signals.period_s, cost, given, optimize_weight=free)
        return TunedLoops(settings)
    else:
        raise LawError(f"PID tuning is {p.tuning!r}; allowed are optimized, imc, simc, itae, manual")
    rest = {name: getattr(given, name) for name in ("filter_s", "tracking_s", "set_point_weight")}
    return TunedLoops(replace(settings, **rest))


def given_pairs(params: Any, signals: Signals) -> Pairs | None:
    """The pairs that ``params`` name, in the order of the MVs; None where they name none, or there is one MV.

    Raises LawError unless each CV has one MV.
    """
    if params.pairs is None:
        return None
    cvs, mvs = ([s.name for s in group] for group in (signals.sp, signals.mv))
    named = dict(params.pairs)
    if sorted(named.values()) != sorted(cvs) or not set(named) <= set(mvs):
        raise LawError(
            f"pairs of the PID are {named}; give each of {', '.join(cvs)} an MV of its own, as in MV: CV; there are "
            f"{', '.join(mvs)}"
        )
    found = tuple((cvs.index(named[mv]), j) for j, mv in enumerate(mvs) if mv in named)
    return found if len(mvs) > 1 else None


def require_numbers(params: Any) -> None:
    """Raise LawError where the tuning ``manual`` lacks its numbers."""
    if params.tuning == "manual" and (params.kc is None or params.ti_s is None):
        raise LawError("PID tuning `manual` needs kc and ti_s; give both or take optimized, imc, simc or itae")


def _searched(params: Any, signals: Signals, plant: Simulator, law_of: LawOf) -> TunedLoops:
    """The calmest of the best numbers over the plant and its variations, of the given or the best two pairings.

    The least cost decides among pairings, ``calmest`` among the numbers that were tried on the chosen one.
    """
    responses = StepResponses.near_start(plant)
    low, high = plant.asked
    longest = max(HOLD_SETTLING_TIMES * responses.settling, HOLD_RANGE_CROSSINGS * responses.crossing(high - low))
    hold = params.development_hold or int(np.clip(longest, *DEVELOPMENT_HOLDS))
    drawn = (params.development_seeds, params.development_set_points, hold)
    plants = [DevelopmentLoops.by_simulation(variation, *drawn) for variation in plant.variations()]
    percent = 100 / (signals.sp[0].high - signals.sp[0].low)
    found: list[tuple[float, TunedPairing, CostedLoops]] = []
    weighted = params.criterion == "itae"
    given = given_pairs(params, signals)
    tables = dict(pairings(responses.share)[:2]) if given is None else {given: gains_of(responses.share, given)}
    for pairs, table in tables.items():
        costed = CostedLoops(plants, partial(law_of, pairs=pairs), weighted)
        processes = [responses.process(*pair) for pair in pairs]
        least, _ = searched(processes, signals.period_s, costed, params.given()[0], params.set_point_weight)
        gains = tuple(float(table[cv, cv]) for cv, _ in pairs)
        found.append((least, TunedPairing(pairs, gains, percent * least, weighted), costed))
    # The first of equal ones: sorting keeps their order.
    found.sort(key=lambda row: row[0])
    _, chosen, costed = found[0]
    tried = costed.tried(percent)
    settings = calmest(tried).loops
    last = calm([responses.process(*pair) for pair in chosen.pairs], signals.period_s, settings)
    several = tuple(row[1] for row in found) if len(chosen.pairs) > 1 else ()
    return TunedLoops(settings, chosen.pairs, several, last, tried)


def tried_words(tried: Sequence[TriedLoops]) -> str:
    """The settings that a search tried, for the report."""
    return (
        f"{len(tried)} sets of settings were tried in closed loops over the plant, and over what it may be beside its "
        "model, with set points and with loads. The errors at set points and under loads count over those of the "
        "cheapest settings, and the error is the larger. The settings taken have the least travel among those within "
        f"{100 * CALM_COST:.0f} % of the least error; travel is in % of the MVs' range a sample. The cost, which the "
        "search lowers, is the mean error in % of the range; where there is noise, the price of MV travel is in it."
    )


class CostedLoops:
    """The cost of settings in closed loops over a plant and its variations; it keeps what each of them gave."""

    def __init__(
        self, plants: Sequence[DevelopmentLoops], law_of: Callable[[list[Loops]], ControlLaw], time_weighted: bool
    ) -> None:
        self.plants, self.law_of, self.time_weighted = plants, law_of, time_weighted
        self.given: dict[
            Loops, tuple[float, ...]
        ] = {}  # settings -> cost, errors at set points and under loads, travel

    def __call__(self, rows: Sequence[Loops]) -> Array:
        """The costs of candidates (candidates,), in the unit of the first CV."""
        law = self.law_of(list(rows))
        each = [p.run(law, law.n_state, len(rows), time_weighted=self.time_weighted) for p in self.plants]
        cost, error, travel = (np.mean([getattr(e, n) for e in each], axis=0) for n in ("cost", "error", "travel"))
        # Sequences of set points and of loads alternate.
        figures = (cost, error[:, ::2].mean(axis=1), error[:, 1::2].mean(axis=1), travel.mean(axis=1))
        self.given |= zip(rows, zip(*(values.tolist() for values in figures), strict=True), strict=True)
        return np.asarray(cost)

    def tried(self, percent: float) -> tuple[TriedLoops, ...]:
        """All settings whose loops are finite, the cheapest first; costs times ``percent``."""
        rows = sorted(((of, s) for s, of in self.given.items() if np.isfinite(of[0])), key=lambda row: row[0][0])
        if not rows:
            return ()
        _, sp_least, loads_least, _ = rows[0][0]

        def over(error: float, least: float) -> float:
            return error / least if least else 1.0  # no load was drawn

        return tuple(
            TriedLoops(s, percent * cost, over(sp, sp_least), over(loads, loads_least), travel)
            for (cost, sp, loads, travel), s in rows
        )


def by_simulation(params: Any, plant: Simulator) -> bool:
    """Whether the numbers are searched over the plant as it is, because it has no equations or several loops."""
    known = isinstance(plant, EquationPlant) and len(plant.sp_signals) == len(plant.mv_signals) == 1
    return params.tuning == "optimized" and params.operating_cv is None and not known


def linearization(params: Any, models: Mapping[str, Model], plant: Simulator | None) -> tuple[Linearization, float]:
    """The linearization of the part ``linearized`` if there is one, else of the plant at ``operating_cv``.

    Beside it the dead time [s] before it: above 0 only for a plant without equations, whose linearization is of one
    or two lags that resemble it near its start.
    """
    if "linearized" in models:
        part = models["linearized"]
        if not isinstance(part, HoldsLinearization):
            raise LawError(f"law 'pid' needs a part 'linearized' that is a linearization; got one of kind {part.kind}")
        return part.linearization(), 0.0
    if plant is not None and params.operating_cv is None and not isinstance(plant, EquationPlant):
        return start_lags(plant)
    known = equations(plant, f"PID tuning {params.tuning!r} without a part `linearized`")
    sp = known.sp_signals[0]
    cv = 0.5 * (sp.low + sp.high) if params.operating_cv is None else params.operating_cv
    return known.linearize(*known.steady_state_at(cv)), 0.0
