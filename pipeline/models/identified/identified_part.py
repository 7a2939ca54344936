"""How an identified model is learnt: the search over structures, one member of the ensemble, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from loopwright.pipeline.config.known import NONE
from loopwright.pipeline.historian.analyser_readings import Aligned
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.identified.candidates import on_all_rows, within_limits
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.fresh_errors import rms
from loopwright.pipeline.models.identified.gain_trend import GainTrend, gain_trends
from loopwright.pipeline.models.identified.identified import Identified, assemble_model, noise_of
from loopwright.pipeline.models.identified.innovations import Innovations, innovations, load_moves, noise_of_filter
from loopwright.pipeline.models.identified.knowledge import ModelDelay, known_figures
from loopwright.pipeline.models.identified.model_validation import (
    ProvenAnswer,
    foreseen,
    proof_figures,
    proven_answers,
)
from loopwright.pipeline.models.identified.network_search import UNITS
from loopwright.pipeline.models.identified.open_answers import sign_margins
from loopwright.pipeline.models.identified.output_error import Fitted, fit_starts, residuals
from loopwright.pipeline.models.identified.parameter_uncertainty import colour_of, doubt_of, drawn
from loopwright.pipeline.models.identified.residual_tests import residual_figures
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.models.identified.steady_states import stability_figures
from loopwright.pipeline.models.identified.structure import Cells, Problem, Structure
from loopwright.pipeline.models.identified.structure_search import Searched, Selection, StructureSearch
from loopwright.pipeline.models.identified.verdict import (
    STEP_SDS,
    answer_figures,
    free_run_figures,
    gain_figures,
    gains,
    response_curves,
    response_figures,
    structure_figures,
)
from loopwright.pipeline.models.part import Learnt, Part, Source
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record, levels_of, only_between
from loopwright.serving.manifest import Signal

Figures = Mapping[str, Mapping[str, Any]]

OUTSIDE_SHARE = 0.02
"""Share of held-out rows outside the range of the training rows above which a warning says so."""

LIKELY_SDS = 2.0
"""Standard deviations of an open answer that a controller of several loops must stand."""

LOAD_ROWS = 8_000
"""Rows at most whose loads go with the model."""

INDEPENDENT_PARTS = 40
"""Parts of the held-out rows that are independent, for all that counts: neighbouring rows of a run err alike."""

BAND_DRAWS = 12
"""Models drawn from the covariance of the parameters, for the bands."""

NEAR_FINALIST = 1.05
"""Held-out error, relative to the chosen one's, up to which a finalist's fits count for the bands."""

NEAR_BY_ROWS = 1.002
"""The same of one-step errors, of which noise is nearly all."""


@dataclass(frozen=True, kw_only=True)
class IdentifiedPart(Part):
    """A linear or nonlinear state-space model of the process variables, its structure chosen by held-out rows.

    The outputs are the ``controlled`` variables, or all ``measured`` process variables: a second one tells of states
    that the controlled one hides. The inputs are all MVs and measured disturbances. ``member`` numbers the models of
    an ensemble: 0 is fitted to all rows, 1 and 2 to the rows of one fold each, with other seeds. ``orders`` are the
    least and the most states tried (None: 2 to 8, and two more for each further output); beside them, ``lagged``
    offers past outputs and inputs as states, up to 18 of them. ``units`` are the numbers of tanh units tried, none
    for linear models only. ``correction`` is the share of the output's error that
    each sample of a training run takes back, None: 0, or .05 where that does better in plain free runs; a number
    given here is that of the held-out runs too, as unstable plants need. ``minutes`` is the budget of the search on
    one core (None: 2, and 2 more for each further output), counted in nominal work so that results are reproducible;
    the best so far is kept; where models with their noise are searched beside others, each search has as many.
    ``rows`` is the most rows that are fitted, of longer records the stretches in which the inputs move most; the more
    rows, the fewer candidates the budget carries.

    Where the MVs follow the outputs, and no ``correction`` is given, models with their noise are fitted and judged by
    one-step errors in place of free runs; else beside them, where the free runs miss more than noise, and errors some
    rows ahead decide.
    """

    model: ClassVar[type[Model]] = Identified
    member: int = 0
    outputs: Literal["controlled", "measured"] = "controlled"
    orders: tuple[int, int] | None = None
    lagged: bool = True
    units: tuple[int, ...] = UNITS
    correction: float | None = None
    minutes: float | None = None
    rows: int = 24_000

    def __post_init__(self) -> None:
        if self.member not in (0, 1, 2):
            raise ValueError(f"member is {self.member}; an ensemble has the members 0, 1 and 2")
        if self.orders is not None and not 1 <= self.orders[0] <= self.orders[1]:
            raise ValueError(f"orders are {list(self.orders)}; give the least and the most, e.g. [2, 8]")
        if any(n < 1 for n in self.units):
            raise ValueError(f"units are {list(self.units)}; each must be at least 1, and [] tries linear models only")
        if self.correction is not None and not 0 <= self.correction <= 1:
            raise ValueError(f"correction is {self.correction:g}; it must lie between 0 and 1")
        if self.minutes is not None and not self.minutes > 0:
            raise ValueError(f"minutes is {self.minutes:g}; it must be positive")
        if self.rows < 100:
            raise ValueError(f"rows is {self.rows}; it must be at least 100")

    def groundwork(self) -> StructureSearch:
        """The search for the structure, which all members share."""
        return StructureSearch(
            self.model.kind,
            self.outputs == "measured",
            self.orders,
            self.lagged,
            tuple(self.units),
            self.correction,
            self.minutes,
            self.rows,
        )

    def learn(self, source: Source) -> Learnt:
        """Search, fit the member, and report on the class of model over rows that its fold's fits never saw."""
        searched = source.result(self.groundwork())
        problem, selection, scales = searched.problem, searched.selection, searched.scales
        n_y, n_mv = len(scales.y_scale), len(source.signals.mv)
        structure = selection.chosen.structure
        fitted = within_limits(problem, structure, _member(problem, selection, self.member))
        noise, found, whole = _residuals(problem, structure, fitted.model)
        pvs, inputs = source.signals.pv[:n_y], (*source.signals.mv, *source.signals.dv)
        fits, weights = _bands(selection)
        drawn_ones = _as_likely(problem, structure, fitted.model, source.seed)
        bands, weights = [*fits, *drawn_ones], np.r_[weights, np.ones(len(drawn_ones))]
        # The gains belong to the middle of the whole record, also where only a part of its rows is fitted.
        record = Aligned.of(source.data(self.model.kind), n_y).record
        measured = searched.disturbances
        rows, names = measured.smoothed(ScaledRecord.of(record, scales)), [s.name for s in pvs]
        runs, predictions = free_run_figures(problem, selection.chosen, scales, names)
        curves = response_curves(bands, rows)
        cells = Cells.of(bands, rows, n_mv, curves.shape[2]) if structure.n_hidden else None
        size = STEP_SDS * rows.v.std(axis=0)
        proven = proven_answers(curves, structure, problem.data, size, n_mv, cells, weights)
        n_cv = min(len(source.signals.sp), n_y)
        unit = np.median(curves, axis=0) / size[:, None, None]
        margins = sign_margins(proven[0], unit, structure, n_cv, n_mv, LIKELY_SDS)
        doubt, colour = doubt_of(curves, n_mv), colour_of(found)
        # Where no dead time but the model's explains the record, nothing is known of others: the curves tell.
        compared = any(least < most for least, most in selection.dead_times)
        dead = np.array([_later(selection, n_mv)]) if compared else doubt.dead
        open_to = {"gain_sd": doubt.gain, "pace_sd": doubt.pace, "dead_sd": dead}
        disturbances = {"dv_noise": measured.noise, "dv_change": measured.change}
        loads = {"load_moves": _load_moves(fitted.model, whole)}
        known = {"noise": noise, "colour": colour, **loads, **disturbances, **open_to}
        model = assemble_model(
            fitted.model.plant, structure.delays, scales, problem.data, known, n_mv, source.seed, searched.late
        )
        for name, sd in zip(runs, noise * scales.y_scale, strict=True):
            runs[name]["noise_sd"] = float(sd)
        for name, phi in zip(runs, colour, strict=True):
            runs[name]["noise_colour"] = float(phi)
        visited = _visited(fitted.model, whole, structure.correction)
        warnings = [
            f"{name}: {runs[name]['outside_training']:.0%} of the held-out rows leave the range of the training rows; "
            "their error says little of the model elsewhere"
            for name in (s.name for s in pvs)
            if runs[name]["outside_training"] > OUTSIDE_SHARE
        ]
        gain_table = gain_figures(bands, rows, scales, pvs, inputs)
        for pair in problem.known.pairs:
            if pair.input in problem.known.silent:
                gain_table[pvs[pair.output].name][inputs[pair.input].name]["sign"] = NONE
        for pv, row in zip(pvs, _trends(problem, selection), strict=False):  # no row where no filter follows
            for mv, trend in zip(source.signals.mv, row, strict=True):
                of = gain_table[pv.name][mv.name]
                of["trend"] = trend._asdict() | {"certain": trend.certain, "at_end": trend.at_end * of["gain"]}
        answers = answer_figures(fitted.model.plant, structure.delays, problem.data, pvs, inputs, searched.late)
        delays = _delays(selection, inputs, answers["first_answers"])
        said = {"known": known_figures(searched.known, gain_table, record, delays)} if searched.known else {}
        metrics: dict[str, Any] = {
            "free_run_rmse": runs[pvs[0].name]["free_run_rmse"],
            "n_train": sum(len(s) for s in whole),
            "parameters": int(np.count_nonzero(fitted.model.free())),
            "member": self.member,
            "outputs": runs,
            **({"late": dict(zip(names, searched.late, strict=True))} if any(searched.late) else {}),
            "structure": structure_figures(selection, _unseen(source.signals.mv, rows, scales)),
            "gains": gain_table,
            **answers,
            "proof": _proof(searched, record, proven, runs, noise * scales.y_scale)
            | ({"sign_margin": {names[i]: margin for i, margin in margins.items()}} if margins else {})
            | said
            | ({"held": dict(source.held)} if source.held else {}),
            "open": {name: values.tolist() for name, values in open_to.items()} | _likely(problem, selection, inputs),
            "spectral_radius": gains(fitted.model.plant, problem.data)[2],
            "stability": stability_figures(fitted.model.plant, visited, [s.v for s in whole]),
            "warnings": warnings,
            "disturbances": {
                s.name: {"noise_sd": float(sd)}
                for s, sd in zip(source.signals.dv, measured.noise * scales.v_scale[n_mv:], strict=True)
            },
            "residual": residual_figures(found, [s.v for s in whole], [s.name for s in pvs]),
            "step_responses": response_figures(curves, structure.delays, rows, scales, pvs, inputs, searched.late),
            "candidates_tried": _table(selection),
        }
        time_s: Array = source.signals.period_s * np.arange(len(predictions["measured"]), dtype=np.float64)
        return Learnt(model, metrics, predictions={"time_s": time_s, **predictions})


def _proof(
    searched: Searched,
    record: Record,
    found: tuple[dict[tuple[int, int], ProvenAnswer], Array],
    runs: Figures,
    noise: Array,
) -> dict[str, Any]:
    """Whether the record proves the model; ``found`` of ``proven_answers``, ``runs`` over a fold's held-out rows.

    noise (n_y,).
    """
    problem, chosen, scales = searched.problem, searched.selection.chosen, searched.scales
    second = [free_run_figures(problem, chosen, scales, list(runs), fold=1)[0]] if 1 in chosen.folds else []
    # What a wrong model misses at every row is no noise: the plant's own past foresees more of it.
    figures = proof_figures(found[0], record, scales, [runs, *second], np.minimum(noise, found[1] * scales.y_scale))
    if searched.selection.innovations is None:
        return figures
    # A free run holds the loads that nobody measured, and says nothing of the model.
    return {"answers": figures["answers"], "one_step": foreseen(problem, chosen, list(runs), scales.y_scale)}


def _trends(problem: Problem, selection: Selection) -> Sequence[Sequence[GainTrend]]:
    """The trend of each output and MV by the linear model: a network takes a gain that fades for a curve."""
    linear = selection.linear
    return gain_trends(linear.of_fold(0)[0].model, problem.whole(linear.structure), problem.n_mv)


def _likely(problem: Problem, selection: Selection, inputs: Sequence[Signal]) -> dict[str, Any]:
    """The dead time of each MV [periods] in the model, and the least and the most that explain the record alike.

    Those are left out of which a dead time is known, or that they move nothing.
    """
    stated = {p.input for p in problem.known.pairs if p.delays is not None} | set(problem.known.silent)
    rows = zip(inputs[: problem.n_mv], selection.chosen.structure.delays, selection.dead_times, strict=False)
    found = {s.name: [int(d), *map(int, ends)] for j, (s, d, ends) in enumerate(rows) if j not in stated}
    return {"dead_times": found} if found else {}


def _delays(
    selection: Selection, inputs: Sequence[Signal], first: Mapping[str, Mapping[str, int | None]]
) -> dict[str, ModelDelay]:
    """The delay of each input in the model, those that are as likely, and the ``first`` answers, PV -> input."""
    likely: Sequence[tuple[int, int] | None] = selection.dead_times or [None] * len(inputs)
    of_model = zip(inputs, selection.chosen.structure.delays, likely, strict=True)
    return {
        s.name: ModelDelay(
            int(d), ends and (int(ends[0]), int(ends[1])), {pv: answers[s.name] for pv, answers in first.items()}
        )
        for s, d, ends in of_model
    }


def _later(selection: Selection, n_mv: int) -> float:
    """Standard deviation [periods] of the MVs' dead times: half the way to the latest one that is as likely.

    One that is less makes no loop swing: fast plants of the tests stand for it.
    """
    rows = zip(selection.chosen.structure.delays[:n_mv], selection.dead_times, strict=False)
    return max((max(most - d, 0) / 2 for d, (_, most) in rows), default=0.0)


def _unseen(mvs: Sequence[Signal], rows: ScaledRecord, scales: Scales) -> list[str]:
    """Clauses on what MVs of a few values leave unseen."""
    values = (rows.v * scales.v_scale + scales.v_center).T
    levels = [levels_of(of) for of in values[: len(mvs)]]
    return [only_between(s.name, found, s.unit) for s, found in zip(mvs, levels, strict=True) if found]


def _member(problem: Problem, selection: Selection, member: int) -> Fitted:
    """The first fold's best fit gone on over all rows; the second fold's; the first fold's next one."""
    chosen = selection.chosen
    first, second = (chosen.of_fold(k) for k in range(2))
    if member == 0 or not second:
        return on_all_rows(problem, chosen.structure, first[0])
    if member == 1:
        return second[0]
    others = [f for f in first[1:] if np.isfinite(f.held_out)]
    return others[0] if others else first[0]


def _residuals(problem: Problem, structure: Structure, model: Dynamics) -> tuple[Array, list[Array], list[Stretch]]:
    """(scaled noise (n_y,), free-run residuals, stretches) over all rows."""
    whole = problem.whole(structure)
    starts = fit_starts(model, whole, structure.correction)
    found = residuals(model, starts, whole, structure.correction)
    if found is None:
        starts = fit_starts(model, whole, 1.0)
        found = residuals(model, starts, whole, 1.0) or [s.y for s in whole]
    elif isinstance(model, Innovations):
        return noise_of_filter(model, np.concatenate(found)), found, whole
    return noise_of(found), found, whole


def _load_moves(model: Dynamics, whole: Sequence[Stretch]) -> Array:
    """Changes (n, n_y) of the loads from row to row, scaled; none of a model without loads."""
    if not isinstance(model, Innovations):
        return np.empty((0, whole[0].y.shape[1]))
    return load_moves(model, whole)[:LOAD_ROWS]


def _visited(model: Dynamics, data: Sequence[Stretch], correction: float) -> list[Array]:
    """The plant's states in the run over each stretch; of one that explodes, the outputs, hidden states at zero."""
    n_x = model.plant.n_x
    runs = [
        model.free_run(x, part, correction) for x, part in zip(fit_starts(model, data, correction), data, strict=True)
    ]
    return [
        np.pad(part.y, ((0, 0), (0, n_x - part.y.shape[1]))) if run is None else run[1][:, :n_x]
        for run, part in zip(runs, data, strict=True)
    ]


def _bands(selection: Selection) -> tuple[list[Dynamics], Array]:
    """The fits that show how sure the figures are: those of the chosen structure, and of finalists as good as it.

    And how likely each is (fits,): by its held-out error over the least of the same rows, as ``INDEPENDENT_PARTS``
    independent ones tell it.
    """
    chosen = selection.chosen
    same = [
        t
        for t in selection.finalists
        if t.structure.delays == chosen.structure.delays
        and t.against <= chosen.against
        and (t.structure.n_hidden > 0) == (chosen.structure.n_hidden > 0)
        and t.error <= (NEAR_FINALIST if selection.innovations is None else NEAR_BY_ROWS) * chosen.error
    ]
    fits = [
        (fold, f)
        for t in (chosen, *(t for t in same if t is not chosen))
        for (fold, _), f in t.fits.items()
        if np.isfinite(f.held_out)
    ]
    if not fits:
        return [chosen.of_fold(0)[0].model.plant], np.ones(1)
    least = {k: min(f.held_out for fold, f in fits if fold == k) for k, _ in fits}
    weights = np.array([(least[k] / f.held_out) ** INDEPENDENT_PARTS if f.held_out > 0 else 1.0 for k, f in fits])
    return [f.model.plant for _, f in fits], weights


def _as_likely(problem: Problem, structure: Structure, model: Dynamics, seed: int) -> list[Dynamics]:
    """Models that the record's noise could have given instead of this one."""
    whole = problem.whole(structure)
    errors = innovations(model, whole) if isinstance(model, Innovations) else None
    if isinstance(model, Innovations) and errors is not None:
        size = rms(errors)
        near, parts = model.rescaled(size), [replace(s, y=s.y / size) for s in whole]
        return [
            of.rescaled(1 / size).plant for of in drawn(near, fit_starts(near, parts), parts, BAND_DRAWS, seed=seed)
        ]
    starts = fit_starts(model, whole, structure.correction)
    return drawn(model, starts, whole, BAND_DRAWS, structure.correction, seed)


def _table(selection: Selection) -> list[dict[str, Any]]:
    return [
        {
            "start": t.structure.start,
            "order": t.structure.order,
            "delays": list(t.structure.delays),
            "hidden": t.structure.n_hidden,
            "ridge": t.structure.ridge,
            "correction": t.structure.correction,
            "error": t.error if np.isfinite(t.error) else None,
            "spread": t.spread if np.isfinite(t.spread) else None,
            "chosen": t is selection.chosen,
        }
        for t in selection.finalists
    ]
