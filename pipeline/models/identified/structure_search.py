"""Structure search: linear candidates, then networks on the best of them, ranked by free runs over held-out rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.historian.analyser_readings import Aligned, of_samples
from loopwright.pipeline.historian.feedback import fed_back
from loopwright.pipeline.historian.stated_answers import Beside, beside_record
from loopwright.pipeline.models.identified.candidates import RESTING_SHARE, misses, rests_under
from loopwright.pipeline.models.identified.knowledge import Knowledge
from loopwright.pipeline.models.identified.linear_search import LinearSearch, smallest_first
from loopwright.pipeline.models.identified.measured_disturbances import Disturbances
from loopwright.pipeline.models.identified.network_search import NetworkSearch, Rounds
from loopwright.pipeline.models.identified.noise_search import NATS, NETWORK_NATS, NoiseSearch, likely_dead_times, nats
from loopwright.pipeline.models.identified.residual_tests import Drift, curved, drift_of
from loopwright.pipeline.models.identified.scaled_record import (
    ScaledRecord,
    Scales,
    folds,
    informative,
    may_act_in_its_row,
)
from loopwright.pipeline.models.identified.steady_states import INTEGRATES, slowest_pole
from loopwright.pipeline.models.identified.structure import FARTHEST, Budget, CandidateFits, Problem, best_of
from loopwright.pipeline.models.identified.wandering_load import ErrorsAhead, errors_ahead
from loopwright.pipeline.models.part import Groundwork, Source

SETTLING_POLE = 0.98
"""Slowest pole of a fold up to which it speaks for a plant that settles, where another one integrates."""

STAND_IN_ERROR = 1.02
"""Relative error up to which a linear model that settles stands in for one that integrates."""

CONTRADICTED = 1.25
"""The same where the model of one fold integrates and that of another settles: an integrator shows in all parts."""

FARTHER = 2.0
"""Times the largest rest of the linear model up to which rests of a network may lie."""

TRIED_CORRECTION = 0.05
"""Correction of training runs that is tried where the linear model integrates, or the best network misses much."""

DRIFTS = 1.5
"""Residual over noise above which the correction is tried on the best network, and models with loads beside all."""

LEAST_NETWORK_GAIN = 0.01
"""Least relative gain of a network over the linear model, beside its spread."""

WHITE = 1.01
"""Residual over noise up to which a linear model leaves nothing to gain but curves of its state and its inputs."""


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The outcome of a search: the best linear candidate, the best network (None without one), and all finalists."""

    linear: CandidateFits
    network: CandidateFits | None
    finalists: list[CandidateFits]
    spent: float  # nominal seconds
    settles: bool  # whether the linear model comes to rest by itself
    drifts: bool  # whether gain or level move inside the record
    innovations: float | None = None  # nats by which one-step errors prefer the network; None: free runs judged
    farthest: float = FARTHEST  # scaled: where rests of a network may lie
    dead_times: Sequence[tuple[int, int]] = ()  # [periods] least and most of each input that explain the rows alike
    ahead: ErrorsAhead | None = None  # of both kinds of model, where free runs missed more than noise
    refused: bool = False  # whether the record does not prove the network's gains: the linear model takes its place

    @property
    def nonlinear(self) -> bool:
        """Whether the network wins by more than the standard error of its seeds' median, and by ``LEAST_NETWORK_GAIN``.

        In a record that drifts the seeds differ by what each took for drift, so that ``LEAST_NETWORK_GAIN`` alone
        decides. Noise is nearly all of one-step errors, and their log-likelihood decides.
        """
        if self.network is None or self.refused:
            return False
        if self.network.against != self.linear.against:  # what is known of the plant decides before any error
            return self.network.against < self.linear.against
        if self.innovations is not None:
            return self.innovations > NETWORK_NATS
        uncertain = 0.0 if self.drifts else self.network.spread / np.sqrt(self.network.seeds)
        return bool(self.network.error + max(uncertain, LEAST_NETWORK_GAIN * self.linear.error) < self.linear.error)

    @property
    def chosen(self) -> CandidateFits:
        """The network where it wins by more than its uncertainty, else the linear model."""
        return self.network if self.network is not None and self.nonlinear else self.linear

    @property
    def factor(self) -> float:
        """Held-out error of the linear model over that of the best network; 1 where no network was tried."""
        return self.linear.error / self.network.error if self.network is not None else 1.0


def select(
    rounds: Rounds,
    *,
    orders: Sequence[int],
    units: Sequence[int],
    correction: float | None = None,
    lagged: bool = True,
) -> Selection:
    """The search over one record.

    Where the MVs follow the outputs, ``by_innovations``. Else ``by_free_runs``; where the residual of its choice
    exceeds ``DRIFTS`` times the noise, both, and the model that foresees held-out rows better some rows ahead. With a
    ``correction`` that is given, free runs decide. Raises ModelError where no candidate can be fitted.
    """
    if correction is not None:
        return by_free_runs(rounds, orders, units, correction, lagged=lagged)
    if rounds.problem.fed_back:
        return by_innovations(rounds, orders, units)
    found = by_free_runs(rounds, orders, units, lagged=lagged)
    # A choice that takes a part of its error back leaves little of any load: its plain free runs tell.
    missed = _misses(rounds.problem, found.chosen, DRIFTS, plain=True)
    return _beside_loads(rounds, found, orders, units) if missed else found


def by_free_runs(
    rounds: Rounds,
    orders: Sequence[int],
    units: Sequence[int],
    correction: float | None = None,
    *,
    lagged: bool = True,
) -> Selection:
    """The search among models judged by free runs over held-out rows: for records in which no load wanders.

    Linear candidates first: balanced starts of each order with and without the dead times that the impulse
    response shows, and lagged starts unless ``lagged`` is false; where the record leaves it open, with the MVs acting
    in their own row too. Then networks on the best of them, unless its residual is white and follows no curve of its
    state and its inputs, in rounds that keep fewer and train them longer. When the budget is spent, what there is
    decides. ``correction`` None: 0, or ``TRIED_CORRECTION`` where the linear model integrates or the best network
    misses much more than the noise, and the models so trained err less over held-out rows: in plain free runs, or,
    where the plant drifts inside the record, beyond a gain and a level of each part. Raises ModelError where no
    candidate can be fitted.
    """
    given = 0.0 if correction is None else correction
    search = LinearSearch.of(rounds)
    linear = search.finish(search.first_round(orders, given, lagged))
    if _integrates(linear[0]):
        linear = _led_by_settling(linear, search.settling(linear))
    if correction is None and _integrates(linear[0]):
        corrected = search.corrected(linear, TRIED_CORRECTION)
        linear = corrected if corrected and corrected[0].rank < linear[0].rank else linear
    if may_act_in_its_row(rounds.problem.part(linear[0].structure, rounds.problem.folds[0].train), rounds.problem.n_mv):
        # Both conventions stay on offer: the networks' held-out error may decide otherwise than the linear models'.
        linear = _led_by_settling(smallest_first([*linear, *search.in_the_same_row(linear)]))
    offered = linear if correction is not None else [_with_correction(t, 0.0) for t in linear]
    problem = _as_its_linear_model(rounds.problem, linear[0])
    networks = NetworkSearch(replace(rounds, problem=problem), offered)
    lacking = _misses(rounds.problem, linear[0], WHITE) or _curved(rounds.problem, linear[0])
    finalists = networks.finalists(units) if lacking else []
    best = best_of(finalists)
    drift = None
    if correction is None and best is not None:
        seen = [linear[0], best]
        if _misses(rounds.problem, best, DRIFTS):
            # Models whose training runs take their error back are not bent to follow a drift, so that they show it.
            corrected = networks.corrected(best, TRIED_CORRECTION)
            finalists += corrected
            seen += corrected[:1]
        drift = max((_drift(rounds.problem, trial) for trial in seen), key=lambda found: found.share)
    drifting = drift is not None and drift.found
    if drift is not None and drifting:
        # Plain free runs would rank candidates by how they follow what no model can.
        linear = smallest_first([*linear, *search.corrected(linear[:2], TRIED_CORRECTION)])
        linear = _led_by_settling(smallest_first(rounds.judged_beyond_drift(linear, drift.rows)))
        finalists = rounds.judged_beyond_drift(finalists, drift.rows)
    every, spent = [*linear, *finalists], rounds.budget.spent
    return Selection(linear[0], best_of(finalists), every, spent, problem.settles, drifting, None, problem.farthest)


def _beside_loads(rounds: Rounds, found: Selection, orders: Sequence[int], units: Sequence[int]) -> Selection:
    """The outcome of ``by_innovations`` where it foresees the rows better than what free runs found, else that one.

    Knowledge of the plant decides before any error. A model that was not fitted on all folds is compared with none.
    """
    again = replace(rounds, budget=replace(rounds.budget, spent=0.0))
    try:
        other = by_innovations(again, orders, units)
    except ModelError:  # no filter follows the record
        return replace(found, spent=found.spent + again.budget.spent)
    spent, one_step, free_runs = found.spent + other.spent, other.chosen, found.chosen
    if one_step.folds != free_runs.folds:
        return replace(found, spent=spent)
    ahead = errors_ahead(rounds, one_step, free_runs)
    better = ahead.wanders if one_step.against == free_runs.against else one_step.against < free_runs.against
    return replace(other if better else found, spent=spent, ahead=ahead)


def by_innovations(rounds: Rounds, orders: Sequence[int], units: Sequence[int]) -> Selection:
    """The search among models with their noise, judged by one-step errors over held-out rows: where loads wander.

    Free runs would rank them by the loads that nobody measures, and in a closed loop by how they read the controller
    backwards.
    """
    search = NoiseSearch.of(rounds)
    ranked = search.linear(orders)
    linear = _settling_first(rounds.problem, ranked)
    problem = _as_its_linear_model(rounds.problem, linear[0])
    search = replace(search, rounds=replace(rounds, problem=problem))
    networks = search.networks(linear, units)
    best = best_of(networks)
    # Nothing is gained by what the linear model gave away to settle, or for the middle dead time.
    rival = min((*ranked[:2], linear[0]), key=lambda t: t.rank)
    gained = 0.0 if best is None else nats(rounds.problem, rival, best)
    every, spent = [*linear, *networks], rounds.budget.spent
    alike = likely_dead_times(problem, ranked)
    return Selection(linear[0], best, every, spent, problem.settles, False, gained, problem.farthest, alike)


def _led_by_settling(linear: list[CandidateFits], more: Sequence[CandidateFits] = ()) -> list[CandidateFits]:
    """The trials, where the first integrates after one of them or of ``more`` that settles and stands in for it."""
    if not _integrates(linear[0]):
        return linear
    found = next((t for t in smallest_first([*more, *linear]) if _stands_in(t, linear[0])), None)
    return linear if found is None else [found, *(t for t in linear if t.structure != found.structure)]


def _stands_in(trial: CandidateFits, best: CandidateFits) -> bool:
    """Whether a trial settles in all folds and errs little more than the best, which integrates in one at least."""
    most = STAND_IN_ERROR if min(_slowest(best, fold) for fold in best.folds) > INTEGRATES else CONTRADICTED
    known = len(trial.fits) >= len(best.fits) and trial.against <= best.against
    return known and not _integrates(trial) and trial.error <= most * best.error


def _settling_first(problem: Problem, linear: list[CandidateFits]) -> list[CandidateFits]:
    """Where the best integrates in a fold, one that settles in all first, if it errs as little.

    A load that wanders and a state of the plant that drifts are hard to tell apart one row ahead. A state that drifts
    in one part of the record alone, or that a model of a quick plant does without, is the load's, and leaves the plant
    without a gain. One that settles clearly goes before others, and alone where all parts show a pole at 1; of these
    one of the same dead times first.
    """
    best = linear[0]
    slowest = [_slowest(best, fold) for fold in best.folds]
    if max(slowest) <= INTEGRATES:
        return linear
    alike = [t for t in linear if t.against == best.against and nats(problem, t, best) <= NATS]
    alike.sort(key=lambda t: t.structure.delays != best.structure.delays)
    for limit in (SETTLING_POLE, INTEGRATES) if min(slowest) <= SETTLING_POLE else (SETTLING_POLE,):
        settling = next((t for t in alike if all(_slowest(t, fold) <= limit for fold in t.folds)), None)
        if settling is not None:
            return [settling, *(t for t in linear if t is not settling)]
    return linear


def _drift(problem: Problem, trial: CandidateFits) -> Drift:
    return drift_of(trial.of_fold(trial.folds[0])[0].model, problem.whole(trial.structure))


def _with_correction(trial: CandidateFits, correction: float) -> CandidateFits:
    return CandidateFits(replace(trial.structure, correction=correction), trial.fits)


def _integrates(trial: CandidateFits) -> bool:
    return max(_slowest(trial, fold) for fold in trial.folds) > INTEGRATES


def _as_its_linear_model(problem: Problem, trial: CandidateFits) -> Problem:
    """The problem with the test that networks have to pass, which the linear model must pass itself.

    A pole below ``INTEGRATES`` can be too slow to come to rest in that test, and rests of a high gain lie far off: a
    test that the linear model fails rejects every network. One that it passes in a single fold is asked all the same:
    a plant that fades or drifts integrates in a part of its record, and networks that run away are no models of it.
    """
    n_y = problem.data.y.shape[1]
    found = [rests_under(trial.of_fold(fold)[0].model.plant, problem) for fold in trial.folds]
    resting = [x for x, share in found if share >= RESTING_SHARE]
    largest = max((float(np.abs(x[:, :n_y]).max()) for x in resting), default=0.0)
    return replace(problem, settles=bool(resting), farthest=max(problem.farthest, FARTHER * largest))


def _slowest(trial: CandidateFits, fold: int) -> float:
    """The largest magnitude of a pole of a fold's best fit."""
    return slowest_pole(trial.of_fold(fold)[0].model.plant)


def _curved(problem: Problem, trial: CandidateFits) -> bool:
    fold = trial.folds[0]
    best = trial.of_fold(fold)[0]
    return curved(best.model, best.starts, problem.train(trial.structure, fold), trial.structure.correction)


def _misses(problem: Problem, trial: CandidateFits, ratio: float, *, plain: bool = False) -> bool:
    """Whether a trial misses more than ``ratio`` times the noise in its own runs, or in ``plain`` free runs."""
    fold = trial.folds[0]
    best = trial.of_fold(fold)[0]
    correction = 0.0 if plain else trial.structure.correction
    return misses(best.model, best.starts, problem.train(trial.structure, fold), ratio, correction)


# ------------------------------------------------------------ the search as work that the members of an ensemble share
MINUTES = 2.0
"""Budget for each output, in minutes of one core."""


@dataclass(frozen=True, slots=True, eq=False)
class Searched:
    """The problem that was searched, its outcome, the scales of its record, and what is known beside that record.

    ``disturbances`` is of those that are measured. ``late`` (n_y,) are the rows by which the readings of outputs come
    late, and by which those of the problem stand earlier.
    """

    problem: Problem
    selection: Selection
    scales: Scales
    disturbances: Disturbances
    known: Sequence[Beside] = ()
    late: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class StructureSearch(Groundwork[Searched]):
    """The choices of params.yaml that decide the search."""

    kind: str
    all_measured: bool  # all PVs are outputs, not the controlled ones alone
    orders: tuple[int, int] | None
    lagged: bool
    units: tuple[int, ...]
    correction: float | None
    minutes: float | None
    rows: int

    def done(self, source: Source, label: str) -> Searched:
        """The search over the source's record; ModelError where it cannot carry a model."""
        seen = source.data(self.kind)
        n_y, n_mv = len(source.signals.pv if self.all_measured else source.signals.sp), len(source.signals.mv)
        quick = [i for i in range(n_y) if i not in seen.seldom]  # a look at an analyser now and then is no feedback
        back = seen.fed_back or fed_back(seen.mv, seen.pv[:, quick], seen.run)
        aligned = Aligned.of(seen, n_y)
        seen = aligned.record
        record = informative(seen, self.rows)
        scales = Scales.of(record, n_y)
        data = ScaledRecord.of(record, scales)
        disturbances = Disturbances.of(ScaledRecord.of(seen, scales), data, n_mv)
        data, in_a_loop = disturbances.smoothed(data), disturbances.followed(data)
        signals = source.signals
        inputs, outputs = [s.name for s in (*signals.mv, *signals.dv)], [s.name for s in signals.pv[:n_y]]
        # No model is bent to what the record is certain to contradict: that is asked, and answered by a person.
        dv = data.v[:, n_mv:] * scales.v_scale[n_mv:] + scales.v_center[n_mv:]
        stated = of_samples(source.known, dict(zip(outputs, aligned.late, strict=True)), signals.period_s)
        beside = beside_record(stated, replace(record, dv=dv) if disturbances.sure.any() else record)
        used = [left for one in beside if (left := one.unopposed) is not None]
        known = Knowledge.of(used, outputs, inputs, scales, signals.period_s)
        problem = Problem(
            data, folds(record), n_mv, source.seed, self.correction or 0.0, fed_back=back, known=known, seen=in_a_loop
        )
        budget = Budget(60 * (MINUTES * n_y if self.minutes is None else self.minutes), len(data), n_y)
        least, most = self.orders or (max(2, n_y), 8 + 2 * (n_y - 1))
        orders = range(max(least, n_y), max(most, n_y) + 1)
        rounds = Rounds(problem, budget, label)
        selection = select(rounds, orders=orders, units=self.units, correction=self.correction, lagged=self.lagged)
        problem = replace(problem, settles=selection.settles, farthest=selection.farthest)
        return Searched(problem, selection, scales, disturbances, beside, aligned.late)

    def plainer(self, found: Searched) -> Searched | None:
        """The linear model in the network's place: it may be proven where the network bends by what is not the MVs'."""
        if not found.selection.nonlinear:
            return None
        return replace(found, selection=replace(found.selection, refused=True))
