"""Records in closed loop: models with their noise are searched, and their inputs must foresee the PV."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from closed_loop_records import LOOPS, SIGNALS
from identified_models import AllRead

from loopwright.pipeline.models.identified.candidates import FitTask, on_all_rows
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.innovations import innovations
from loopwright.pipeline.models.identified.knowledge import Knowledge, Pair
from loopwright.pipeline.models.identified.linear_search import LinearSearch
from loopwright.pipeline.models.identified.network_search import Rounds
from loopwright.pipeline.models.identified.noise_search import NoiseSearch
from loopwright.pipeline.models.identified.output_error import Fitted
from loopwright.pipeline.models.identified.scaled_record import Fold
from loopwright.pipeline.models.identified.structure import Budget, CandidateFits, Problem, Structure
from loopwright.pipeline.models.part import Learnt, Source

QUICK = IdentifiedPart(units=(), orders=(2, 2))
MOVED = "calm, many set points"
AT_REST = "calm, set point at rest"
LATE = "dead time, set points"


@cache
def learnt(name: str, seed: int = 0) -> Learnt:
    part = replace(QUICK, orders=(2, 3)) if name == LATE else QUICK
    return part.learn(Source(LOOPS[name].record(2_400, seed), SIGNALS))


@pytest.mark.parametrize("name", [MOVED, LATE])
def test_the_plant_is_found_and_not_the_controller(name: str) -> None:
    found, loop = learnt(name).metrics, LOOPS[name]
    assert found["structure"]["noise"] in ("gain", "all")
    assert found["structure"]["rows_ahead"] == 30
    answer = found["proof"]["answers"]["y"]["u"]
    rows = np.arange(1, answer["last"] + 1)
    true = loop.answer(np.ones(answer["last"] + 1))[rows][answer["first"] - 1 :].mean()
    # A free run of these records finds -1/kc, the controller read backwards.
    assert answer["model"] == pytest.approx(true, rel=0.35)
    # The measurement's noise, of a record whose loads are forty times as large.
    assert found["outputs"]["y"]["noise_sd"] == pytest.approx(loop.noise, rel=0.25)


def test_the_inputs_foresee_the_pv_only_where_something_else_moved_them() -> None:
    moved, rest = (learnt(name).metrics["proof"]["one_step"]["y"] for name in (MOVED, AT_REST))
    assert moved["nats"] > 20
    assert rest["nats"] < 5
    assert moved["with_inputs"] < moved["without"]
    # No model is better than the regularized ARX of many lags by much, nor worse.
    assert moved["model"] == pytest.approx(moved["with_inputs"], rel=0.05)


def test_a_correction_that_is_given_keeps_the_search_by_free_runs() -> None:
    part = replace(QUICK, correction=0.1, minutes=0.05)
    found = part.learn(Source(LOOPS[MOVED].record(1_200, 0), SIGNALS)).metrics
    assert found["structure"]["noise"] == "none"
    assert found["structure"]["rows_ahead"] is None
    assert "one_step" not in found["proof"]


def test_a_fit_whose_filter_explodes_over_the_whole_record_is_no_candidate() -> None:
    """Such a one was chosen by its held-out rows, and no model came of the record."""
    source = Source(LOOPS[MOVED].record(1_200, 0), SIGNALS)
    searched = source.result(replace(QUICK, minutes=0.05).groundwork())
    problem = searched.problem
    trial = searched.selection.chosen
    search = NoiseSearch.of(Rounds(problem, Budget(1.0, 1_000, 1), "test"))
    (key, fitted), *others = trial.fits.items()
    wild = replace(fitted, model=replace(fitted.model, a=3 * fitted.model.a))
    assert innovations(wild.model, problem.whole(trial.structure)) is None
    spoilt = replace(trial, fits={key: wild, **dict(others)})
    assert [t.fits for t in search.following([trial, spoilt])] == [trial.fits]
    twice = replace(trial, fits={**trial.fits, (key[0], 99): wild})
    assert [set(t.fits) for t in search.following([twice])] == [set(trial.fits)]
    # Of such a fit the one of its fold is kept as it is, and the record has a model all the same.
    assert on_all_rows(problem, trial.structure, wild) is wild


def searched_over(
    errors: dict[int, float],
    monkeypatch: pytest.MonkeyPatch,
    seen: int = 0,
    exploded: int = -1,
    known: Knowledge | None = None,
) -> tuple[list[int], int]:
    """(dead times that were tried, the one that is taken) where the errors of fits of order 2 are ``errors``.

    The impulse response shows ``seen`` rows, and the filter of the fit with ``exploded`` runs away in training.
    """
    data: Any = AllRead(np.zeros((2_000, 1)), np.zeros((2_000, 1)))
    folds = (Fold(slice(0, 1_000), slice(1_000, 2_000)),)
    rounds = Rounds(Problem(data, folds, 1, known=known or Knowledge()), Budget(9.0, 2_000, 1), "test")
    shown = [Structure("balanced", 0, (0, 0), (d,)) for d in dict.fromkeys([0, seen])]
    search = NoiseSearch(rounds, LinearSearch(rounds, {(of, 0): "none" for of in shown}))
    tried = []

    def trials(_: Rounds, tasks: list[FitTask], name: str) -> tuple[list[CandidateFits], list[str]]:
        model, found = Dynamics.linear(np.array([[0.95]]), np.array([[1.0]])), []
        for task in tasks:
            (d,) = task.structure.delays
            tried.append(d)
            error = errors.get(d, 2.0)
            found.append(
                CandidateFits(task.structure, {(0, 0): Fitted(model, [], np.inf if d == exploded else error, error, 1)})
            )
        return found, []

    monkeypatch.setattr(Rounds, "trials", trials)
    monkeypatch.setattr(Rounds, "starts", lambda _, structures: {(of, 0): "none" for of in structures})
    _, (taken,) = search._scanned([2])
    return sorted(tried), taken


def test_of_dead_times_that_explain_the_rows_alike_the_middle_one_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """2,000 rows: a nat is .05 % of the error."""
    alike = {d: 1.0 + 1e-4 * (d % 2) for d in range(7)}
    tried, taken = searched_over(alike, monkeypatch)
    assert taken in (1, 2, 3)
    assert {0, 1, 2, 3, 4, 6, 8} <= set(tried)
    # One that is certain stays, and nothing far from it is tried.
    tried, taken = searched_over({0: 1.0, 1: 1.05}, monkeypatch)
    assert taken == 0
    assert max(tried) == 2
    # Where nothing tells, dead time is a part of the rise of 13 rows, and not the middle of all that were tried.
    tried, taken = searched_over(dict.fromkeys(range(60), 1.0), monkeypatch)
    assert 4 <= taken <= 12 < max(tried)


@pytest.mark.parametrize("seen", [0, 6, 8, 12])
def test_the_bottom_of_a_valley_is_found_from_where_the_impulse_response_begins(
    seen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for true in (1, 2, 8):
        valley = {d: 1.0 + 0.004 * abs(d - true) for d in range(70)}
        assert searched_over(valley, monkeypatch, seen)[1] == true
        # A fit that ran away beside it changes nothing.
        assert searched_over(valley, monkeypatch, seen, exploded=true + 1)[1] == true


def test_no_dead_time_is_looked_for_of_an_input_that_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    none = Knowledge((Pair(0, 0, 0.0, 0.0, none=True),), 1)
    tried, taken = searched_over(dict.fromkeys(range(60), 1.0), monkeypatch, known=none)
    assert set(tried) == {0}
    assert taken == 0


@pytest.mark.parametrize("seed", [0, 1])
def test_likely_dead_times_hold_the_one_of_the_plant(seed: int) -> None:
    """Of ten lags behind 14 rows: the load hides how the answer begins."""
    found, loop = learnt(LATE, seed).metrics, LOOPS[LATE]
    own, low, high = found["open"]["dead_times"]["u"]
    assert own == found["structure"]["delays"][0]
    assert low <= own <= high
    assert low - 1 <= loop.dead - 1 <= high + 1
    later = 2 * found["open"]["dead_sd"][0]
    # An earlier one makes no plant of the tests late; where none but the model's is likely, the answers' spread tells.
    assert later == high - own if low < high else 0 <= later < 2
    assert own > 5  # before, the least of a few: 0, 5, 3 and 0 of four records
