"""How an identified model is learnt: the search over structures, one member of the ensemble, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from pipeline.models.base import Model
from pipeline.models.identified.assembly import assembled, noise_of
from pipeline.models.identified.candidates import Budget, Training
from pipeline.models.identified.dynamics import Dynamics, Stretch
from pipeline.models.identified.identified import Identified
from pipeline.models.identified.output_error import Fitted, fit_starts, residuals
from pipeline.models.identified.scaled_record import ScaledRecord, Scales, folds, informative
from pipeline.models.identified.selection import UNITS, Selection, select
from pipeline.models.identified.verdict import (
    free_run_figures,
    gain_figures,
    gains,
    residual_figures,
    response_figures,
    structure_figures,
)
from pipeline.models.part import Learnt, Part, Source
from pipeline.plants.simulator import Array
from pipeline.records.record import Record

NEAR = 1.05
"""Held-out error, relative to the chosen one's, up to which a finalist's fits count for the bands."""


@dataclass(frozen=True, kw_only=True)
class IdentifiedPart(Part):
    """A linear or nonlinear state-space model of all controlled variables, its structure chosen by held-out free runs.

    The outputs are the controlled variables; the inputs all MVs and measured disturbances. ``member`` numbers the
    models of an ensemble: 0 is fitted to all rows, 1 and 2 to the rows of one fold each, with other seeds.
    ``orders`` are the numbers of states tried, from the least to the most (None: 2 to 8, and two more for each further
    output); ``units`` the numbers of tanh units tried, none for linear models only. ``correction`` is the share of
    the output's error that each sample of a training run takes back, None: .05 for integrating or drifting records,
    else 0. ``minutes`` is the budget of the search on one core, counted in nominal work so that results are
    reproducible; the best so far is kept. ``rows`` is the most rows that are fitted; of longer records the
    stretches in which the inputs move most.
    """

    model: ClassVar[type[Model]] = Identified
    member: int = 0
    orders: tuple[int, int] | None = None
    units: tuple[int, ...] = UNITS
    correction: float | None = None
    minutes: float = 3.0
    rows: int = 8000

    def __post_init__(self) -> None:
        if self.member not in (0, 1, 2):
            raise ValueError(f"member is {self.member}; an ensemble has the members 0, 1 and 2")
        if self.orders is not None and not 1 <= self.orders[0] <= self.orders[1]:
            raise ValueError(f"orders are {list(self.orders)}; give the least and the most, e.g. [2, 8]")
        if any(n < 1 for n in self.units):
            raise ValueError(f"units are {list(self.units)}; each must be at least 1, and [] tries linear models only")
        if self.correction is not None and not 0 <= self.correction <= 1:
            raise ValueError(f"correction is {self.correction:g}; it must lie between 0 and 1")
        if not self.minutes > 0:
            raise ValueError(f"minutes is {self.minutes:g}; it must be positive")
        if self.rows < 100:
            raise ValueError(f"rows is {self.rows}; it must be at least 100")

    def learn(self, source: Source) -> Learnt:
        """Search, fit the member, and report on the class of model over rows that its fold's fits never saw."""
        record = informative(source.data(self.model.kind), self.rows)
        n_y, n_mv = len(source.signals.sp), len(source.signals.mv)
        search = replace(self, member=0)
        training, selection, scales = _searched(_Key(record, search, n_y, source.seed))
        structure = selection.chosen.structure
        fitted = training.within_limits(structure, _member(training, selection, self.member))
        noise, found, whole = _residuals(training, selection, fitted.model)
        model = assembled(fitted.model, structure.delays, scales, training.data, noise, n_mv, source.seed)
        pvs, inputs = source.signals.pv[:n_y], (*source.signals.mv, *source.signals.dv)
        bands = _bands(selection)
        runs, curves = free_run_figures(training, selection.chosen, scales, [s.name for s in pvs])
        responses, dead = response_figures(bands, structure.delays, training.data, scales, pvs, inputs)
        for name, sd in zip(runs, noise * scales.y_scale, strict=True):
            runs[name]["noise_sd"] = float(sd)
        metrics: dict[str, Any] = {
            "free_run_rmse": runs[pvs[0].name]["free_run_rmse"],
            "n_train": sum(len(s) for s in whole),
            "parameters": len(fitted.model.vector()),
            "member": self.member,
            "outputs": runs,
            "structure": structure_figures(selection),
            "gains": gain_figures(bands, training.data, scales, pvs, inputs),
            "dead_times": dead,
            "spectral_radius": gains(fitted.model, training.data)[1],
            "residual": residual_figures(found, [s.v for s in whole], [s.name for s in pvs]),
            "step_responses": responses,
            "candidates_tried": _table(selection),
        }
        time_s: Array = source.signals.period_s * np.arange(len(curves["measured"]), dtype=np.float64)
        return Learnt(model, metrics, predictions={"time_s": time_s, **curves})


@dataclass(frozen=True, slots=True, eq=False)
class _Key:
    """What a search depends on; equal keys have the same result, so that members share one search a process."""

    record: Record
    part: IdentifiedPart
    n_y: int
    seed: int

    def _values(self) -> tuple[str, IdentifiedPart, int, int]:
        return self.record.digest(), self.part, self.n_y, self.seed

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self._values())


@lru_cache(maxsize=1)
def _searched(key: _Key) -> tuple[Training, Selection, Scales]:
    scales = Scales.of(key.record, key.n_y)
    data = ScaledRecord.of(key.record, scales)
    training = Training(data, folds(key.record), Budget(60 * key.part.minutes), key.seed)
    least, most = key.part.orders or (max(2, key.n_y), 8 + 2 * (key.n_y - 1))
    orders = range(max(least, key.n_y), max(most, key.n_y) + 1)
    return training, select(training, orders=orders, units=key.part.units, correction=key.part.correction), scales


def _member(training: Training, selection: Selection, member: int) -> Fitted:
    """The first fold's best fit gone on over all rows; the second fold's; the first fold's next one."""
    chosen = selection.chosen
    first, second = (chosen.of_fold(k) for k in range(2))
    if member == 0 or not second:
        return training.on_all_rows(chosen.structure, first[0])
    if member == 1:
        return second[0]
    others = [f for f in first[1:] if np.isfinite(f.held_out)]
    return others[0] if others else first[0]


def _residuals(training: Training, selection: Selection, model: Dynamics) -> tuple[Array, list[Array], list[Stretch]]:
    """(scaled noise (n_y,), free-run residuals, stretches) over all rows."""
    structure = selection.chosen.structure
    whole = training.part(structure.delays, slice(None)).stretches()
    starts = fit_starts(model, whole, structure.correction)
    found = residuals(model, starts, whole, structure.correction)
    if found is None:
        starts = fit_starts(model, whole, 1.0)
        found = residuals(model, starts, whole, 1.0) or [s.y for s in whole]
    return noise_of(found), found, whole


def _bands(selection: Selection) -> Sequence[Dynamics]:
    """The fits that show how sure the figures are: those of the chosen structure, and of finalists as good as it."""
    chosen = selection.chosen
    same = [
        t
        for t in selection.finalists
        if t.structure.delays == chosen.structure.delays
        and (t.structure.n_hidden > 0) == (chosen.structure.n_hidden > 0)
        and t.error <= NEAR * chosen.error
    ]
    fits = [f for t in (chosen, *(t for t in same if t is not chosen)) for f in t.fits.values()]
    finite = [f.model for f in fits if np.isfinite(f.held_out)]
    return finite or [chosen.of_fold(0)[0].model]


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
