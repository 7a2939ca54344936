"""Open-loop records: free runs judge where no load wanders, errors some rows ahead where one does."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import made_plants
import numpy as np
import pytest

from loopwright.pipeline.models.identified import structure_search, wandering_load
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.innovations import Innovations, begun
from loopwright.pipeline.models.identified.network_search import Rounds
from loopwright.pipeline.models.identified.structure import Budget, CandidateFits
from loopwright.pipeline.models.identified.wandering_load import ErrorsAhead, error_ahead, errors_ahead
from loopwright.pipeline.models.part import Learnt, Source
from loopwright.pipeline.records.record import Record

PART = IdentifiedPart(units=(), orders=(2, 3), lagged=False)
SOURCE_SIGNALS = made_plants.signals_of(1, 1)


def with_load(sd: float, rows: int = 1_500, seed: int = 0) -> Record:
    """A plant of gain .5 in open loop, and a load at its output: a lag of 150 rows behind white noise."""
    record, rng = made_plants.second_order(rows, seed=seed), np.random.default_rng(seed + 1)
    load, pushes = np.zeros(rows), rng.normal(size=rows) * np.sqrt(2 / 150)
    for k in range(1, rows):
        load[k] = load[k - 1] * (1 - 1 / 150) + pushes[k]
    return replace(record, pv=record.pv + sd * load[:, None])


@cache
def learnt(sd: float, seed: int = 0) -> Learnt:
    return PART.learn(Source(with_load(sd, seed=seed), SOURCE_SIGNALS))


def test_free_runs_judge_where_nothing_wanders(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("no load wanders in this record")

    monkeypatch.setattr(structure_search, "by_innovations", never)
    found = PART.learn(Source(with_load(0.0), SOURCE_SIGNALS)).metrics["structure"]
    assert found["rows_ahead"] is None
    assert found["noise"] == "none"


@pytest.mark.parametrize("seed", [0, 1])
def test_errors_some_rows_ahead_judge_where_a_load_wanders(seed: int) -> None:
    found = learnt(1.5, seed).metrics
    assert found["structure"]["rows_ahead"] == 30
    ahead = found["structure"]["ahead"]
    assert 0 < ahead["one_step"] < ahead["free_runs"] < 1
    assert found["structure"]["noise"] in ("gain", "all")
    # The measurement's noise, beside a load fifteen times as large.
    assert found["outputs"]["y0"]["noise_sd"] == pytest.approx(0.1, rel=0.4)
    assert found["proof"]["one_step"]["y0"]["nats"] > 20
    assert found["gains"]["y0"]["u0"]["gain"] == pytest.approx(0.5, rel=0.2)
    # Free runs, of which the load is most, are farther off.
    free = replace(PART, correction=0.0).learn(Source(with_load(1.5, seed=seed), SOURCE_SIGNALS)).metrics
    assert abs(free["gains"]["y0"]["u0"]["gain"] - 0.5) > abs(found["gains"]["y0"]["u0"]["gain"] - 0.5)


def test_a_correction_that_is_given_keeps_free_runs() -> None:
    part = replace(PART, correction=0.0)
    assert part.learn(Source(with_load(1.5), SOURCE_SIGNALS)).metrics["structure"]["rows_ahead"] is None


def test_a_choice_that_takes_its_error_back_hides_no_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a correction the residual is small, whatever wanders: what counts is what plain free runs miss."""
    source = Source(with_load(1.5), SOURCE_SIGNALS)
    corrected = replace(PART, correction=0.5).groundwork().done(source, "search").selection
    monkeypatch.setattr(structure_search, "by_free_runs", lambda *_given, **_more: corrected)
    assert PART.groundwork().done(source, "search").selection.ahead is not None


def test_of_both_models_the_one_that_foresees_better_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = {}
    for better in (True, False):
        errors = ErrorsAhead(0.1, 0.2) if better else ErrorsAhead(0.2, 0.1)
        monkeypatch.setattr(structure_search, "errors_ahead", lambda *_, errors=errors: errors)
        taken[better] = PART.groundwork().done(Source(with_load(1.5), SOURCE_SIGNALS), "search").selection
    assert [taken[better].ahead.wanders for better in (True, False)] == [True, False]
    assert taken[True].innovations is not None
    assert taken[False].innovations is None
    assert taken[True].spent == pytest.approx(taken[False].spent)  # both searches are counted


@pytest.mark.parametrize("changed", ["against", "folds"])
def test_what_is_known_comes_before_errors_and_all_folds_are_compared(
    changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = structure_search.by_innovations

    def worse(*given: Any) -> structure_search.Selection:
        """The one-step choice, which contradicts what is known, or was fitted on the first fold alone."""
        found = search(*given)
        fits = {
            key: replace(fit, against=frozenset({0})) if changed == "against" else fit
            for key, fit in found.chosen.fits.items()
            if changed == "against" or key[0] == 0
        }
        return replace(found, linear=CandidateFits(found.chosen.structure, fits), network=None)

    monkeypatch.setattr(structure_search, "by_innovations", worse)
    monkeypatch.setattr(structure_search, "errors_ahead", lambda *_: ErrorsAhead(0.1, 0.2))
    found = PART.groundwork().done(Source(with_load(1.5), SOURCE_SIGNALS), "search").selection
    assert found.innovations is None
    assert (found.ahead is None) is (changed == "folds")


def test_error_ahead_of_a_free_run_is_that_of_the_best_filter_about_its_plant() -> None:
    searched = replace(PART, correction=0.0).groundwork().done(Source(with_load(1.5), SOURCE_SIGNALS), "search")
    problem, trial = searched.problem, searched.selection.chosen
    fitted = trial.of_fold(0)[0]
    whole = error_ahead(problem, (trial, 0))
    assert whole < 0.8 * fitted.held_out  # the load is most of a free run's error, and the filter follows it
    train = problem.train(trial.structure, 0)
    filtered = begun(fitted.model, train)
    same = CandidateFits(trial.structure, {(0, 0): replace(fitted, model=filtered)})
    assert error_ahead(problem, (same, 0)) == pytest.approx(whole, rel=0.1)
    rounds = Rounds(problem, Budget(1.0, len(problem.data), 1), "search")
    both = errors_ahead(rounds, trial, trial)
    assert both.one_step == both.free_runs


def test_nothing_is_compared_where_no_filter_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = replace(PART, correction=0.0).groundwork().done(Source(with_load(1.5), SOURCE_SIGNALS), "search")
    problem, trial = searched.problem, searched.selection.chosen

    def explodes(model: Innovations, stretch: Stretch) -> tuple[np.ndarray, np.ndarray]:
        return stretch.y, np.full_like(stretch.y, np.nan)

    def none(plant: Dynamics, data: object) -> Innovations:
        raise wandering_load.ModelError("none")

    for name, instead in (("ahead", explodes), ("begun", none)):
        with monkeypatch.context() as patch:
            patch.setattr(wandering_load, name, instead)
            assert error_ahead(problem, (trial, 0)) == np.inf
    assert [ErrorsAhead(one, 0.1).wanders for one in (0.105, 0.115)] == [True, False]  # alike, and worse
    assert not ErrorsAhead(0.1, np.inf).wanders
    assert not ErrorsAhead(np.inf, 0.1).wanders
