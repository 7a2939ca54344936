"""Candidates of the structure search: what one is, and how it is trained on a fold."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from pipeline.errors import ModelError
from pipeline.models.identified.dynamics import Dynamics, Stretch
from pipeline.models.identified.lagged_start import lagged_start, output_rows, with_units
from pipeline.models.identified.linear_start import Realizations, dead_times, high_order_arx, within_unit_circle
from pipeline.models.identified.output_error import Fitted, OutputError, fit_starts, residuals
from pipeline.models.identified.rests import settle
from pipeline.models.identified.scaled_record import Fold, ScaledRecord
from pipeline.plants.simulator import Array

RESPONSE = 120
"""Samples of the high-order ARX's impulse response that are realized."""

WILD = 20.0
"""Scaled state that no rest of a usable network exceeds."""


@dataclass(frozen=True, slots=True)
class Structure:
    """The choices of a candidate.

    ``start`` balanced: realization of ``order`` states; lagged: companion form of ``lags`` (of the outputs, of the
    inputs). ``delays`` are the dead times of the inputs in periods. ``correction`` is the share of the output's error
    that each sample of the training run takes back: for drift and integrating levels.
    """

    start: Literal["balanced", "lagged"]
    order: int
    lags: tuple[int, int]
    delays: tuple[int, ...]
    n_hidden: int = 0
    ridge: float = 1.0
    correction: float = 0.0

    @property
    def base(self) -> Structure:
        """The linear candidate that this one starts from."""
        return replace(self, n_hidden=0, ridge=0.0)


@dataclass(slots=True)
class Budget:
    """Work in nominal seconds of one core, so that the same record and budget always do the same work.

    An iteration over N rows counts N (5 + .011 n_x P) 1e-6 s, with P the number of parameters.
    """

    seconds: float
    spent: float = 0.0

    @property
    def left(self) -> bool:
        """Whether more work may begin."""
        return self.spent < self.seconds

    def cost(self, model: Dynamics, rows: int) -> float:
        """Nominal seconds of one iteration."""
        return rows * (5 + 0.011 * model.n_x * len(model.vector())) * 1.5e-6


@dataclass(slots=True, eq=False)
class Training:
    """Fits of candidates on the folds of one record; what candidates share is computed once."""

    data: ScaledRecord
    folds: tuple[Fold, ...]
    budget: Budget
    seed: int = 0
    _shifted: dict[tuple[int, ...], ScaledRecord] = field(default_factory=dict)
    _realizations: dict[tuple[tuple[int, ...], int], Realizations] = field(default_factory=dict)
    _linear: dict[tuple[Structure, int], Fitted] = field(default_factory=dict)

    def part(self, delays: tuple[int, ...], rows: slice) -> ScaledRecord:
        """Some rows with the inputs late by ``delays``."""
        if delays not in self._shifted:
            self._shifted[delays] = self.data.delayed(delays)
        return self._shifted[delays].rows(rows)

    def stretches(self, structure: Structure, fold: int) -> tuple[list[Stretch], list[Stretch]]:
        """(training, held-out) stretches of a fold."""
        train, held = (self.part(structure.delays, rows) for rows in (self.folds[fold].train, self.folds[fold].held))
        return train.stretches(), held.stretches()

    def delay_options(self) -> list[tuple[int, ...]]:
        """No dead time, and where the first fold's impulse response shows one, that."""
        none = (0,) * self.data.v.shape[1]
        train = self.part(none, self.folds[0].train)
        found = dead_times(high_order_arx(train).impulse_response(RESPONSE), train.v.std(axis=0))
        return [none, tuple(found)] if max(found) > 0 else [none]

    def linear(self, structure: Structure, fold: int, iterations: int) -> Fitted:
        """The fitted linear model of a structure; a later call goes on where an earlier one ended.

        Raises ModelError where the data cannot carry it.
        """
        key = (structure.base, fold)
        train, held = self.stretches(structure, fold)
        if key in self._linear:
            model, starts = self._linear[key].model, self._linear[key].starts
        else:
            model, starts = self._begin(structure, fold), None
            if structure.start == "balanced":
                free = model.mask(b=True, c=True)
                begun = OutputError(iterations=3, correction=structure.correction).fit(model, train, free=free)
                model, starts = begun.model, begun.starts
        fit = OutputError(iterations=iterations, correction=structure.correction)
        self._linear[key] = self._spend(fit.fit(model, train, held, starts=starts), train)
        return self._linear[key]

    def network(self, structure: Structure, fold: int, seed: int, iterations: int) -> Fitted:
        """The fitted network of a structure, begun as its linear model with units that do nothing.

        A lagged start first trains one step ahead (correction 1, output rows only), then frees all rows.
        """
        train, held = self.stretches(structure, fold)
        draw = 1000 * self.seed + seed
        if structure.start == "lagged":
            linear, starts = self._begin(structure, fold), None
        else:
            base = self.linear(structure, fold, 0)
            linear, starts = base.model, base.starts
        states = visited(linear, train, 1.0 if starts is None else structure.correction)
        model = with_units(linear, states, np.concatenate([s.v for s in train]), structure.n_hidden, draw)
        if starts is None:
            one_step = OutputError(iterations=15, correction=1.0, ridge=structure.ridge, patience=5)
            free = output_rows(model, self.data.y.shape[1])
            model = self._spend(one_step.fit(model, train, held, free=free), train).model
        fit = OutputError(iterations=iterations, correction=structure.correction, ridge=structure.ridge)
        return self._spend(fit.fit(model, train, held, starts=starts), train)

    def more(self, structure: Structure, fitted: Fitted, fold: int, iterations: int) -> Fitted:
        """A fit that goes on."""
        train, held = self.stretches(structure, fold)
        fit = OutputError(iterations=iterations, correction=structure.correction, ridge=structure.ridge)
        return self._spend(fit.fit(fitted.model, train, held, starts=fitted.starts), train)

    def on_all_rows(self, structure: Structure, fitted: Fitted, iterations: int = 15) -> Fitted:
        """The fit gone on over all rows; the fit as it is where that makes a rest explode."""
        whole = self.part(structure.delays, slice(None)).stretches()
        fit = OutputError(iterations=iterations, correction=structure.correction, ridge=structure.ridge)
        found = self._spend(fit.fit(fitted.model, whole), whole)
        return found if not wild(found.model, self.data.v) or wild(fitted.model, self.data.v) else fitted

    def within_limits(self, structure: Structure, fitted: Fitted) -> Fitted:
        """A linear fit with no pole outside the unit circle: those are put on it, and B and c fitted again.

        Others are returned as they are.
        """
        model = fitted.model
        if model.n_hidden or np.abs(np.linalg.eigvals(model.a)).max() <= 1:
            return fitted
        inside = replace(model, a=within_unit_circle(model.a, 1 - 1e-9))
        whole = self.part(structure.delays, slice(None)).stretches()
        again = OutputError(iterations=5, correction=structure.correction)
        return again.fit(inside, whole, free=inside.mask(b=True, c=True))

    def _begin(self, structure: Structure, fold: int) -> Dynamics:
        train = self.part(structure.delays, self.folds[fold].train)
        if structure.start == "lagged":
            return lagged_start(train, *structure.lags)
        key = (structure.delays, fold)
        if key not in self._realizations:
            response = high_order_arx(train).impulse_response(RESPONSE)
            self._realizations[key] = Realizations.of(response, train.v.std(axis=0))
        return self._realizations[key].order(structure.order)

    def _spend(self, fitted: Fitted, train: list[Stretch]) -> Fitted:
        rows = sum(len(s) for s in train)
        self.budget.spent += (fitted.iterations + 2) * self.budget.cost(fitted.model, rows)
        return fitted


def visited(model: Dynamics, train: list[Stretch], correction: float) -> Array:
    """States (N, n_x) of the run over all rows in the order of ``train``; ModelError where it explodes."""
    found = []
    for start, stretch in zip(fit_starts(model, train, correction), train, strict=True):
        run = model.free_run(start, stretch, correction)
        if run is None:
            raise ModelError("the linear start explodes over its own training rows; record more samples")
        found.append(run[1])
    return np.concatenate(found)


def wild(model: Dynamics, v: Array) -> bool:
    """Whether a network that stands on a stable linear model goes beyond all bounds under some constant input."""
    if np.abs(np.linalg.eigvals(model.a)).max() > 0.9995:
        return False  # an integrator goes anywhere
    rows = np.linspace(0, len(v) - 1, 50).astype(np.int64)
    return bool(np.abs(settle(model, v[rows])[0]).max() > WILD)


def misses(model: Dynamics, starts: list[Array], train: list[Stretch], ratio: float, correction: float) -> bool:
    """Whether the residual of an output exceeds ``ratio`` times its noise: drift, or dynamics that the model lacks."""
    found = residuals(model, starts, train, correction)
    if found is None:
        return True
    whole = np.concatenate(found).std(axis=0)
    fast = np.concatenate([np.diff(r, axis=0) for r in found]).std(axis=0) / np.sqrt(2)
    return bool(np.any(whole > ratio * fast))
