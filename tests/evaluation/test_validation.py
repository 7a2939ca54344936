"""validation.json: what is written is what is read, and what cannot be read is one clear error."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.evaluation.law_evidence import FormAnalysis, lock_up_text
from loopwright.pipeline.evaluation.leaderboard import CaseStanding
from loopwright.pipeline.evaluation.validation import (
    FILE,
    VALIDATION_SCHEMA,
    CheckedStatement,
    GateRecord,
    GateResult,
    LawResult,
    PaperResult,
    Titles,
    Validation,
)
from loopwright.pipeline.tracking.card import model_description, version_description
from loopwright.pipeline.tracking.gate import Gate

LOCKED = {"steps": {"0": 2, "3": 1}, "held_out_noise": {"1": 1}}


@pytest.fixture
def validation() -> Validation:
    """Two laws, one of which locked up."""
    return Validation(
        case="tank",
        metric="mae",
        best="pid",
        main="steps",
        scenarios={"steps": {law: {"mae": e, "mae_min": e, "mae_max": e, "seeds": 3} for law, e in ERRORS.items()}},
        bounds={"steps": {"nmpc": {"mae": 0.02}}},
        gate=GateRecord(
            "g1",
            {"steps": 1.0},
            "pid",
            "PID",
            1e-3,
            {"steps": 1e-3},
            {"pid": GateResult(1.5, 0, {"steps": 1.5}), "inc": GateResult(0.5, 4, {"steps": 0.5})},
        ),
        laws={
            "pid": LawResult(1, 0, 20.0),
            "inc": LawResult(5, 4, None, LOCKED, True, {"base": FormAnalysis({"radius": 0.9}, ("Not proved.",))}),
        },
        titles=Titles("The tank", "mean absolute error", "MAE", {}, {"pid": "PID"}, {"steps": "Steps"}),
        requirements=(CheckedStatement("fast", "≤ 1 s", "0.5 s", True),),
        claims=(
            CheckedStatement("stable", "yes", "no", False, "noise"),
            CheckedStatement("cheap", "", "not measured", None),
        ),
        paper=(PaperResult(2, "PID", "MAE [m]", 0.1, 0.1, "reproduces", True),),
    )


ERRORS = {"pid": 0.03, "inc": 0.01}


@pytest.fixture
def write(tmp_path: Path) -> Callable[[Any], Path]:
    def write(tree: Any) -> Path:
        path = tmp_path / FILE
        path.write_text(tree if isinstance(tree, str) else json.dumps(tree))
        return path

    return write


def test_what_is_written_is_what_is_read(validation: Validation, write: Callable[[Any], Path]) -> None:
    text = validation.to_json()
    again = Validation.read(write(text))
    assert again == validation
    assert again.to_json() == text
    tree = json.loads(text)
    assert tree["schema"] == VALIDATION_SCHEMA
    assert tree["laws"]["pid"] == {"seeds": 1, "lock_ups": 0, "step_us": 20.0}  # nothing is said where there is nothing
    assert tree["laws"]["inc"]["locked_up"] == LOCKED


def test_what_json_cannot_hold_is_not_written(validation: Validation) -> None:
    with pytest.raises(ValueError, match="JSON"):
        replace(validation, bounds={"steps": {"nmpc": {"mae": float("nan")}}}).to_json()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tree: {**tree, "schema": 2}, r"has schema 2; this release reads schema 1: run `dvc repro`"),
        (lambda tree: {k: v for k, v in tree.items() if k != "schema"}, r"has schema None.*run `dvc repro`"),
        (lambda tree: [tree], r"holds no mapping; run `dvc repro`"),
        (lambda _: "{", r"cannot be read .*run `dvc repro`"),
        (lambda tree: {k: v for k, v in tree.items() if k != "gate"}, r"'gate' is missing; run `dvc repro`"),
        (lambda tree: {**tree, "gates": {}}, r"unknown key 'gates'; did you mean 'gate'.*; run `dvc repro`"),
        (lambda tree: {**tree, "best": 3}, r"\.best is 3; it must be of type str"),
        (
            lambda tree: {**tree, "bounds": {"steps": {"nmpc": {"mae": "low"}}}},
            r"mae is 'low'; it must be a number",
        ),
    ],
)
def test_what_cannot_be_read_is_one_clear_error(
    validation: Validation, write: Callable[[Any], Path], change: Callable[[Any], Any], message: str
) -> None:
    path = write(change(json.loads(validation.to_json())))
    with pytest.raises(PipelineError, match=message) as caught:
        Validation.read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_missing_file_names_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match=r"cannot be read .*run `dvc repro`"):
        CaseStanding.read(tmp_path)


def test_standing_gate_and_card_say_what_the_file_says(validation: Validation, write: Callable[[Any], Path]) -> None:
    standing = CaseStanding.read(write(validation.to_json()).parent)
    assert [(law.law, law.lock_ups, law.ratio) for law in standing.laws] == [("inc", 4, 0.5), ("pid", 0, 1.5)]
    assert standing.reproduced == (1, 1)
    gate = Gate.of(validation, "inc")
    assert (gate.score, gate.baseline, gate.lock_ups) == (0.5, 1.5, 4)
    assert gate.refusal() == "it locked up in 4 of its closed loops"
    assert gate.tags()["locked_up"] == "steps (seeds 0, 3), held_out_noise (seed 1)"
    said = version_description(validation, gate, "run", None)
    assert said.startswith("LOCKED UP in 4 closed loops: steps (seeds 0, 3), held_out_noise (seed 1); do not run it")
    assert "Not proved." in said
    sound = Gate.of(validation, "pid")
    assert "no lock-up" in version_description(validation, sound, "run", None)
    assert "locked_up" not in sound.tags()


def test_without_a_validation_there_is_no_evidence() -> None:
    gate = Gate.of(None, "pid")
    assert gate.refusal() == "its validation has no gate score"
    assert "gate_baseline" not in gate.tags()  # only a case names its baseline
    assert version_description(None, gate, "run", None).startswith("No closed-loop evidence yet")
    assert "<b>pid</b> for tank" in model_description("tank", "pid", None, None)


def test_lock_ups_name_tests_and_seeds() -> None:
    assert lock_up_text(LOCKED) == "steps (seeds 0, 3), held_out_noise (seed 1)"
    assert lock_up_text({}) == ""
