"""Files of an own plant are started cold at rests of its record; one that asks for another MV there is not shipped."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from own_cases import controllers_of_a_lag
from undrawn import draw_nothing

from loopwright.pipeline.evaluation.law_evidence import LawMetrics
from loopwright.pipeline.evaluation.poor_laws import COLD_FAR
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.validate import validate
from loopwright.serving.controller import Controller

PI = {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 3.0}
ARTIFACTS = Path("artifacts/it")
LONG_HOLDS = 40  # rows; the plant settles in 10
BIAS = 0.4  # V, of a range of 2 V


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    draw_nothing(monkeypatch)


def validated(name: str) -> tuple[Validation, LawMetrics]:
    design(f"it-{name}")
    validate(f"it-{name}")
    report("it")
    found = Validation.read(ARTIFACTS / "validation.json")
    return found, LawMetrics.read(Path(f"work/it/validation/{name}/metrics.json"))


def requirement_of(found: Validation) -> bool | None:
    rows = [r.holds for r in found.requirements if "cold start" in r.what]
    return rows[0] if len(rows) == 1 else None


def test_a_healthy_file_keeps_the_records_mv_and_is_shipped() -> None:
    case = controllers_of_a_lag({"pid": PI}, rows_a_hold=LONG_HOLDS)
    found, own = validated("pid")
    assert own.cold_start is not None
    assert own.cold_start.rests == len(case.recorded_rests) > 5
    assert own.cold_start.farthest == pytest.approx(0.0, abs=1e-6)
    assert found.laws["pid"].cold_start == own.cold_start
    assert requirement_of(found) is True
    assert Controller(ARTIFACTS / "pid.onnx").manifest.evidence["cold_start"]["rests"] == own.cold_start.rests


def test_a_file_with_another_rest_is_withheld(monkeypatch: pytest.MonkeyPatch) -> None:
    """After its first step it is the healthy one, so that no closed loop says anything."""
    plain = PID.forward

    def biased(self: PID, sp: torch.Tensor, pv: torch.Tensor, dv: torch.Tensor, mv: torch.Tensor, state: torch.Tensor):
        asked, after, info = plain(self, sp, pv, dv, mv, state)
        begins = torch.where(state[..., :1] > 0, 0.0 * mv, 0.0 * mv + BIAS)
        return torch.clamp(asked + begins, self.low, self.high), after, info

    monkeypatch.setattr(PID, "forward", biased)
    controllers_of_a_lag({"pid": PI}, rows_a_hold=LONG_HOLDS)
    found, own = validated("pid")
    assert own.cold_start is not None
    assert own.cold_start.first == pytest.approx(100 * BIAS / 2.0)
    assert own.cold_start.first > COLD_FAR
    assert own.cold_start.later == pytest.approx(0.0, abs=1e-6)
    assert own.cold_start.mv == "u0"
    assert set(own.cold_start.at) == {"y0", "u0"}
    assert not own.locked_up
    assert not own.cycles
    assert found.best is None
    assert found.laws["pid"].withheld == own.poor != ""
    assert requirement_of(found) is False
    assert not (ARTIFACTS / "pid.onnx").exists()
    assert own.poor.rpartition("; ")[0] in json.loads((ARTIFACTS / "pid.json").read_text())["withheld"]


def test_a_record_without_a_rest_withholds_nothing() -> None:
    controllers_of_a_lag({"pid": PI}, rows_a_hold=3)
    found, own = validated("pid")
    assert own.cold_start is not None
    assert (own.cold_start.rests, own.cold_start.first) == (0, None)
    assert requirement_of(found) is None
    assert found.best == "pid"


def test_a_soft_limit_takes_the_rests_beyond_it_away() -> None:
    """A predictive law leaves a process variable that lies beyond its limit."""
    free = {"law": "predictive", "tuning": "given"}
    controllers_of_a_lag({"free": free, "walled": free | {"cv_high": [0.0]}}, rows_a_hold=LONG_HOLDS)
    _, of_free = validated("free")
    _, of_walled = validated("walled")
    assert of_free.cold_start is not None
    assert of_walled.cold_start is not None
    assert 0 < of_walled.cold_start.rests < of_free.cold_start.rests
    assert of_free.cold_start.farthest == pytest.approx(0.0, abs=0.1)
    assert of_walled.cold_start.farthest == pytest.approx(0.0, abs=0.1)
