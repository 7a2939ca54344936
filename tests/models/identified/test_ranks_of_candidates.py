"""How candidates and their fits are ranked: exploded fits last, candidates of fewer folds too, known signs first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from identified_models import AllRead

from loopwright.pipeline.models.identified.candidates import wild
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.linear_search import smallest_first
from loopwright.pipeline.models.identified.linear_start import dead_times
from loopwright.pipeline.models.identified.network_search import Rounds, _offers
from loopwright.pipeline.models.identified.noise_search import NoiseSearch
from loopwright.pipeline.models.identified.output_error import Fitted
from loopwright.pipeline.models.identified.scaled_record import Fold
from loopwright.pipeline.models.identified.structure import FARTHEST, Budget, CandidateFits, Problem, Structure
from loopwright.pipeline.models.identified.structure_search import (
    _as_its_linear_model,
    _led_by_settling,
    _settling_first,
    _stands_in,
    by_innovations,
)

STRUCTURE = Structure("balanced", 1, (0, 0), (0,))


def fit(held_out: float, *against: int, pole: float = 0.9) -> Fitted:
    """A fit of first order with this error over held-out rows."""
    model = Dynamics.linear(np.array([[pole]]), np.array([[1.0]]))
    return Fitted(model, [], 0.1, held_out, 1, against=frozenset(against))


def test_an_exploded_fit_comes_after_one_that_contradicts_what_is_known() -> None:
    wild, usable = fit(np.inf), fit(0.3, 0)
    trial = CandidateFits(STRUCTURE, {(0, 0): wild, (0, 1): usable})
    assert trial.of_fold(0)[0] is usable
    assert trial.against == 1


def test_a_candidate_of_fewer_folds_comes_last_whatever_it_contradicts() -> None:
    whole = CandidateFits(STRUCTURE, {(0, 0): fit(0.3, 0), (1, 0): fit(0.3, 0)})
    part = CandidateFits(Structure("balanced", 2, (0, 0), (0,)), {(0, 0): fit(0.9, 0)})
    assert smallest_first([part, whole])[0] is whole


def test_an_output_that_an_input_does_not_move_says_nothing_of_its_dead_time() -> None:
    response = np.zeros((30, 2, 2))
    response[9:, 0, 0] = response[11:, 1, 1] = 1.0
    response[12:, 0, 1] = 1.0
    assert dead_times(response, np.ones(2)) == [8, 10]
    assert dead_times(np.zeros((30, 1, 1)), np.ones(1)) == [0]


def two_folds() -> Problem:
    """A record of two halves, each held out once."""
    data: Any = AllRead(np.zeros((2_000, 1)), np.linspace(-0.5, 0.5, 2_000)[:, None])
    folds = (Fold(slice(0, 1_000), slice(1_000, 2_000)), Fold(slice(1_000, 2_000), slice(0, 1_000)))
    return Problem(data, folds, 1)


def trial(error: float, *poles: float) -> CandidateFits:
    """A candidate with a pole in each fold."""
    return CandidateFits(STRUCTURE, {(k, 0): fit(error, pole=pole) for k, pole in enumerate(poles)})


def test_a_state_that_drifts_is_a_loads_where_a_model_that_settles_errs_as_little() -> None:
    """In one fold alone any that settles will do, in both it has to settle clearly, and err as little."""
    for first, other, settles in (
        (trial(1.0, 1.0, 0.9), trial(1.002, 0.9, 0.9), True),
        (trial(1.0, 1.0, 0.9), trial(1.002, 0.9, 0.99), True),
        (trial(1.0, 1.0, 0.9995), trial(1.002, 0.9, 0.97), True),
        (trial(1.0, 1.0, 0.9995), trial(1.002, 0.9, 0.99), False),
        (trial(1.0, 0.95, 0.9), trial(1.002, 0.9, 0.9), False),
        (trial(0.9, 1.0, 0.9), trial(1.002, 0.9, 0.9), False),
        (trial(0.9, 1.0, 1.0), trial(1.002, 0.9, 0.9), False),
    ):
        assert _settling_first(two_folds(), [first, other])[0] is (other if settles else first)
    clearly, hardly, first = trial(1.002, 0.9, 0.97), trial(1.001, 0.9, 0.99), trial(1.0, 1.0, 0.9)
    assert _settling_first(two_folds(), [first, hardly, clearly])[0] is clearly


@pytest.mark.parametrize(
    ("best", "other", "stands_in"),
    [
        (trial(1.0, 0.98, 1.003), trial(1.2, 0.9, 0.9), True),
        (trial(1.0, 0.98, 1.003), trial(1.3, 0.9, 0.9), False),
        (trial(1.0, 0.98, 1.003), trial(1.2, 0.9, 0.9995), False),
        (trial(1.0, 0.9999, 1.003), trial(1.01, 0.9, 0.9), True),
        (trial(1.0, 0.9999, 1.003), trial(1.2, 0.9, 0.9), False),
    ],
)
def test_an_integrator_shows_in_all_parts_of_an_open_record(
    best: CandidateFits, other: CandidateFits, stands_in: bool
) -> None:
    assert _stands_in(other, best) is stands_in


def test_a_trial_that_settles_leads_those_that_integrate_in_one_part_whatever_comes_to_them() -> None:
    """Of fewer folds it says too little; of the structure that it stands in for there is one."""
    best, settles, part = trial(1.0, 0.98, 1.003), trial(1.2, 0.9, 0.9), trial(0.9, 0.9)
    assert _led_by_settling([best, settles]) == [settles]
    assert _led_by_settling([best], [settles]) == [settles]
    assert _led_by_settling([best], [part]) == [best]
    assert _led_by_settling([settles, best]) == [settles, best]


@dataclass
class Found:
    """A search among models with their noise that is over."""

    rounds: Any
    ranked: list[CandidateFits]
    network: CandidateFits

    def linear(self, orders: Any) -> list[CandidateFits]:
        return self.ranked

    def networks(self, linear: Any, units: Any) -> list[CandidateFits]:
        return [self.network]


@pytest.mark.parametrize(("error", "wins"), [(1.0, False), (0.99, True)])
def test_a_network_gains_nothing_by_what_the_linear_model_gave_away_to_settle(
    error: float, wins: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model that settles is 4 nats worse than the one that integrates; a network as good as that one is no gain."""
    ranked = [trial(1.0, 1.0, 0.9995), trial(1.002, 0.9, 0.9)]
    network = CandidateFits(replace(STRUCTURE, n_hidden=4), trial(error, 0.9, 0.9).fits)
    monkeypatch.setattr(NoiseSearch, "of", lambda rounds: Found(rounds, ranked, network))
    found = by_innovations(Rounds(two_folds(), Budget(1.0, 2_000, 1), ""), (1,), (4,))
    assert found.linear is ranked[1]
    assert found.nonlinear is wins


def test_a_plant_settles_where_its_linear_model_passes_the_test_of_networks() -> None:
    """A slow pole that is no integrator's fails it, and would reject every network; one fold that rests suffices.

    A catalyst that fades integrates in one half of its record: networks that were not asked to rest ran away.
    """
    for poles, settles in (
        ((0.9, 0.95), True),
        ((0.9918, 1.0002), True),
        ((1.0, 0.9), True),
        ((0.9987, 0.9987), False),
        ((1.0, 1.0), False),
    ):
        assert _as_its_linear_model(two_folds(), trial(1.0, *poles)).settles is settles


def test_a_plant_of_a_high_gain_settles_and_its_networks_may_rest_as_far_off() -> None:
    """The largest input is .5, so that a pole at .99 rests at 50, where rests beyond 20 counted as wild."""
    problem, linear = two_folds(), trial(1.0, 0.99, 0.99)
    found = _as_its_linear_model(problem, linear)
    model = linear.of_fold(0)[0].model.plant
    assert found.settles
    assert found.farthest == pytest.approx(100.0, rel=1e-3)
    assert wild(model, problem)
    assert not wild(model, found)
    assert _as_its_linear_model(problem, trial(1.0, 0.9, 0.9)).farthest == FARTHEST


def test_networks_on_the_smallest_candidate_come_before_others_that_cost_more() -> None:
    """A long record's budget carries the first ones alone."""

    def balanced(order: int) -> Structure:
        return Structure("balanced", order, (0, 0), (0,))

    lagged = Structure("lagged", 4, (2, 3), (0,))
    found = _offers([balanced(8), balanced(11), lagged, balanced(3), balanced(2)], (4, 8, 12))
    assert [s.order for s in found[:3]] == [8, 2, 4]
    assert {s.n_hidden for s in found[:3]} == {8}
    assert [s.order for s in _offers([balanced(2), balanced(8)], (4,))[:2]] == [2, 8]
