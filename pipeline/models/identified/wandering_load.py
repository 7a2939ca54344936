"""Whether a load wanders in a record that no controller acts in: then errors some rows ahead choose the model.

A free run over rows in which a load wanders holds the load, and ranks models by how they imitate it. One-step errors do
not, but in white noise they hardly tell good models from poor ones. So both searches offer a model, and what counts is
how well each foresees held-out rows as far ahead as a controller looks, with the filter that follows its loads best.

Source: L. Ljung, System identification, 2nd ed., 1999, sections 3.3 (predictions k steps ahead) and 16.6.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.innovations import Innovations, PredictionError, ahead, begun, typical
from loopwright.pipeline.models.identified.network_search import Rounds
from loopwright.pipeline.models.identified.structure import CandidateFits, Problem

FILTER_ITERATIONS = 20
"""Iterations in which the filter's gain of a model of free runs is fitted."""


ALIKE_AHEAD = 1.1
"""Ratio of errors ahead up to which both models are alike. They are only compared where free runs miss more than noise,
so that the model of free runs is bent to what no input did. It was 1.03 on the benchmark's plant whose gain fades; the
other records that were measured have .94 or less."""


class ErrorsAhead(NamedTuple):
    """Scaled errors ``PREDICTED_AHEAD`` rows ahead, of the model that one-step errors chose, and of free runs' choice.

    The geometric mean over several outputs. Infinite where no filter of a model follows the record.
    """

    one_step: float
    free_runs: float

    @property
    def wanders(self) -> bool:
        """Whether the model with loads foresees the rows as well; False where nothing can be compared."""
        return self.one_step < ALIKE_AHEAD * self.free_runs < np.inf


def errors_ahead(rounds: Rounds, one_step: CandidateFits, free_runs: CandidateFits) -> ErrorsAhead:
    """The rms over all folds of ``error_ahead`` of both candidates."""
    tasks = [(of, fold) for of in (one_step, free_runs) for fold in of.folds]
    found = parallel_map(
        partial(error_ahead, rounds.problem), tasks, f"{rounds.label}: errors some rows ahead of both kinds of model"
    )
    both = found[: len(one_step.folds)], found[len(one_step.folds) :]
    return ErrorsAhead(*(float(np.sqrt(np.mean(np.square(errors)))) for errors in both))


def error_ahead(problem: Problem, task: tuple[CandidateFits, int]) -> float:
    """Scaled error of a candidate's best fit over a fold's held-out rows, foreseen 1 to ``PREDICTED_AHEAD`` rows ahead.

    A fit of free runs is given the loads and a filter as those of one-step errors have it: its gain foresees the
    training rows best one row ahead, and the held-out ones choose the iterate. Infinite where the filter explodes.
    """
    trial, fold = task
    model = trial.of_fold(fold)[0].model
    held = problem.in_a_loop.held(trial.structure, fold)
    if not isinstance(model, Innovations):
        train = problem.train(trial.structure, fold)
        try:
            late = problem.held(trial.structure, fold)
            fitter = PredictionError(iterations=FILTER_ITERATIONS)
            fitted = fitter.fit(begun(model, train), train, late, gain_alone=True)
        except ModelError:
            return np.inf
        model = fitted.model
        if not isinstance(model, Innovations):  # the type of what went in
            raise TypeError(type(model).__name__)
    pairs = [ahead(model, stretch) for stretch in held]
    errors = np.concatenate([measured - foreseen for measured, foreseen in pairs])
    known = np.concatenate([np.isfinite(measured) for measured, _ in pairs])
    return typical(errors) if np.all(np.isfinite(errors[known])) else np.inf
