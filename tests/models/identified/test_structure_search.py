"""The search: the same with any number of processes, within its budget, done once for all members."""

from __future__ import annotations

import multiprocessing
import os
from dataclasses import replace

import made_plants
import numpy as np
import pytest

from loopwright.pipeline.models.identified.candidates import on_all_rows
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.linear_search import LinearSearch
from loopwright.pipeline.models.identified.network_search import Rounds
from loopwright.pipeline.models.identified.steady_states import INTEGRATES, slowest_pole
from loopwright.pipeline.models.identified.structure import Budget, CandidateFits, Structure
from loopwright.pipeline.models.identified.structure_search import Searched
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.records.record import Record

PART = IdentifiedPart(orders=(2, 2), units=(3,), minutes=0.003)


def numbers(searched: Searched) -> list[bytes]:
    trials = searched.selection.finalists
    return [f.model.vector().tobytes() for t in trials for _, f in sorted(t.fits.items(), key=lambda kv: kv[0])]


@pytest.mark.skipif(multiprocessing.get_start_method() != "fork", reason="a spawned process takes seconds to start")
def test_the_number_of_processes_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Source(made_plants.hammerstein(150), made_plants.signals_of(1, 1), seed=3)
    found = []
    for cores in (1, 3):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        found.append(PART.groundwork().done(source, "search"))
    assert numbers(found[0]) == numbers(found[1])
    assert found[0].selection.spent == found[1].selection.spent


def test_members_share_one_search() -> None:
    parts = [replace(PART, units=(), member=k) for k in range(3)]
    works = {part.groundwork() for part in parts}
    assert len(works) == 1
    source = Source(made_plants.second_order(400), made_plants.signals_of(1, 1))
    source = replace(source, groundwork={work: work.done(source, "search") for work in works})
    learnt = [part.learn(source) for part in parts]
    arrays = [one.model.state_dict()["a"].numpy() for one in learnt]
    assert not np.array_equal(arrays[0], arrays[1])
    assert not np.array_equal(arrays[1], arrays[2])
    assert all(one.metrics["structure"] == learnt[0].metrics["structure"] for one in learnt)
    assert PART.groundwork() not in works


@pytest.mark.parametrize("back", [False, True])
def test_feedback_that_the_readings_showed_decides(back: bool) -> None:
    record = replace(made_plants.second_order(400), fed_back=back)
    searched = replace(PART, units=()).groundwork().done(Source(record, made_plants.signals_of(1, 1)), "search")
    assert searched.problem.fed_back is back


def test_without_lagged_candidates_all_have_the_orders_that_are_given() -> None:
    source = Source(made_plants.second_order(400), made_plants.signals_of(1, 1))
    small = replace(PART, units=())
    starts = {}
    for lagged in (False, True):
        trials = replace(small, lagged=lagged).groundwork().done(source, "search").selection.finalists
        starts[lagged] = {t.structure.start for t in trials}
        assert lagged or all(t.structure.order == 2 for t in trials)
    assert starts == {False: {"balanced"}, True: {"balanced", "lagged"}}


def test_a_budget_bounds_the_work_and_keeps_the_best_so_far() -> None:
    source = Source(made_plants.hammerstein(300), made_plants.signals_of(1, 1))
    small, large = (replace(PART, minutes=m).groundwork().done(source, "search").selection for m in (1e-5, 0.02))
    assert small.spent < 0.3 * large.spent
    assert np.isfinite(small.chosen.error)
    assert large.chosen.error < small.chosen.error


@pytest.mark.parametrize(
    ("record", "integrates"), [(made_plants.second_order(600), False), (made_plants.integrator(600), True)]
)
def test_a_pole_at_one_stays_only_where_the_plant_integrates(record: Record, integrates: bool) -> None:
    source = Source(record, made_plants.signals_of(1, 1))
    problem = replace(PART, units=()).groundwork().done(source, "search").problem
    search = LinearSearch.of(Rounds(problem, Budget(60.0, len(record), 1), "search"))
    trial = search.finish(search.first_round([2], 0.0))[0]
    at_one = {k: replace(f, model=replace(f.model, a=pole_at_one(f.model.a))) for k, f in trial.fits.items()}
    again = search.settling([CandidateFits(trial.structure, at_one)])[0]
    poles = [np.abs(np.linalg.eigvals(f.model.a)).max() for f in again.fits.values()]
    assert bool(min(poles) > 0.995) is integrates
    assert again.error == pytest.approx(trial.error, rel=0.05)


def test_a_linear_model_that_settles_goes_on_to_settle_over_all_rows() -> None:
    """A third of the record rises by half the plant's motion: over all rows, free runs fit that with a pole at 1."""
    record = made_plants.second_order(600)
    risen = record.pv + 20 * np.maximum(np.arange(600) - 400, 0)[:, None] / 200
    source = Source(replace(record, pv=risen), made_plants.signals_of(1, 1))
    searched = replace(PART, units=(), correction=0.0).groundwork().done(source, "search")
    trial, problem = searched.selection.linear, searched.problem
    assert problem.settles
    for fold in trial.folds:
        fitted = trial.of_fold(fold)[0]
        free = on_all_rows(replace(problem, settles=False), trial.structure, fitted)
        assert slowest_pole(free.model) > INTEGRATES
        assert slowest_pole(on_all_rows(problem, trial.structure, fitted).model) <= INTEGRATES


def pole_at_one(a: np.ndarray) -> np.ndarray:
    return a / np.abs(np.linalg.eigvals(a)).max()


def test_a_larger_candidate_costs_more() -> None:
    budget = Budget(60.0, 1000, 1)
    sizes = [Structure("balanced", n, (0, 0), (0,), h) for n, h in ((2, 0), (4, 0), (4, 8), (8, 8))]
    costs = [budget.of(s, 10) for s in sizes]
    assert costs == sorted(costs)
    assert budget.of(sizes[0], 20) == 2 * costs[0]
