"""Unmeasured loads on a PV, and the move of an MV whose answer stands out of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.excitation import SEEN
from loopwright.pipeline.historian.findings import InputReport, Verdict
from loopwright.pipeline.historian.free_run import free_run
from loopwright.pipeline.historian.linear import Linear
from loopwright.pipeline.historian.step_test import length_of_test, usual_hold
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record

OVER_LOADS = 3.0  # standard deviations of the loads within a step test, that the answer to a move has
LEAST_WINDOWS = 3  # of the test's length in the record; else shorter ones
MOST_OF_PV = 0.5  # of the PV's range, that an answer has at most


def with_load_moves(verdict: Verdict, record: Record, models: Mapping[str, Linear | None]) -> Verdict:
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
            if report.role == "mv" and report.answers[name] > SEEN and 0 < answer < np.inf:
                needed.append(min(OVER_LOADS * loads[name], MOST_OF_PV * spans[name]) / answer)
        return replace(report, load_move=float(min(needed, default=0.0)))

    return replace(verdict, inputs=tuple(sized(i, report) for i, report in enumerate(verdict.inputs)))


def load_sd(rest: Array, run: NDArray[np.int64], rows: int) -> float:
    """Standard deviation of what inputs do not explain (n,) within windows of ``rows``, the median; 0 where unknown."""
    ok = np.flatnonzero(np.isfinite(rest))
    length = min(rows, len(ok) // LEAST_WINDOWS)
    if length < 2:
        return 0.0
    windows = ok[: len(ok) // length * length].reshape(-1, length)
    windows = windows[run[windows[:, 0]] == run[windows[:, -1]]]
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable model
        spread: Sequence[float] = np.std(rest[windows], axis=1).tolist()
    return float(np.median(spread)) if spread and np.isfinite(spread).all() else 0.0
