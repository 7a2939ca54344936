"""A law of an own plant whose tuned numbers do not hold is shipped with calmer ones, where these do."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from own_cases import controllers_of_a_lag
from undrawn import draw_nothing

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.evaluation.law_evidence import LawMetrics
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.laws.pid import tuned
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.validate import validate
from loopwright.pipeline.tuning.rules import PidSettings
from loopwright.serving.card import card
from loopwright.serving.controller import Controller

ARTIFACTS = Path("artifacts/it")
SEARCHED = {"law": "pid", "tuning": "optimized"}


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    draw_nothing(monkeypatch)


def run(monkeypatch: pytest.MonkeyPatch, found: PidSettings, factor: float = 1.0) -> tuple[Validation, LawMetrics]:
    """A PID whose search finds these numbers; its calmer ones have ``factor`` times the gain."""
    monkeypatch.setattr(tuned, "searched", lambda *_: (1.0, (found,)))
    monkeypatch.setattr(tuned, "calmest", lambda _: SimpleNamespace(loops=(found,)))
    calm = tuned.calm
    monkeypatch.setattr(
        tuned, "calm", lambda *given: tuple(replace(s, kc=factor * s.kc, ti_s=s.ti_s / factor) for s in calm(*given))
    )
    controllers_of_a_lag({"pid": SEARCHED})
    design("it-pid")
    validate("it-pid")
    report("it")
    return Validation.read(ARTIFACTS / "validation.json"), LawMetrics.read(Path("work/it/validation/pid/metrics.json"))


def test_numbers_that_end_in_a_limit_cycle_give_way_to_calmer_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    hot = PidSettings(2.0, 3.0)
    found, own = run(monkeypatch, hot)
    assert found.best == "pid"
    assert own.calmed.startswith("ends in a limit cycle (y0 swings by ± ")
    assert not own.poor
    assert not own.locked_up
    assert "held_out" not in own.cycles
    controller = Controller(ARTIFACTS / "pid.onnx")
    evidence = controller.manifest.evidence
    assert evidence["calmed"] == own.calmed
    assert 0 < evidence["analysis"]["kc"] <= 0.5 * hot.kc
    assert own.calmed in card(controller)
    # The figures are those of the file that is shipped.
    assert own.forms["base"].tests["held_out"].median["mae"] == evidence["scenarios"]["held_out"]["mae"]
    assert own.calmed in (ARTIFACTS / "report.md").read_text()


def test_numbers_that_hold_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    good = PidSettings(0.2, 3.0)
    found, own = run(monkeypatch, good)
    assert found.best == "pid"
    assert own.calmed == ""
    evidence = Controller(ARTIFACTS / "pid.onnx").manifest.evidence
    assert "calmed" not in evidence
    assert evidence["analysis"]["kc"] == pytest.approx(good.kc)


def test_where_calmer_numbers_do_not_hold_the_reason_of_the_first_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    found, own = run(monkeypatch, PidSettings(2.0, 3.0), factor=40.0)
    assert found.best is None
    assert own.calmed == ""
    assert own.poor.startswith("ends in a limit cycle")
    assert not (ARTIFACTS / "pid.onnx").exists()
    why = json.loads((ARTIFACTS / "pid.json").read_text())["withheld"]
    assert "ends in a limit cycle" in why
    with np.load("work/it/validation/pid/trajectories.npz") as kept:
        assert any(name.startswith("cycling/") for name in kept.files)


def test_a_last_resort_that_cannot_be_made_withholds_no_law(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_: PID) -> PID:
        raise LawError("no calmer numbers")

    monkeypatch.setattr(PID, "calmed", refused)
    found, own = run(monkeypatch, PidSettings(0.2, 3.0))
    assert found.best == "pid"
    assert own.calmed == ""
    assert (ARTIFACTS / "pid.onnx").is_file()
