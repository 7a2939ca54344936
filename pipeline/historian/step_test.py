"""The step test to run where a record cannot carry a model: a table that an operator can follow."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.arx_model import Linear, free_run
from loopwright.pipeline.historian.cleaning.findings import InputReport, RecordJudgement
from loopwright.pipeline.historian.excitation import SEEN_STRENGTH
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record

RANDOM_MOVES = 24  # random ones
AMPLITUDE, LARGEST_AMPLITUDE = 0.05, 0.12  # of the range, to each side of the present value
AMPLITUDE_UNDER_LOADS = 0.25  # of the range, to each side, where loads would hide the answer to less
UNKNOWN_PERIODS = 60  # for settling where the record does not show it
GUESSED_H, LONGEST_H = 12.0, 24.0  # [h] of a test, its hold guessed, and any
FEWEST_TEST_MOVES = 8  # random moves
ALONE = 1.5  # settling times that one MV alone is held for
HOLD_SETTLINGS = (0.4, 0.7, 1.0, 1.6)  # of the settling time
HOLD_ROWS = 5  # rows of the shortest hold; fewer where the test would last longer than LONGEST_H
STEP_TEST_SEED = 0  # of the moves


@dataclass(frozen=True, slots=True)
class StepTest:
    """Rows of (start [s], hold [s], value of each MV), and what they are for.

    Over the first ``ramp_s`` [s] of its hold an MV is moved evenly to its value; 0 is a step.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    start_s: tuple[float, ...]
    hold_s: tuple[float, ...]
    values: tuple[tuple[float, ...], ...]
    ramp_s: tuple[float, ...]
    reading_s: float = 0.0  # [s] at most between readings of the test, where the record's rows are too long for it

    @property
    def hours(self) -> float:
        """Length of the whole test."""
        return (self.start_s[-1] + self.hold_s[-1]) / 3600.0

    @property
    def reading(self) -> str:
        """The end of a sentence on how often its readings must come, where holds are few rows of the record."""
        return f"; export it with a reading every {self.reading_s:.3g} s or less" if self.reading_s else ""

    @property
    def sizes(self) -> tuple[float, ...]:
        """The largest change of each MV from the value that the test begins at."""
        values = np.array(self.values)
        return tuple(float(v) for v in np.abs(values - values[0]).max(axis=0))

    def table(self) -> str:
        """CSV: step, time after the start, hold [min], one column an MV; of ramps their time [min] too."""
        out = io.StringIO()
        rows = csv.writer(out, lineterminator="\n")
        columns = [f"{n} [{u}]" for n, u in zip(self.names, self.units, strict=True)]
        ramps = ["move evenly over [min]"] if any(self.ramp_s) else []
        rows.writerow(["step", "at [h:mm:ss]", "at [s]", *ramps, "hold [min]", *columns])
        lines = zip(self.start_s, self.hold_s, self.ramp_s, self.values, strict=True)
        for i, (at, hold, ramp, values) in enumerate(lines, start=1):
            clock = f"{int(at) // 3600}:{int(at) // 60 % 60:02}:{int(at) % 60:02}"
            minutes = [f"{time_s / 60 + 0.0:.4g}" for time_s in ([ramp] if ramps else []) + [hold - ramp]]
            rows.writerow([i, clock, f"{at:g}", *minutes, *(f"{v:.5g}" for v in values)])
        return out.getvalue()


def planned(
    inputs: Sequence[InputReport],
    now: Sequence[float],
    period_s: float,
    fastest: Mapping[str, float] = MappingProxyType({}),
) -> StepTest:
    """Steps around the present values: first one MV at a time, then all at random, from a fixed seed.

    Amplitude: AMPLITUDE of the range, LARGEST_AMPLITUDE where no answer was seen; more where loads would hide the
    answer, up to AMPLITUDE_UNDER_LOADS, or up to LARGEST_AMPLITUDE where the gain is not certain. Holds: HOLD_SETTLINGS
    of ``usual_hold``, HOLD_ROWS rows at least, or fewer where the test would take longer than LONGEST_H, ramps apart.
    ``fastest``: MV -> its largest change in a minute; a step beyond it becomes a ramp, and its hold begins when the
    ramp has ended.
    """
    mvs = [i for i in inputs if i.role == "mv"]
    random = np.random.default_rng(STEP_TEST_SEED)
    settling, moves = usual_hold(inputs, period_s)
    size = [_size(i, fastest.get(i.name, np.inf) / 60.0 * settling) for i in mvs]
    middle = [min(max(v, i.low + s), i.high - s) for v, i, s in zip(now, mvs, size, strict=True)]
    values, holds = [tuple(middle)], [settling]
    for j in range(len(mvs)):  # one at a time: up, down, back
        for sign in (1.0, -1.0, 0.0):
            values.append(tuple(m + sign * s * (i == j) for i, (m, s) in enumerate(zip(middle, size, strict=True))))
            holds.append(ALONE * settling)
    share = np.array([-1.0, -0.5, 0.5, 1.0])
    for _ in range(moves):
        values.append(tuple(float(m + s * random.choice(share)) for m, s in zip(middle, size, strict=True)))
        holds.append(float(random.choice(HOLD_SETTLINGS)) * settling)
    values.append(tuple(middle))
    holds.append(settling)
    rates = np.array([fastest.get(i.name, np.inf) for i in mvs]) / 60.0
    change = np.abs(np.diff(np.array([tuple(now), *values]), axis=0))
    one_period = change <= rates * period_s * (1 + 1e-9)
    needed = np.where(one_period, 0.0, change / rates).max(axis=1)  # [s]
    ramps = np.ceil(needed / period_s - 1e-9) * period_s
    rows = _rows_of(np.array(holds), period_s)
    hold_s = tuple(float(n * period_s + r) for n, r in zip(rows, ramps, strict=True))
    start = tuple(float(t) for t in np.r_[0.0, np.cumsum(hold_s[:-1])])
    names, units = tuple(i.name for i in mvs), tuple(i.unit for i in mvs)
    reading_s = period_s * float(rows.min()) / HOLD_ROWS if rows.min() < HOLD_ROWS else 0.0
    return StepTest(names, units, start, hold_s, tuple(values), tuple(map(float, ramps)), reading_s)


def _rows_of(hold_s: Array, period_s: float) -> Array:
    """Rows (n,) of each hold (n,) [s], together within LONGEST_H as far as whole rows allow."""
    longest = LONGEST_H * 3600.0
    hold_s = hold_s * min(1.0, longest / float(hold_s.sum()))
    for least in range(HOLD_ROWS, 0, -1):
        for whole in (np.round, np.floor):
            rows = np.maximum(whole(hold_s / period_s), least)
            if rows.sum() * period_s <= longest:
                return rows
    return rows


def usual_hold(inputs: Sequence[InputReport], period_s: float) -> tuple[float, int]:
    """A hold [s] of the test, and how many moves all MVs make at random.

    The settling time, where it is certain; else UNKNOWN_PERIODS, or a longer guess of it as far as the test does not
    take longer than GUESSED_H. A plant whose settling time is certain and long has FEWEST_TEST_MOVES random moves, and
    shorter holds where the test would take longer than LONGEST_H. A record of long rows has fewer random moves too, so
    that each is held for HOLD_ROWS of them.
    """
    mvs = [i for i in inputs if i.role == "mv"]
    alone = 2 + 3 * ALONE * len(mvs)  # holds outside the random moves
    certain = max((i.settling_s for i in mvs), default=0.0)
    if certain <= 0:
        most = LONGEST_H * 3600 * min(HOLD_SETTLINGS) / (HOLD_ROWS * period_s)  # of all holds within the longest test
        moves = int(np.clip((most - alone) / np.mean(HOLD_SETTLINGS), FEWEST_TEST_MOVES, RANDOM_MOVES))
        many = alone + moves * float(np.mean(HOLD_SETTLINGS))
        guess = min(max((i.uncertain_s for i in mvs), default=0.0), GUESSED_H * 3600 / many)
        return min(max(guess, UNKNOWN_PERIODS * period_s), LONGEST_H * 3600 / many), moves
    longest = LONGEST_H * 3600 / certain  # holds within the longest test
    moves = int(np.clip((longest - alone) / np.mean(HOLD_SETTLINGS), FEWEST_TEST_MOVES, RANDOM_MOVES))
    return min(certain, LONGEST_H * 3600 / (alone + moves * float(np.mean(HOLD_SETTLINGS)))), moves


def length_of_test(inputs: Sequence[InputReport], period_s: float) -> float:
    """About how long [s] the whole test takes, without ramps."""
    hold, moves = usual_hold(inputs, period_s)
    return hold * (2 + 3 * ALONE * sum(i.role == "mv" for i in inputs) + moves * float(np.mean(HOLD_SETTLINGS)))


def _size(report: InputReport, most: float) -> float:
    """The largest step of an MV to each side; one sized over loads is at most ``most``, that its rate allows."""
    span = report.high - report.low
    least = (AMPLITUDE if _seen(report) else LARGEST_AMPLITUDE) * span
    return max(
        least, min(report.load_move, (AMPLITUDE_UNDER_LOADS if report.certain else LARGEST_AMPLITUDE) * span, most)
    )


def _seen(report: InputReport) -> bool:
    return any(a > SEEN_STRENGTH for a in report.answers.values())


# --------------------------------------------------------- moves of an MV whose answer stands out of the loads on a PV
OVER_LOADS = 3.0  # standard deviations of the loads within a step test, that the answer to a move has
LEAST_TEST_WINDOWS = 3  # of the test's length in the record; else shorter ones
MOST_OF_PV = 0.5  # of the PV's range, that an answer has at most


def with_load_moves(verdict: RecordJudgement, record: Record, models: Mapping[str, Linear | None]) -> RecordJudgement:
    """The verdict, its MVs with the move that a step test needs among the loads of the record."""
    if not len(record):
        return verdict
    rows = max(int(length_of_test(verdict.inputs, record.period_s) / record.period_s), 2)
    hold = max(int(usual_hold(verdict.inputs, record.period_s)[0] / record.period_s), 1)
    u = [*record.mv.T, *record.dv.T]
    loads, spans = dict[str, float](), dict[str, float]()
    for (name, model), y, signal in zip(models.items(), record.pv.T, record.pv_signals, strict=True):
        if model is not None and not model.integrates:
            loads[name] = load_sd(y - free_run(model, u, record.run), record.run, rows)
            spans[name] = signal.high - signal.low

    def sized(i: int, report: InputReport) -> InputReport:
        needed = []
        for name in loads:
            model = models[name]
            answer = 0.0 if model is None else abs(float(model.step_response(i, hold + 1)[-1]))
            if report.role == "mv" and report.answers[name] > SEEN_STRENGTH and 0 < answer < np.inf:
                needed.append(min(OVER_LOADS * loads[name], MOST_OF_PV * spans[name]) / answer)
        return replace(report, load_move=float(min(needed, default=0.0)))

    return replace(verdict, inputs=tuple(sized(i, report) for i, report in enumerate(verdict.inputs)))


def load_sd(rest: Array, run: NDArray[np.int64], rows: int) -> float:
    """Standard deviation of what inputs do not explain (n,) within windows of ``rows``, the median; 0 where unknown."""
    ok = np.flatnonzero(np.isfinite(rest))
    length = min(rows, len(ok) // LEAST_TEST_WINDOWS)
    if length < 2:
        return 0.0
    windows = ok[: len(ok) // length * length].reshape(-1, length)
    windows = windows[run[windows[:, 0]] == run[windows[:, -1]]]
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable model
        spread: Sequence[float] = np.std(rest[windows], axis=1).tolist()
    return float(np.median(spread)) if spread and np.isfinite(spread).all() else 0.0
