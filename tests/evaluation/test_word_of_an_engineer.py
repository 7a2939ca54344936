"""What an engineer knows of the plant, as requirements of its model, as the last word, and as a question."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from own_cases import controllers_of_a_lag

from loopwright.pipeline.evaluation.proof import known_rows, question, sign_doubts, statements
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.validate import validate

ANSWER: dict[str, Any] = {
    "model": 2.0, "low": -0.2, "high": 2.2, "first": 5, "last": 9, "direct": 1.0, "sd": 1.0, "halves": [1.0, 0.5],
    "verdict": "uncertain", "follows": 0.4,
}  # fmt: skip
SAID: dict[str, Any] = {
    "pv": "y0", "input": "u0", "says": "+", "way": 1, "size": False, "gain": 2.1, "spread": 0.1, "rate": False,
    "direct": 1.0, "sd": 1.0, "verdict": "open",
}  # fmt: skip
ASKED = {"way": -1, "says": "-", "verdict": "contradicted", "question": "y0/u0: which is it?"}


def models(said: dict[str, Any] | None = None, **answer: Any) -> dict[str, Any]:
    """metrics.json of a model set with one identified part."""
    proof = {"answers": {"y0": {"u0": {**ANSWER, **answer}}}, "free_run": {"y0": {"missed": 0.1, "motion": 1.0}}}
    known = {} if said is None else {"known": [{**SAID, **said}]}
    outputs = {"y0": {"fit_percent": 35.0}}
    part = {"kind": "identified", "per_seed": {"0": {"proof": proof | known, "outputs": outputs}}}
    return {"data": {"0": "x"}, "parts": {"identified": part}}


@pytest.mark.parametrize(
    ("said", "answer", "ships"),
    [
        (None, {}, False),
        ({}, {}, True),
        ({}, {"verdict": "opposite"}, False),  # one-step predictions have found the other sign
        ({}, {"verdict": "halves"}, False),
        ({}, {"model": -2.0}, False),  # the model has the other sign
        ({}, {"verdict": "proven", "model": -2.0}, False),
        ({"way": 0, "says": "dead 1..2"}, {}, False),  # no sign is said
        ({}, {"sd": 6.0}, False),  # the size is open: three times the model's answer and more
        ({}, {"direct": None, "sd": None}, False),
        ({"size": True, "says": "gain 1..3"}, {"sd": 6.0}, True),  # somebody says it
        ({"size": True, "says": "gain 1..3"}, {"direct": None, "sd": None}, True),
        ({"size": True, "says": "gain 9..30", "verdict": "model"}, {}, False),  # and the model has another
        ({"input": "u1"}, {}, False),
        (ASKED, {"verdict": "proven"}, False),
    ],
)
def test_an_engineers_word_decides_what_the_record_leaves_open(
    said: dict[str, Any] | None, answer: dict[str, Any], ships: bool
) -> None:
    found = {"": models(said, **answer)}
    assert (sign_doubts(found) == "") is ships
    if said is None or "question" not in said:  # a question has a row of its own
        assert statements(found)[-1].holds is ships


@pytest.mark.parametrize(
    ("said", "holds"),
    [({}, True), ({"verdict": "agrees"}, True), ({"verdict": "model"}, False), (ASKED, False),
     ({"direct": None, "sd": None}, True)],
)  # fmt: skip
def test_each_statement_has_a_row(said: dict[str, Any], holds: bool) -> None:
    (row,) = known_rows({"": models(said)})
    assert row.holds is holds
    assert (question({"": models(said)}) != "") is ("question" in said)


def test_a_statement_on_a_variable_without_a_model_is_not_compared() -> None:
    found = models({})
    proof = found["parts"]["identified"]["per_seed"]["0"]["proof"]
    proof["known"] = [{"pv": "y9", "input": "u0", "says": "+", "way": 1, "size": False, "verdict": "unused"}]
    assert [row.holds for row in known_rows({"": found})] == [None]
    assert known_rows({}) == known_rows({"": models()}) == []


@pytest.mark.parametrize("simulator", [False, True])
def test_nothing_is_shipped_before_a_question_is_answered(
    simulator: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A simulator proves models itself; but what is asked is asked."""
    monkeypatch.chdir(tmp_path)
    case = controllers_of_a_lag({"pid": {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 4.0}})
    if simulator:
        monkeypatch.setattr(type(case), "stand_in", "simulator", raising=False)
        monkeypatch.setattr("loopwright.pipeline.cases.own_plant.OwnCase.stand_in", "simulator", raising=False)
    (case.models.parent / "metrics.json").write_text(json.dumps(models(ASKED, verdict="proven")))
    for stage in (design, validate):
        stage("it-pid")
    report("it")
    assert not Path("artifacts/it/pid.onnx").exists()
    assert ASKED["question"] in json.loads(Path("artifacts/it/pid.json").read_text())["withheld"]
    assert str(ASKED["question"]) in Path("artifacts/it/report.md").read_text()
    validation = Validation.read(Path("artifacts/it/validation.json"))
    assert [row.holds for row in validation.requirements][-1] is False


def test_a_word_that_decides_stands_in_the_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    case = controllers_of_a_lag({"pid": {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 4.0}})
    (case.models.parent / "metrics.json").write_text(json.dumps(models({})))
    for stage in (design, validate):
        stage("it-pid")
    report("it")
    assert Path("artifacts/it/pid.onnx").exists()
    validation = Validation.read(Path("artifacts/it/validation.json"))
    assert [row.holds for row in validation.requirements[:3]] == [True, True, True]
