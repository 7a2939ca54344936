"""Whether the record proves the model that was fitted to it: its answers beside one-step predictions, its free run.

All tests of an own plant run on models of one record. Where that record shows the controller more than the plant, all
of them are wrong together, and the tests are met. So the answers of the model to its MVs are compared with those that
``DirectModel`` reads from the same rows, and with those of each half of them. Where a gain turns its sign inside the
range, or fades, they are compared region by region.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from loopwright.pipeline.config.known import CONTRADICTION_SDS
from loopwright.pipeline.historian.answers import DirectModel
from loopwright.pipeline.historian.feedback import follows
from loopwright.pipeline.models.identified.fresh_errors import rms
from loopwright.pipeline.models.identified.innovations import innovations
from loopwright.pipeline.models.identified.linear_start import high_order_arx
from loopwright.pipeline.models.identified.parameter_uncertainty import weighted_interval
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.models.identified.structure import (
    SMALL_CELL_ANSWER,
    CandidateFits,
    Cells,
    Problem,
    Structure,
    alike,
    pieces,
)
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record

PROVEN, UNCERTAIN, OPPOSITE, HALVES, SIZE = "proven", "uncertain", "opposite", "halves", "size"
AGAINST = (OPPOSITE, HALVES)  # verdicts on a region that speak for the other sign
TURNS, FADES = "turns", "fades"  # what holds by its regions
CONTRARY = 2.0  # of a half of the rows, from which it speaks for the other sign
ANSWER_RATIO = 3.0  # the model's answer over the one-step prediction's, or the other way round, where both are certain
USED = 0.25  # of a PV's strongest answer to an MV over its range: a weaker one decides nothing
COMPARED_ROWS, BEGINNING_ROWS = 60, 240  # rows after a step: of the comparison, and in which an answer begins
LEAST_LAGS = 40  # of one-step predictions
ANSWER_BEGUN, HALF_ANSWER, MOST_ANSWER = 0.02, 0.5, 0.9  # of an answer


@dataclass(frozen=True, slots=True)
class ProvenAnswer:
    """How a PV answers to an MV, in PV/MV: the mean over the rows ``first`` to ``last`` after a step.

    ``model`` is the fitted model's, ``low`` and ``high`` the ends over the models as likely as it; ``direct`` with the
    standard deviation ``sd`` is read from one-step predictions, ``halves`` the same of each half of the rows, in
    standard deviations of its own. None where there are too few rows. ``regions`` of the MV's range, from low to high,
    are there where the models' gain turns its sign or fades within it.
    """

    model: float
    low: float
    high: float
    first: int
    last: int
    direct: float | None = None
    sd: float | None = None
    halves: tuple[float, ...] = ()
    regions: tuple[Region, ...] = ()

    @property
    def verdict(self) -> str:
        """``proven``, or what speaks against it: ``uncertain``, ``opposite``, ``halves``, ``size``.

        ``turns`` or ``fades`` where something speaks against the mean answer, but in no region against that of the
        region: it is proven or uncertain there. A proven mean does not outweigh a region of the other sign.
        """
        told = self._told
        against = [r.answer.verdict for r in told if r.answer.verdict in AGAINST]
        if self._of_all == PROVEN:
            return against[0] if against else PROVEN
        if not told or any(r.answer.verdict not in {PROVEN, UNCERTAIN} for r in told):
            return self._of_all
        return TURNS if min(r.answer.model for r in told) < 0 < max(r.answer.model for r in told) else FADES

    @property
    def turns(self) -> bool:
        """Whether the gain turns its sign within the range, or a region speaks for the other sign.

        A straight model has one gain: it shows no turn, and must not stand in for a model that does.
        """
        told = self._told
        return len({r.answer.model > 0 for r in told}) > 1 or any(r.answer.verdict in AGAINST for r in told)

    @property
    def _told(self) -> list[Region]:
        return [region for region in self.regions if not region.small]

    @property
    def _of_all(self) -> str:
        if (
            self.direct is None
            or self.sd is None
            or abs(self.direct) < CONTRADICTION_SDS * self.sd
            or self.low * self.high <= 0
        ):
            return UNCERTAIN
        if self.direct * self.model <= 0:
            return OPPOSITE
        if any(np.sign(self.direct) * t < -CONTRARY for t in self.halves):
            return HALVES
        near = abs(self.model - self.direct) <= CONTRADICTION_SDS * self.sd
        return PROVEN if near or 1 / ANSWER_RATIO <= self.model / self.direct <= ANSWER_RATIO else SIZE

    def times(self, unit: float, scale: float = 1.0, center: float = 0.0) -> ProvenAnswer:
        """The same in another unit; values of the MV times ``scale`` plus ``center``."""
        model, low, high = (value * unit for value in (self.model, self.low, self.high))
        direct, sd = (None if value is None else value * unit for value in (self.direct, self.sd))
        regions = tuple(
            Region(r.start * scale + center, r.end * scale + center, r.small, r.answer.times(unit))
            for r in self.regions
        )
        return replace(self, model=model, low=low, high=high, direct=direct, sd=sd, regions=regions)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        found = {**asdict(self), "halves": list(self.halves), "verdict": self.verdict, "turns": self.turns}
        found["regions"] = [
            {"from": r.start, "to": r.end, "small": r.small, **r.answer.to_dict()} for r in self.regions
        ]
        return {name: value for name, value in found.items() if name != "regions" or value}


@dataclass(frozen=True, slots=True)
class Region:
    """The answer while the MV moves between two values; ``small`` beside other regions it decides nothing."""

    start: float
    end: float
    small: bool
    answer: ProvenAnswer


def proven_answers(
    curves: Array,
    structure: Structure,
    fitted: ScaledRecord,
    size: Array,
    n_mv: int,
    cells: Cells | None = None,
    weights: Array | None = None,
) -> tuple[dict[tuple[int, int], ProvenAnswer], Array]:
    """((output, MV) -> answer, scaled, of the answers that a controller uses; error of one-step predictions (n_y,)).

    ``curves`` (members, n_v, length, n_y) are the answers of the models to steps of ``size`` (n_v,) scaled; the first
    value of input j comes ``structure.delays[j]`` and one rows after the step. ``fitted`` are the rows of the fit, each
    input in its own row. ``cells`` are the same models' answers in cells of the MVs' ranges, for models whose gain
    changes; ``weights`` (members,) how likely they are, None: all alike.
    """
    unit = curves / size[None, :, None, None]
    weights = np.ones(len(unit)) if weights is None else weights
    middle = np.median(unit, axis=0)
    reach = np.abs(middle[:n_mv]).max(axis=1)  # (n_mv, n_y); scaled, an MV's range is the same for all
    ways = (
        [] if cells is None else [weighted_interval(of, weights)[1] for of in cells.curves]
    )  # (cells, length, n_y) of each MV
    if ways:
        reach = np.maximum(reach, [np.abs(of).max(axis=(0, 1)) for of in ways])
    halves = np.array_split(np.arange(len(fitted)), 2)
    parts = [fitted, *(fitted.rows(slice(int(of[0]), int(of[-1]) + 1)) for of in halves)]
    found: dict[tuple[int, int], ProvenAnswer] = {}
    surprise = np.full(curves.shape[3], np.inf)
    for i in range(curves.shape[3]):
        used = [j for j in range(n_mv) if reach[j, i] >= USED * reach[:, i].max()]
        late = {j: 1 + structure.delays[j] - int(structure.same_row) for j in used}
        places = {j: _place(middle[j, :, i], late[j]) for j in used}
        longest = max([LEAST_LAGS, *(last for *_, last in places.values())])
        direct = [DirectModel.of(part.y[:, i], part.v, part.run, longest, part.read(i)) for part in parts]
        surprise[i] = np.inf if direct[0] is None else direct[0].sd
        for j, (at, first, last) in places.items():
            found[i, j] = _answer(unit[:, j, at, i].mean(axis=1), weights, direct, j, first, last)
        if cells is not None:
            of_ways = {j: (cells.edges[j], cells.curves[j][..., i], ways[j][..., i], late[j]) for j in used}
            for j, regions in _regions(of_ways, weights, parts, i).items():
                found[i, j] = replace(found[i, j], regions=regions)
    return found, surprise


def _regions(
    ways: Mapping[int, tuple[Array, Array, Array, int]], weights: Array, parts: Sequence[ScaledRecord], i: int
) -> dict[int, tuple[Region, ...]]:
    """MV -> its regions, of those over which the gain of output i turns its sign or fades.

    ``ways``: MV -> (edges of its cells, the models' curves over them (members, cells, length), their middle, row of the
    first point). The one-step predictions of the rows ``parts`` have a gain for each region.
    """
    cut = {}
    for j, (edges, curves, middle, late) in ways.items():
        strongest = int(np.abs(middle).max(axis=1).argmax())
        at, first, last = _place(middle[strongest], late)
        of_cells = curves[:, :, at].mean(axis=2)
        if groups := alike(weighted_interval(of_cells, weights)[1]):
            cut[j] = (groups, edges, of_cells, first, last)
    if not cut:
        return {}
    longest = max([LEAST_LAGS, *(last for *_, last in cut.values())])
    models, columns = [], dict[int, int]()
    for part in parts:
        inputs: list[Array] = []
        for j, values in enumerate(part.v.T):
            columns[j] = sum(of.shape[1] for of in inputs)
            knots = [cut[j][1][group.start] for group in cut[j][0][1:]] if j in cut else []
            inputs.append(pieces(values, knots))
        models.append(DirectModel.of(part.y[:, i], np.hstack(inputs), part.run, longest, part.read(i)))
    found = {}
    for j, (groups, edges, of_cells, first, last) in cut.items():
        width, strongest = np.diff(edges), np.abs(weighted_interval(of_cells, weights)[1]).max()
        regions = []
        for k, of in enumerate(groups):
            mean = of_cells[:, of] @ width[of] / width[of].sum()
            answer = _answer(mean, weights, models, columns[j] + k, first, last)
            # What the model finds small is so if one-step predictions are not certain that it is not.
            sure = (
                0.0
                if answer.direct is None or answer.sd is None
                else abs(answer.direct) - CONTRADICTION_SDS * answer.sd
            )
            small = (
                abs(answer.model) < SMALL_CELL_ANSWER * strongest
                and sure < ANSWER_RATIO * SMALL_CELL_ANSWER * strongest
            )
            regions.append(Region(float(edges[of.start]), float(edges[of.stop]), bool(small), answer))
        found[j] = tuple(regions)
    return found


def _place(curve: Array, late: int) -> tuple[slice, int, int]:
    """(points of a curve, first row, last row) in which an answer goes from HALF_ANSWER to MOST_ANSWER of its largest.

    ``late`` is the row of the first point. Rows before the first that a past MV can move count as that one.
    """
    size = np.abs(curve)
    begins = int((size >= ANSWER_BEGUN * size[:BEGINNING_ROWS].max()).argmax())
    size = size[: max(COMPARED_ROWS, 2 * begins)]
    first, last = (int((size >= share * size.max()).argmax()) for share in (HALF_ANSWER, MOST_ANSWER))
    last = max(first, last)
    return slice(first, last + 1), max(first + late, 1), max(last + late, 1)


def _answer(
    of_models: Array, weights: Array, direct: Sequence[DirectModel | None], j: int, first: int, last: int
) -> ProvenAnswer:
    low, model, high = map(float, weighted_interval(of_models, weights))
    whole, *halves = (None if model is None else model.answer(j, first, last) for model in direct)
    if whole is None:
        return ProvenAnswer(model, low, high, first, last)
    known = tuple(value / sd for value, sd in (half for half in halves if half is not None))
    return ProvenAnswer(model, low, high, first, last, whole[0], whole[1], known)


def foreseen(
    problem: Problem, chosen: CandidateFits, names: Sequence[str], y_scale: Array
) -> dict[str, dict[str, float]]:
    """PV -> what the inputs foresee of it over rows that no fit saw: one-step errors [PV] with and without them.

    ``with_inputs`` and ``without`` are rms errors of two ARX alike, one of all signals, one of the PVs alone; ``model``
    is that of the model with its noise, ``rows`` their number, and ``nats`` the log-likelihood that the inputs gain.
    Where the MVs move by the PVs alone, or by nothing that has to do with them, they gain none.
    """
    problem = problem.in_a_loop
    parts, n_y = [], problem.data.y.shape[1]
    for k, fold in enumerate(problem.folds):
        rows = problem.part(chosen.structure, slice(None))
        alone = replace(rows, v=rows.v[:, :0])
        model = chosen.of_fold(k)[0].model
        errors = innovations(model, problem.held(chosen.structure, k))
        both = [high_order_arx(of.rows(fold.train)).one_step_errors(of.rows(fold.held)) for of in (rows, alone)]
        parts.append([np.full((1, n_y), np.inf) if errors is None else errors, *both])
    found = [np.concatenate(of) for of in zip(*parts, strict=True)]
    model_sd, with_sd, without_sd = map(rms, found)
    counts = np.isfinite(found[2]).sum(axis=0).tolist()
    return {
        name: {
            "model": float(model_sd[i] * y_scale[i]),
            "with_inputs": float(with_sd[i] * y_scale[i]),
            "without": float(without_sd[i] * y_scale[i]),
            "rows": counts[i],
            "nats": float(counts[i] * np.log(without_sd[i] / with_sd[i])),
        }
        for i, name in enumerate(names)
    }


def proof_figures(
    found: Mapping[tuple[int, int], ProvenAnswer],
    record: Record,
    scales: Scales,
    free_runs: Sequence[Mapping[str, Mapping[str, Any]]],
    noise: Array,
) -> dict[str, Any]:
    """``proven_answers``: PV -> MV -> ``ProvenAnswer`` in PV/MV, and what of the MV the PV's past explains.

    ``free_run``: PV -> what the model misses over rows that its fit never saw, and how far the PV moved there, both
    beyond the ``noise`` (n_y,), in the PV's unit; of ``free_runs``, one a fold, together. ``share`` is the free run's
    error over the PV's deviation, noise and all: a model without the inputs has 1.
    """
    table: dict[str, Any] = {s.name: {} for s in record.pv_signals[: len(scales.y_scale)]}
    for (i, j), answer in found.items():
        pv, mv, unit = record.pv_signals[i], record.mv_signals[j], scales.y_scale[i] / scales.v_scale[j]
        share = follows(record.mv[:, j], record.pv[:, i], record.run)
        told = answer.times(float(unit), float(scales.v_scale[j]), float(scales.v_center[j]))
        table[pv.name][mv.name] = {**told.to_dict(), "follows": share}
    runs = {}
    for i, name in enumerate(table):
        error, moved = (
            float(np.sqrt(np.mean([of[name][figure] ** 2 for of in free_runs])))
            for figure in ("free_run_rmse", "held_sd")
        )
        missed, motion = (float(np.sqrt(max(value**2 - noise[i] ** 2, 0.0))) for value in (error, moved))
        known = bool(np.isfinite(missed) and moved > 0)
        runs[name] = {
            "missed": missed if np.isfinite(missed) else None,
            "motion": motion,
            "share": error / moved if known else None,
        }
    return {"answers": table, "free_run": runs}
