"""Whether a load wanders in a record that no controller acts in: then errors some rows ahead choose the model.

A free run over rows in which a load wanders holds the load, and ranks models by how they imitate it. One-step errors do
not, but in white noise they hardly tell good models from poor ones. So both searches offer a model, and what counts is
how well each foresees held-out rows as far ahead as a controller looks, with the filter that follows its loads best.

Source: L. Ljung, System identification, 2nd ed., 1999, sections 3.3 (predictions k steps ahead) and 16.6.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.innovations import Innovations, PredictionError, ahead, begun, typical
from loopwright.pipeline.models.identified.network_search import Rounds
from loopwright.pipeline.models.identified.structure import CandidateFits, Problem

FILTER_ITERATIONS = 20
"""Iterations in which the filter's gain of a model of free runs is fitted."""


def foresees_better(rounds: Rounds, trial: CandidateFits, other: CandidateFits) -> bool:
    """Whether a candidate foresees the held-out rows better than another, by ``error_ahead`` over all folds.

    False where no filter of one of them follows the record: nothing is compared then.
    """
    tasks = [(of, fold) for of in (trial, other) for fold in of.folds]
    found = parallel_map(
        partial(error_ahead, rounds.problem), tasks, f"{rounds.label}: errors some rows ahead of both kinds of model"
    )
    of_trial, of_other = found[: len(trial.folds)], found[len(trial.folds) :]
    rms = [float(np.sqrt(np.mean(np.square(errors)))) for errors in (of_trial, of_other)]
    return bool(np.all(np.isfinite(rms)) and rms[0] < rms[1])


def error_ahead(problem: Problem, task: tuple[CandidateFits, int]) -> float:
    """Scaled error of a candidate's best fit over a fold's held-out rows, foreseen 1 to ``PREDICTED_AHEAD`` rows ahead.

    A fit of free runs is given the loads, and the filter's gain that foresees its training rows best one row ahead.
    Infinite where the filter explodes.
    """
    trial, fold = task
    model = trial.of_fold(fold)[0].model
    held = problem.held(trial.structure, fold)
    if not isinstance(model, Innovations):
        train = problem.train(trial.structure, fold)
        try:
            fitted = PredictionError(iterations=FILTER_ITERATIONS).fit(begun(model, train), train, gain_alone=True)
        except ModelError:
            return np.inf
        model = fitted.model
        if not isinstance(model, Innovations):  # the type of what went in
            raise TypeError(type(model).__name__)
    pairs = [ahead(model, stretch) for stretch in held]
    errors = np.concatenate([measured - foreseen for measured, foreseen in pairs])
    return typical(errors) if np.all(np.isfinite(errors)) else np.inf
