"""Whether the record proves the model that was fitted to it: its answers beside one-step predictions, its free run.

All tests of an own plant run on models of one record. Where that record shows the controller more than the plant, all
of them are wrong together, and the tests are met. So the answers of the model to its MVs are compared with those that
``DirectModel`` reads from the same rows, and with those of each half of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pipeline.config.known import SURE
from pipeline.historian.direct import DirectModel
from pipeline.historian.feedback import follows
from pipeline.models.identified.innovations import innovations
from pipeline.models.identified.linear_start import high_order_arx
from pipeline.models.identified.scaled_record import ScaledRecord, Scales
from pipeline.models.identified.structure import Problem, Structure
from pipeline.models.identified.trial import Trial
from pipeline.plants.simulator import Array
from pipeline.records.record import Record

PROVEN, UNCERTAIN, OPPOSITE, HALVES, SIZE = "proven", "uncertain", "opposite", "halves", "size"
CONTRARY = 2.0  # of a half of the rows, from which it speaks for the other sign
TIMES = 3.0  # the model's answer over the one-step prediction's, or the other way round, where both are certain
USED = 0.25  # of a PV's strongest answer to an MV over its range: a weaker one decides nothing
LOOKED_AT, SEEN = 60, 240  # rows after a step: of the comparison, and in which an answer begins
LEAST_LAGS = 40  # of one-step predictions
BEGINS, HALF, MOST = 0.02, 0.5, 0.9  # of an answer


@dataclass(frozen=True, slots=True)
class Answer:
    """How a PV answers to an MV, in PV/MV: the mean over the rows ``first`` to ``last`` after a step.

    ``model`` is the fitted model's, ``low`` and ``high`` the ends over the models as likely as it; ``direct`` with the
    standard deviation ``sd`` is read from one-step predictions, ``halves`` the same of each half of the rows, in
    standard deviations of its own. None where there are too few rows.
    """

    model: float
    low: float
    high: float
    first: int
    last: int
    direct: float | None = None
    sd: float | None = None
    halves: tuple[float, ...] = ()

    @property
    def verdict(self) -> str:
        """``proven``, or what speaks against it: ``uncertain``, ``opposite``, ``halves``, ``size``."""
        if self.direct is None or self.sd is None or abs(self.direct) < SURE * self.sd or self.low * self.high <= 0:
            return UNCERTAIN
        if self.direct * self.model <= 0:
            return OPPOSITE
        if any(np.sign(self.direct) * t < -CONTRARY for t in self.halves):
            return HALVES
        near = abs(self.model - self.direct) <= SURE * self.sd
        return PROVEN if near or 1 / TIMES <= self.model / self.direct <= TIMES else SIZE

    def times(self, unit: float) -> Answer:
        """The same in another unit."""
        model, low, high = (value * unit for value in (self.model, self.low, self.high))
        direct, sd = (None if value is None else value * unit for value in (self.direct, self.sd))
        return replace(self, model=model, low=low, high=high, direct=direct, sd=sd)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {**asdict(self), "halves": list(self.halves), "verdict": self.verdict}


def answers(
    curves: Array, structure: Structure, fitted: ScaledRecord, size: Array, n_mv: int
) -> tuple[dict[tuple[int, int], Answer], Array]:
    """((output, MV) -> answer, scaled, of the answers that a controller uses; error of one-step predictions (n_y,)).

    ``curves`` (members, n_v, length, n_y) are the answers of the models to steps of ``size`` (n_v,) scaled; the first
    value of input j comes ``structure.delays[j]`` and one rows after the step. ``fitted`` are the rows of the fit, each
    input in its own row.
    """
    unit = curves / size[None, :, None, None]
    middle = np.median(unit, axis=0)
    reach = np.abs(middle[:n_mv]).max(axis=1)  # (n_mv, n_y); scaled, an MV's range is the same for all
    halves = np.array_split(np.arange(len(fitted)), 2)
    parts = [fitted, *(fitted.rows(slice(int(of[0]), int(of[-1]) + 1)) for of in halves)]
    found: dict[tuple[int, int], Answer] = {}
    surprise = np.full(curves.shape[3], np.inf)
    for i in range(curves.shape[3]):
        used = [j for j in range(n_mv) if reach[j, i] >= USED * reach[:, i].max()]
        places = {j: _place(middle[j, :, i], 1 + structure.delays[j] - int(structure.same_row)) for j in used}
        longest = max([LEAST_LAGS, *(last for *_, last in places.values())])
        direct = [DirectModel.of(part.y[:, i], part.v, part.run, longest) for part in parts]
        surprise[i] = np.inf if direct[0] is None else direct[0].sd
        for j, (at, first, last) in places.items():
            found[i, j] = _answer(unit[:, j, at, i].mean(axis=1), direct, j, first, last)
    return found, surprise


def _place(curve: Array, late: int) -> tuple[slice, int, int]:
    """(points of a curve, their first row, their last row) in which an answer goes from HALF to MOST of its largest.

    ``late`` is the row of the first point. Rows before the first that a past MV can move count as that one.
    """
    size = np.abs(curve)
    begins = int((size >= BEGINS * size[:SEEN].max()).argmax())
    size = size[: max(LOOKED_AT, 2 * begins)]
    first, last = (int((size >= share * size.max()).argmax()) for share in (HALF, MOST))
    last = max(first, last)
    return slice(first, last + 1), max(first + late, 1), max(last + late, 1)


def _answer(of_models: Array, direct: Sequence[DirectModel | None], j: int, first: int, last: int) -> Answer:
    model, low, high = (float(f(of_models)) for f in (np.median, np.min, np.max))
    whole, *halves = (None if model is None else model.answer(j, first, last) for model in direct)
    if whole is None:
        return Answer(model, low, high, first, last)
    known = tuple(value / sd for value, sd in (half for half in halves if half is not None))
    return Answer(model, low, high, first, last, whole[0], whole[1], known)


def foreseen(problem: Problem, chosen: Trial, names: Sequence[str], y_scale: Array) -> dict[str, dict[str, float]]:
    """PV -> what the inputs foresee of it over rows that no fit saw: one-step errors [PV] with and without them.

    ``with_inputs`` and ``without`` are rms errors of two ARX alike, one of all signals, one of the PVs alone; ``model``
    is that of the model with its noise, ``rows`` their number, and ``nats`` the log-likelihood that the inputs gain.
    Where the MVs move by the PVs alone, or by nothing that has to do with them, they gain none.
    """
    parts, n_y = [], problem.data.y.shape[1]
    for k, fold in enumerate(problem.folds):
        rows = problem.part(chosen.structure, slice(None))
        alone = replace(rows, v=rows.v[:, :0])
        model = chosen.of_fold(k)[0].model
        errors = innovations(model, problem.held(chosen.structure, k))
        both = [high_order_arx(of.rows(fold.train)).one_step_errors(of.rows(fold.held)) for of in (rows, alone)]
        parts.append([np.full((1, n_y), np.inf) if errors is None else errors, *both])
    found = [np.concatenate(of) for of in zip(*parts, strict=True)]
    model_sd, with_sd, without_sd = (np.sqrt(np.mean(e**2, axis=0)) for e in found)
    n = len(found[2])
    return {
        name: {
            "model": float(model_sd[i] * y_scale[i]),
            "with_inputs": float(with_sd[i] * y_scale[i]),
            "without": float(without_sd[i] * y_scale[i]),
            "rows": n,
            "nats": float(n * np.log(without_sd[i] / with_sd[i])),
        }
        for i, name in enumerate(names)
    }


def proof_figures(
    found: Mapping[tuple[int, int], Answer],
    record: Record,
    scales: Scales,
    free_runs: Sequence[Mapping[str, Mapping[str, Any]]],
    noise: Array,
) -> dict[str, Any]:
    """``answers``: PV -> MV -> ``Answer`` in PV/MV, with the share of the MV's moves that the PV's past explains.

    ``free_run``: PV -> what the model misses over rows that its fit never saw, and how far the PV moved there, both
    beyond the ``noise`` (n_y,), in the PV's unit; of ``free_runs``, one a fold, together.
    """
    table: dict[str, Any] = {s.name: {} for s in record.pv_signals[: len(scales.y_scale)]}
    for (i, j), answer in found.items():
        pv, mv, unit = record.pv_signals[i], record.mv_signals[j], scales.y_scale[i] / scales.v_scale[j]
        share = follows(record.mv[:, j], record.pv[:, i], record.run)
        table[pv.name][mv.name] = {**answer.times(float(unit)).to_dict(), "follows": share}
    runs = {}
    for i, name in enumerate(table):
        missed, motion = (
            float(np.sqrt(max(np.mean([of[name][figure] ** 2 for of in free_runs]) - noise[i] ** 2, 0.0)))
            for figure in ("free_run_rmse", "held_sd")
        )
        runs[name] = {"missed": missed if np.isfinite(missed) else None, "motion": motion}
    return {"answers": table, "free_run": runs}
