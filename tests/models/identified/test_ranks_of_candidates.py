"""How candidates and their fits are ranked: exploded fits last, candidates of fewer folds too, known signs first."""

from __future__ import annotations

import numpy as np

from pipeline.models.identified.dynamics import Dynamics
from pipeline.models.identified.linear_search import smallest_first
from pipeline.models.identified.linear_start import dead_times
from pipeline.models.identified.output_error import Fitted
from pipeline.models.identified.scaled_record import Fold
from pipeline.models.identified.selection import _settling_first
from pipeline.models.identified.structure import Problem, Structure
from pipeline.models.identified.trial import Trial

STRUCTURE = Structure("balanced", 1, (0, 0), (0,))


def fit(held_out: float, *against: int, pole: float = 0.9) -> Fitted:
    """A fit of first order with this error over held-out rows."""
    model = Dynamics.linear(np.array([[pole]]), np.array([[1.0]]))
    return Fitted(model, [], 0.1, held_out, 1, against=frozenset(against))


def test_an_exploded_fit_comes_after_one_that_contradicts_what_is_known() -> None:
    wild, usable = fit(np.inf), fit(0.3, 0)
    trial = Trial(STRUCTURE, {(0, 0): wild, (0, 1): usable})
    assert trial.of_fold(0)[0] is usable
    assert trial.against == 1


def test_a_candidate_of_fewer_folds_comes_last_whatever_it_contradicts() -> None:
    whole = Trial(STRUCTURE, {(0, 0): fit(0.3, 0), (1, 0): fit(0.3, 0)})
    part = Trial(Structure("balanced", 2, (0, 0), (0,)), {(0, 0): fit(0.9, 0)})
    assert smallest_first([part, whole])[0] is whole


def test_an_output_that_an_input_does_not_move_says_nothing_of_its_dead_time() -> None:
    response = np.zeros((30, 2, 2))
    response[9:, 0, 0] = response[11:, 1, 1] = 1.0
    response[12:, 0, 1] = 1.0
    assert dead_times(response, np.ones(2)) == [8, 10]
    assert dead_times(np.zeros((30, 1, 1)), np.ones(1)) == [0]


def test_a_state_that_drifts_in_one_fold_alone_is_a_loads() -> None:
    """And one that drifts in both is the plant's; so is one without which held-out rows are foreseen much worse."""
    data = type("Rows", (), {"y": np.zeros((2_000, 1))})()
    problem = Problem(data, (Fold(slice(0, 1_000), slice(1_000, 2_000)), Fold(slice(1_000, 2_000), slice(0, 1_000))), 1)  # type: ignore[arg-type]

    def trial(error: float, *poles: float) -> Trial:
        return Trial(STRUCTURE, {(k, 0): fit(error, pole=pole) for k, pole in enumerate(poles)})

    settles = trial(1.002, 0.9, 0.9)
    for first, expected in (
        (trial(1.0, 1.0, 0.9), settles),
        (trial(1.0, 1.0, 0.9995), None),
        (trial(1.0, 0.95, 0.9), None),
        (trial(0.9, 1.0, 0.9), None),
    ):
        assert _settling_first(problem, [first, settles])[0] is (first if expected is None else expected)
