"""Laws on plants gone wrong, each kind for itself, and the dead time as the remedy where it alone is to blame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from own_cases import controllers_of_a_lag

from loopwright.pipeline.cases.own_model import FAST, LATE, SLOW, GoneWrong, errors_of
from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import BASE, Form, LawEvidence, LawMetrics, OverSeeds
from loopwright.pipeline.report.own_acceptance import (
    LATE_ALONE_FACTOR,
    against,
    dead_time_to_state,
    late_factor,
    own_acceptance,
    wrong_rows,
)

SEEDS = ("9001", "9002", "9003")
TESTS = ("held_out", "held_out_noise", "load", "spoilt")


def case_of(dead_sd: float) -> OwnCase:
    """A lag whose record leaves its dead time open by so many periods, and three sequences of each test."""
    case = controllers_of_a_lag({})
    file = case.models / "identified.npz"
    with np.load(file) as found:
        np.savez(file, **dict(found) | {"dead_sd": np.array([dead_sd])})
    return type(case)((9001, 9002, 9003))


def law(name: str, held_out: float, spoilt: tuple[float, float, float]) -> LawEvidence:
    mean = {"mae": float(np.mean(spoilt)), "max_asse": 0.0}
    rows = {test: {"mae": held_out, "max_asse": 0.0} for test in TESTS} | {"spoilt": mean}
    form = Form({}, (), {test: OverSeeds(row, row, row, {"0": row}) for test, row in rows.items()})
    each: Mapping[str, Mapping[str, Mapping[str, float]]] = {
        "held_out": {seed: {"mae": held_out} for seed in SEEDS},
        "spoilt": {seed: {"mae": error} for seed, error in zip(SEEDS, spoilt, strict=True)},
    }
    metrics = LawMetrics(
        name, name, "mae", (0,), 0, {BASE: form}, development={"0": held_out}, development_travel={"0": 1.0},
        sequences=each,
    )  # fmt: skip
    return LawEvidence(metrics, Path())


def evidence(case: OwnCase, *laws: LawEvidence) -> Evidence:
    bounds = {test: {"nmpc": {"mae": 0.08}} for test in TESTS}
    return Evidence(case, bounds, {one.metrics.name: one for one in laws}, {}, own_data=True)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


POOR_LATE = law("predictive", 0.1, (0.2, 0.15, 0.6)), law("pid", 0.2, (0.3, 0.3, 0.4))


def test_each_kind_has_its_errors_and_how_much_they_grew() -> None:
    found = evidence(case_of(dead_sd=1.5), *POOR_LATE)
    rows = wrong_rows(found)
    assert [(row.test, row.kind) for row in rows] == [("spoilt", kind) for kind in (SLOW, FAST, LATE)]
    assert [dict(row.errors) for row in rows] == [
        {"predictive": 0.2, "pid": 0.3}, {"predictive": 0.15, "pid": 0.3}, {"predictive": 0.6, "pid": 0.4},
    ]  # fmt: skip
    assert [row.grown["predictive"] for row in rows] == pytest.approx([2.0, 1.5, 6.0])
    assert late_factor(found, "predictive") == pytest.approx(3.0)
    assert late_factor(found, "pid") == pytest.approx(4 / 3)


def test_kinds_in_the_title_and_in_the_rows_are_the_same_words() -> None:
    case = case_of(dead_sd=1.5)
    title = case.scenarios()["spoilt"][0].title
    rows = wrong_rows(evidence(case, *POOR_LATE))
    assert [row.words for row in rows] == [str(wrong.as_likely) for wrong in errors_of(case.plant)]  # type: ignore[arg-type]
    assert all(row.words in title for row in rows)
    assert str(GoneWrong(LATE, {"gain_u0": 1.0, "time_constant": 1.0, "dead_time": 3.0})).endswith("3 periods later")


def test_where_lateness_alone_is_to_blame_the_dead_time_is_asked_for_by_the_option_of_the_pair() -> None:
    found = evidence(case_of(dead_sd=1.5), *POOR_LATE)
    assert '--known "y0/u0=dead FROM..TO" (by the models 0 to 3)' in dead_time_to_state(found, "predictive")
    assert dead_time_to_state(found, "pid") == ""
    (row,) = [r for r in own_acceptance(found) if r.what.startswith("predictive, spoilt")]
    assert (row.holds, "--known" in row.because) == (True, False)  # .317 against .333
    worse = evidence(case_of(dead_sd=1.5), law("predictive", 0.1, (0.2, 0.15, 0.9)), POOR_LATE[1])
    (row,) = [r for r in own_acceptance(worse) if r.what.startswith("predictive, spoilt")]
    assert (row.holds, "--known" in row.because) == (False, True)
    (line,) = against(worse)
    assert "by the models 0 to 3" in line["words"]


def test_a_model_that_acts_late_already_is_later_still() -> None:
    part = {"dead_times": {"u0": 2.0}}
    models = {"identified": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": part}}}}}
    found = replace(evidence(case_of(dead_sd=1.5), *POOR_LATE), models=models)
    assert '--known "y0/u0=dead FROM..TO" (by the models 2 to 5)' in dead_time_to_state(found, "predictive")


@pytest.mark.parametrize(("late", "asks"), [(LATE_ALONE_FACTOR * 0.2 * 1.01, True), (0.2 * 1.01, False)])
def test_a_late_plant_is_to_blame_from_a_factor_on(late: float, asks: bool) -> None:
    found = evidence(case_of(dead_sd=1.5), law("predictive", 0.1, (0.2, 0.15, late)), POOR_LATE[1])
    assert bool(dead_time_to_state(found, "predictive")) is asks


def test_without_late_plants_or_figures_of_sequences_nothing_is_asked() -> None:
    known = evidence(case_of(dead_sd=0.2), *POOR_LATE)
    assert {row.kind for row in wrong_rows(known)} == {SLOW, FAST}
    assert late_factor(known, "predictive") is None
    assert dead_time_to_state(known, "predictive") == ""
    bare = replace(POOR_LATE[0], metrics=replace(POOR_LATE[0].metrics, sequences={}))
    assert wrong_rows(evidence(case_of(dead_sd=1.5), bare)) == []
