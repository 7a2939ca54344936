"""Plant and controllers in open loop: MVs at rest, replays, cold starts at rests of the record, first answers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from loopwright.pipeline.dynamics.step_response import SEEN_CV_MOVE, first_answer_within
from loopwright.pipeline.errors import PlantError, RecordError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.law_evidence import ColdStart
from loopwright.pipeline.evaluation.metric import together
from loopwright.pipeline.evaluation.model_evidence import identified_part
from loopwright.pipeline.plants.simulator import Array, Signals, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.records.recorded_rests import RecordedRest
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import simulate_closed
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import Signal

# ---------------------------------------------------------------------- the MVs rest where they stand as a test begins
RUNS_AWAY = 1.0
"""Ranges of a controlled variable from its set point, where no plant and no transmitter goes."""


def errors_at_rest(case: Case) -> dict[str, float]:
    """Test -> the error that is there without control, in the case's metric: what a controller has to make smaller.

    A test whose plant does not stay finite under MVs at rest is left out: there every law that does is better. An
    error counts as far as ``RUNS_AWAY`` ranges of its controlled variable: how far an integrator would go says nothing.
    """
    found = {name: _error(case, tests) for name, tests in case.scenarios().items()}
    return {name: error for name, error in found.items() if error is not None}


def _error(case: Case, tests: Sequence[Scenario]) -> float | None:
    rows = []
    for test in tests:
        try:
            loop = simulate_closed(test.plant or case.plant, _rests, test)
        except PlantError:
            return None
        far = RUNS_AWAY * np.array([s.high - s.low for s in case.plant.sp_signals])
        pv = loop.pv.copy()
        pv[:, : len(far)] = np.clip(pv[:, : len(far)], loop.sp - far, loop.sp + far)
        rows.append(case.score(test, pv, loop.mv))
    error = together(rows, case.metrics)[case.metric]
    return error if np.isfinite(error) else None


def _rests(sp: Array, pv: Array, mv: Array) -> tuple[Array, Array]:
    return mv, np.empty(0)


# ----------------------------------------------------------------------------------------- replay: nothing is fed back
UNSEEN = 0.2  # share of the rows, the last ones: the choice of the model's structure held them out
REPLAY_ROWS = 2_000  # rows
AT_RANGE_END = 1e-3  # of an MV's range


class Steps(Protocol):
    """An object that steps a control law: ``loopwright.serving.Controller``."""

    def cold_state(self) -> Array:
        """The state of no past."""

    def step(self, *, sp: Array, pv: Array, dv: Array, mv_applied: Array, state: Array) -> Any:
        """(mv, state_next, info) from sp, pv, dv, mv_applied and state."""


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """Rows of a record with what a law asked for. The rows count on through the gaps of the record."""

    time_s: Array  # (n,) rows times the period
    sp: Array  # (n, n_sp) the set points that the law was given
    pv: Array  # (n, n_sp) recorded controlled variables
    asked: Array  # (n, n_mv); NaN where the controller refused the row
    done: Array  # (n, n_mv) recorded

    def figures(self, mvs: Sequence[Signal]) -> dict[str, dict[str, float]]:
        """For each MV: distance of asked from done and its mean [% of range], correlation, share at an end [%].

        ``mvs`` are the law's, with the ranges that it commands. The correlation is left out where either never moved.
        """
        found = {}
        for i, signal in enumerate(mvs):
            known = np.isfinite(self.asked[:, i])
            asked, done, span = self.asked[known, i], self.done[known, i], signal.high - signal.low
            if not asked.size:
                found[signal.name] = {"refused": 100.0}
                continue
            ends = (asked <= signal.low + AT_RANGE_END * span) | (asked >= signal.high - AT_RANGE_END * span)
            row = {
                "distance": 100 * float(np.mean(np.abs(asked - done))) / span,
                "more": 100 * float(np.mean(asked - done)) / span,
                "at_end": 100 * float(np.mean(ends)),
                "refused": 100 * float(np.mean(~known)),
            }
            if asked.std() > 1e-9 * span and done.std() > 1e-9 * span:
                row["correlation"] = float(np.corrcoef(asked, done)[0, 1])
            found[signal.name] = row
        return found

    def arrays(self) -> Mapping[str, Array]:
        """By name, for a file."""
        return {name: getattr(self, name) for name in ("time_s", "sp", "pv", "asked", "done")}


def replay(law: Steps, record: Record, signals: Signals, ahead: int, *, same_row: bool = False) -> Replay:
    """A law over the last fifth of a record, at most ``REPLAY_ROWS`` rows, with the recorded PVs, disturbances and MVs.

    No set point stands in a record. The law is given where the operation went: the mean of each recorded CV over the
    next ``ahead`` samples of its run. ``signals`` are the law's. An MV acts on the outputs of the next row, or with
    ``same_row`` on those of its own: then what was done at a row stands in the next one, and the last row of a run,
    which has none, is left out. Raises RecordError where there are no two rows.
    """
    n = len(record)
    first = max(n - round(UNSEEN * n), n - REPLAY_ROWS, 0)
    rows, n_sp, n_pv = np.arange(first, n), len(signals.sp), len(signals.pv)
    begins = np.flatnonzero(np.r_[True, record.run[1:] != record.run[:-1]])
    ends = np.append(begins[1:], n)[np.searchsorted(begins, rows, side="right") - 1]
    known = rows + same_row < ends
    rows, ends = rows[known], np.minimum(rows + ahead, ends)[known]
    if len(rows) < 2:
        raise RecordError(f"the record has {n} rows, too few to replay its last fifth; record more")
    sp = np.array([record.pv[k:end, :n_sp].mean(axis=0) for k, end in zip(rows, ends, strict=True)])
    done = record.mv[rows + same_row]
    asked, state = np.empty(done.shape), law.cold_state()
    for i, k in enumerate(rows):
        fresh = i == 0 or k in begins
        state = law.cold_state() if fresh else state
        # What acted over the last period; nobody knows it of the first row of a run, unless it stands in that row.
        before = record.mv[k if same_row or fresh else k - 1]
        try:
            pv, dv = record.pv[k, :n_pv], record.dv[k]
            asked[i], state, _ = law.step(sp=sp[i], pv=pv, dv=dv, mv_applied=before, state=state)
        except LoopwrightError:
            asked[i], state = np.nan, law.cold_state()
    time_s = record.period_s * np.arange(len(rows), dtype=np.float64)
    return Replay(time_s, sp, record.pv[rows, :n_sp], asked, done)


# ---------------------------------------------------------------------- a law is started cold at rests of the record
# samples at each rest: a law whose MV moves by little a period, or that finds a load by and by, is on its way by then
COLD_STEPS = 10


def cold_start(laws: Sequence[Steps], rests: Sequence[RecordedRest], signals: Signals) -> ColdStart:
    """The MVs that laws ask for without a past at each rest of a record, beside those that held the plant there.

        a_i(k) = 100 |mv_i(k) - u_i| / range_i   [%],   sp = pv = y,  dv = d,  mv_applied = u  at each k

    with the levels y, d and u of a rest. The plant stays where it was, and the MV too, as in SHADOW. ``signals`` are
    the law's. Rests whose set points or MVs lie outside of their ranges are left out: there a law asks for what its
    range has. An MV of a few allowed values has no rest.
    """
    within = [rest for rest in rests if _within_ranges(rest, signals)]
    span = np.array([s.high - s.low for s in signals.mv])
    found, refused, quarters = list[tuple[Array, RecordedRest]](), set[int](), list[float]()
    for law in laws:
        own = []
        for rest in within:
            try:
                own.append((100 * np.abs(_asked_cold(law, rest, signals) - rest.mv) / span, rest))
            except LoopwrightError:
                refused.add(rest.first)
        found += own
        quarters += [float(np.quantile([of.max() for of, _ in own], 0.25))] if own else []
    if not found:
        return ColdStart(len(within), refused=len(refused))
    away = np.stack([of for of, _ in found])  # (starts, COLD_STEPS, n_mv)
    start, _, mv = np.unravel_index(int(away.argmax()), away.shape)
    rest = found[int(start)][1]
    groups = ((signals.pv, rest.pv), (signals.mv, rest.mv), (signals.dv, rest.dv))
    at = {s.name: float(v) for group, levels in groups for s, v in zip(group, levels, strict=False)}
    first, later = float(away[:, 0].max()), float(away[:, 1:].max())
    return ColdStart(len(within), first, later, max(quarters), signals.mv[int(mv)].name, at, len(refused))


def _within_ranges(rest: RecordedRest, signals: Signals) -> bool:
    levels = zip((*signals.sp, *signals.mv), (*rest.pv[: len(signals.sp)], *rest.mv), strict=True)
    return all(s.values is None and s.low <= level <= s.high for s, level in levels)


def _asked_cold(law: Steps, rest: RecordedRest, signals: Signals) -> Array:
    """MVs (COLD_STEPS, n_mv) that a law asks for at a rest."""
    asked, state = np.empty((COLD_STEPS, len(signals.mv))), law.cold_state()
    pv = rest.pv[: len(signals.pv)]
    for k in range(COLD_STEPS):
        asked[k], state, _ = law.step(sp=pv[: len(signals.sp)], pv=pv, dv=rest.dv, mv_applied=rest.mv, state=state)
    return asked


# ------------------------------------------------------------------ the first answers, for the manifest and its monitor
DEAD_TIME_MOVE = 0.1  # of an MV's range
ANSWER_RUN = 200  # samples that are simulated; a monitor counts as far


def first_answers(case: Case, models: Mapping[str, Any]) -> list[int | None]:
    """Periods k from a move of the quickest MV to the first answer of each CV, None without one.

        k = 1 + dead time

    An own plant has those of the model of its record, which its report and its laws have too. ``models`` is
    metrics.json of the law's model set. A plant in equations has none, and is simulated, see ``plant_answers``; so is
    a model whose figures lack first answers.
    """
    pairs: Mapping[str, Mapping[str, int | None]] = identified_part({"": models}).get("first_answers") or {}
    plant = case.plant
    if any(cv.name not in pairs for cv in plant.sp_signals):
        return plant_answers(plant)
    return [_soonest(pairs[cv.name].get(mv.name) for mv in plant.mv_signals) for cv in plant.sp_signals]


def plant_answers(plant: Simulator) -> list[int | None]:
    """For each CV the first sample k >= 1 at which it answers a move at sample 0; None within ANSWER_RUN.

    The plant is simulated from its start with and without a move of each MV, and the quickest MV counts, see
    ``first_answer_within``. A plant without dead time answers at k = 1.
    """
    x, mv = plant.start
    found = []
    for i, signal in enumerate(plant.mv_signals):
        moved = np.array(mv, dtype=np.float64)
        moved[i] = _elsewhere(signal, float(mv[i]))
        found.append([first_answer_within(y, SEEN_CV_MOVE) for y in _course(plant, x, mv, moved)])
    return [_soonest(of) for of in zip(*found, strict=True)]


def _course(plant: Simulator, x: Array, mv: Array, moved: Array) -> Array:
    """Changes (n_cv, periods) of the CVs by a move of the MVs, in their ranges; they end where the plant has no state.

    A move may carry a plant far from where its equations hold, long after it has answered.
    """
    n, step, p = len(plant.sp_signals), plant.stepper(), plant.parameters()
    span = np.array([s.high - s.low for s in plant.pv_signals[:n]])
    still, other = np.array(x, dtype=np.float64), np.array(x, dtype=np.float64)
    rows = np.zeros((n, ANSWER_RUN))
    for k in range(rows.shape[1]):
        try:
            still, other = step(still, mv, plant.dv_nominal, p), step(other, moved, plant.dv_nominal, p)
        except PlantError:
            return rows[:, :k]
        rows[:, k] = (plant.measure(other)[:n] - plant.measure(still)[:n]) / span
    return rows


def _elsewhere(signal: Signal, value: float) -> float:
    """Another value of the MV: toward the end that is further off, or another allowed one."""
    if signal.values is not None:
        return next((v for v in signal.values if v != value), value)
    move = DEAD_TIME_MOVE * (signal.high - signal.low)
    return value + move if value <= signal.middle else value - move


def _soonest(periods: Iterable[int | None]) -> int | None:
    return min((k for k in periods if k is not None), default=None)
