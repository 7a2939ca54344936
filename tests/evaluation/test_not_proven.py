"""The requirements of an own plant's model: in rows, in sentences, at the gate, and in the reasons of withheld laws."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from own_cases import controllers_of_a_lag, two_lags
from rich.console import Console

from loopwright.pipeline.evaluation.evidence_basis import Grounds
from loopwright.pipeline.evaluation.extrapolation import grounds_of
from loopwright.pipeline.evaluation.proof import fit_doubts, sign_doubts, statements
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.report.results import show_results
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.validate import validate
from loopwright.pipeline.tracking.gate import Gate
from loopwright.serving import Controller

ANSWER: dict[str, Any] = {
    "model": 2.0, "low": 1.8, "high": 2.2, "first": 5, "last": 9, "direct": 1.9, "sd": 0.2, "halves": [8.0, 7.0],
    "verdict": "proven", "follows": 0.4,
}  # fmt: skip


def models(missed: float | None = 0.1, **answer: Any) -> dict[str, Any]:
    """metrics.json of a model set with one identified part."""
    proof = {
        "answers": {"y0": {"u0": {**ANSWER, **answer}}},
        "free_run": {"y0": {"missed": missed, "motion": 1.0}},
    }
    part = {"kind": "identified", "per_seed": {"0": {"proof": proof, "outputs": {"y0": {"fit_percent": 35.0}}}}}
    return {"data": {"0": "x"}, "parts": {"identified": part}}


def test_a_proven_model_meets_both_rows() -> None:
    rows = statements({"": models()})
    assert [row.holds for row in rows] == [True, True]
    assert rows[0].what.startswith("model, free-run error of y0 beyond the noise")
    assert (rows[0].limit, rows[0].measured) == ("≤ 0.5, 50 % of its motion there", "0.1")
    assert rows[1].measured == "2 (1.8 … 2.2); one-step predictions 1.9 ± 0.2"
    assert sign_doubts({"": models()}) == fit_doubts({"": models()}) == ""


@pytest.mark.parametrize(
    ("made", "proven"),
    [(models(), True), (models(missed=0.9), False), (models(verdict="opposite"), False), ({}, False)],
)
def test_grounds_say_whether_models_are_proven(
    made: dict[str, Any], proven: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = grounds_of(two_lags(), made, {})
    assert found is not None
    assert found.proven is proven


def test_models_of_which_the_fit_says_nothing_have_no_rows() -> None:
    assert statements({}) == statements({"": {"data": {}, "parts": {}}}) == []
    assert sign_doubts({}) == fit_doubts({}) == ""


def in_closed_loop(nats: float, **answer: Any) -> dict[str, Any]:
    """metrics.json of a model of a record in closed loop."""
    found = models(**answer)
    proof = found["parts"]["identified"]["per_seed"]["0"]["proof"]
    del proof["free_run"]
    proof["one_step"] = {"y0": {"model": 0.1, "with_inputs": 0.1, "without": 0.12, "rows": 900, "nats": nats}}
    return {"": found}


def test_in_closed_loop_the_inputs_must_foresee_something() -> None:
    assert [row.holds for row in statements(in_closed_loop(10.0))] == [True, True]
    assert [row.holds for row in statements(in_closed_loop(9.9))] == [False, True]
    assert fit_doubts(in_closed_loop(9.9))
    assert fit_doubts(in_closed_loop(10.0)) == ""


UNCERTAIN = {"verdict": "uncertain", "direct": 1.0, "sd": 0.5}


@pytest.mark.parametrize(
    ("margin", "nats", "verdict", "ships"),
    [(0.6, 50.0, "uncertain", True), (0.2, 50.0, "uncertain", False), (None, 50.0, "uncertain", False),
     (0.6, 9.9, "uncertain", False), (0.6, 50.0, "opposite", False)],
)  # fmt: skip
def test_an_uncertain_answer_that_all_loops_stand_either_way_refuses_no_controller(
    margin: float | None, nats: float, verdict: str, ships: bool
) -> None:
    """Where the inputs foresee the PV, and the record contradicts nothing."""
    found = in_closed_loop(nats, verdict=verdict, direct=0.1, sd=0.5)
    found[""]["parts"]["identified"]["per_seed"]["0"]["proof"]["sign_margin"] = {"y0": margin}
    assert (sign_doubts(found) == "") is ships


@pytest.mark.parametrize(
    ("nats", "answer", "ships"),
    [
        (50.0, {}, True),  # two standard deviations, and all models of one sign
        (9.9, {}, False),
        (50.0, {"sd": 0.7}, False),
        (50.0, {"low": -0.1}, False),
        (50.0, {"direct": -1.0}, False),
        (50.0, {"direct": None, "sd": None}, False),
        (50.0, {"verdict": "opposite"}, False),
    ],
)
def test_what_is_foreseen_makes_up_for_a_sign_that_is_nearly_certain(
    nats: float, answer: dict[str, Any], ships: bool
) -> None:
    assert (sign_doubts(in_closed_loop(nats, **{**UNCERTAIN, **answer})) == "") is ships


@pytest.mark.parametrize(
    ("nats", "way", "answer", "ships"),
    [
        (5.0, 1, {}, True),  # two standard deviations, and half of the odds that would do by themselves
        (5.0, -1, {}, False),  # the controller, read backwards
        (5.0, 0, {}, False),
        (4.9, 1, {}, False),
        (5.0, 1, {"sd": 0.7}, False),
        (5.0, 1, {"low": -0.1}, False),
        (5.0, 1, {"direct": -1.0}, False),
        (5.0, 1, {"direct": 6.0, "sd": 2.5}, False),  # more than three times the model's
        (5.0, 1, {"verdict": "halves"}, False),
    ],
)
def test_the_sign_by_which_the_old_loop_held_the_plant_decides_what_the_record_leaves_open(
    nats: float, way: int, answer: dict[str, Any], ships: bool
) -> None:
    found = in_closed_loop(nats, **{**UNCERTAIN, **answer})
    found[""]["parts"]["identified"]["per_seed"]["0"]["proof"]["held"] = {"y0": way} if way else {}
    assert (sign_doubts(found) == "") is ships
    known = {"pv": "y0", "input": "u0", "says": "-", "way": -1, "size": False, "verdict": "open"}
    found[""]["parts"]["identified"]["per_seed"]["0"]["proof"]["known"] = [known]
    assert sign_doubts(found) != ""  # somebody says another


REGION = {name: ANSWER[name] for name in ("model", "low", "high", "first", "last", "direct", "sd", "halves", "verdict")}
RISES = {**REGION, "from": 10.0, "to": 40.0, "small": False}
FLAT = {**REGION, "from": 40.0, "to": 60.0, "small": True, "verdict": "opposite"}
FALLS = {**REGION, "from": 60.0, "to": 90.0, "small": False, "model": -1.0, "low": -1.2, "high": -0.8, "direct": -1.1}
UNSURE = {"verdict": "uncertain", "direct": -1.1, "sd": 0.5}


def turned(share: float | None = 0.3, missed: float | None = 0.1, **falls: Any) -> dict[str, Any]:
    """metrics.json of a model whose gain turns its sign."""
    found = models(missed, verdict="turns", low=-0.1, regions=[RISES, FLAT, {**FALLS, **falls}])
    found["parts"]["identified"]["per_seed"]["0"]["proof"]["free_run"]["y0"]["share"] = share
    return {"": found}


@pytest.mark.parametrize(
    ("found", "ships"),
    [
        (turned(), True),
        (turned(**UNSURE), True),  # two standard deviations
        (turned(**{**UNSURE, "sd": 0.8}), False),
        (turned(**{**UNSURE, "high": 0.1}), False),
        (turned(**{**UNSURE, "direct": None, "sd": None}), False),
        (turned(missed=0.51), False),  # no free run
        (turned(missed=None), False),
        (turned(share=0.81), False),  # hardly better than without the inputs
        (turned(share=None), False),
    ],
)
def test_a_gain_that_turns_holds_by_its_regions_where_the_free_run_follows(found: dict[str, Any], ships: bool) -> None:
    assert (sign_doubts(found) == "") is ships
    measured = statements(found)[1].measured
    assert measured.count("u0 at ") == 3
    assert "u0 at 40 … 60: 2, small" in measured


@pytest.mark.parametrize(("nats", "ships"), [(10.0, True), (9.9, False)])
def test_in_closed_loop_a_gain_that_turns_holds_where_its_inputs_foresee_the_pv(nats: float, ships: bool) -> None:
    found = in_closed_loop(nats, verdict="fades", regions=[RISES, FLAT])
    assert (sign_doubts(found) == "") is ships


@pytest.mark.parametrize("missed", [0.51, None])
def test_a_free_run_that_misses_most_is_a_failure(missed: float | None) -> None:
    found = {"": models(missed)}
    assert [row.holds for row in statements(found)] == [False, True]
    assert fit_doubts(found).startswith("not proven: the model misses most of what y0 (")
    assert sign_doubts(found) == ""


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ({"verdict": "uncertain"}, "u0 follows y0 (40 % of its moves) and hardly moves of its own"),
        ({"verdict": "uncertain", "follows": 0.0}, "the record shows too little of it"),
        ({"verdict": "uncertain", "direct": None, "sd": None, "follows": 0.0}, "the record shows too little of it"),
        ({"verdict": "opposite"}, "one-step predictions of the same rows find the other sign"),
        ({"verdict": "halves"}, "a half of the record speaks for the other sign"),
        ({"verdict": "size", "direct": 9.0}, "one-step predictions of the same rows find 4.5 times as much"),
    ],
)
def test_a_gain_that_is_not_certain_says_why_and_what_to_do(answer: dict[str, Any], why: str) -> None:
    found = {"": models(**answer)}
    assert [row.holds for row in statements(found)] == [True, False]
    said = sign_doubts(found)
    assert said.startswith(f"not proven: the model's gain is uncertain in sign (y0 to u0: {why}")
    assert "step_test.csv" in said


def test_what_is_not_proven_stands_in_the_words_the_warning_and_the_manifest() -> None:
    grounds = Grounds({"T": 35.0}, {}, {}, ("not proven: this and that",))
    assert grounds.words.endswith("; not proven: this and that")
    assert grounds.warning == "Not proven: this and that."
    assert grounds.to_dict()["unproven"] == ["not proven: this and that"]
    assert "unproven" not in Grounds({"T": 35.0}, {}, {}).to_dict()


def lag(fitted: dict[str, Any]) -> None:
    """A lag with a PID, in the present folder, whose fit says this."""
    pid = {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 4.0}
    case = controllers_of_a_lag({"pid": pid})
    (case.models.parent / "metrics.json").write_text(json.dumps(fitted))
    for stage in (design, validate):
        stage("it-pid")
    report("it")


def shown() -> str:
    out = io.StringIO()
    show_results(Path("artifacts"), Console(file=out, width=200))
    return out.getvalue()


def test_no_controller_is_shipped_of_a_model_whose_sign_is_uncertain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lag(models(verdict="opposite"))
    assert not Path("artifacts/it/pid.onnx").exists()
    why = json.loads(Path("artifacts/it/pid.json").read_text())["withheld"]
    assert why.startswith("law 'pid' is withheld: it is not proven: the model's gain is uncertain in sign")
    said = shown()
    assert "it: pid is not shipped, because it is not proven: the model's gain is uncertain in sign" in said
    assert "1 of 2 requirements" in said
    page = Path("artifacts/it/report.md").read_text()
    assert "**`pid` was not designed**, because it is not proven: the model's gain is uncertain in sign" in page
    assert "**Not proven: the model's gain is uncertain in sign" in page
    validation = Validation.read(Path("artifacts/it/validation.json"))
    assert validation.grounds is not None
    assert validation.grounds.unproven[0].startswith("not proven: the model's gain is uncertain in sign")
    assert [row.holds for row in validation.requirements] == [True, False]


def test_a_controller_of_a_model_that_misses_most_says_so_everywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lag(models(missed=0.8))
    evidence = Controller("artifacts/it/pid.onnx").manifest.evidence
    assert evidence["on"]["unproven"] == ["not proven: the model misses most of what y0 (0.8) does"]
    assert "not proven: the model misses most" in evidence["on"]["words"]
    validation = Validation.read(Path("artifacts/it/validation.json"))
    assert Gate.of(validation, "pid").refusal() == "not proven: the model misses most of what y0 (0.8) does"
    met, known = sum(bool(r.holds) for r in validation.requirements), len(validation.requirements)
    assert met < known
    said = shown()
    assert f"{met} of {known} requirements" in said
    assert "it: Not proven: the model misses most of what y0 (0.8) does." in said
    assert "Not proven: the model misses most" in Path("artifacts/it/report.html").read_text()
