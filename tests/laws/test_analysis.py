"""A law's analysis from design to the evidence that the report reads: every form's figures and arrays, of one seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.config.params import ControllerParams
from loopwright.pipeline.evaluation.law_evidence import Form, LawEvidence, LawMetrics
from loopwright.pipeline.evaluation.law_evidence import FormAnalysis as Said
from loopwright.pipeline.laws.base import Analysis
from loopwright.pipeline.stages.design import _analysed
from loopwright.pipeline.stages.paths import analysis_file
from loopwright.pipeline.stages.validate import _keep_analysis

PLANT = PLANTS["batch_reactor"]()
PARAMS = ControllerParams(
    "batch_reactor", "pid", "pid", "linearized", {"r": 1.0}, {"r=2": {"r": 2.0}, "r=3": {"r": 3.0}}
)


class Told:
    """A law with an analysis."""

    def __init__(self, radius: float) -> None:
        self.radius = radius

    def analysis(self, plant: Any) -> Analysis:
        assert plant is PLANT
        return Analysis({"radius": np.float64(self.radius)}, {"starts": np.full((2, 3), self.radius)}, ("said",))


class Silent:
    """A law without one, as nearly all are."""

    def analysis(self, plant: Any) -> Analysis:
        return Analysis()


@pytest.fixture
def designed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, Any]]:
    """What design says of the forms of two seeds; the form r=3 has no analysis."""
    monkeypatch.chdir(tmp_path)
    found = {}
    for seed in (0, 1):
        for form, law in {"base": Told(0.5 + seed), "r=2": Told(0.7 + seed), "r=3": Silent()}.items():
            path = analysis_file(PARAMS.case, PARAMS.law, form, seed)
            path.parent.mkdir(parents=True, exist_ok=True)
            found[f"{form}/{seed}"] = _analysed(law, PLANT, path)  # type: ignore[arg-type]
    return found


def test_design_tells_what_there_is(designed: dict[str, dict[str, Any]]) -> None:
    assert designed["base/1"] == {"analysis": {"figures": {"radius": 1.5}, "notes": ["said"]}}
    assert designed["r=3/0"] == {}
    assert not analysis_file(PARAMS.case, PARAMS.law, "r=3", 0).exists()


def test_the_report_finds_the_shipped_seeds(designed: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    _keep_analysis(PARAMS, 1, tmp_path / "analysis.npz")
    said = {form: Said(**designed[f"{form}/1"]["analysis"]) for form in ("base", "r=2")}
    forms = {
        name: Form(setting, (), {}, said.get(name))
        for name, setting in {"base": {"r": 1.0}, "r=2": {"r": 2.0}, "r=3": {"r": 3.0}}.items()
    }
    law = LawEvidence(LawMetrics("pid", "PID", "mae", (0,), 0, forms), tmp_path / "trajectories.npz")
    assert {form: analysis.figures for form, analysis in law.analyses.items()} == {
        "base": {"radius": 1.5},
        "r=2": {"radius": 1.7},
    }
    assert law.form({"r": 9.0}) is None
    assert np.array_equal(law.analysis_arrays({"r": 2.0})["starts"], np.full((2, 3), 1.7))
    assert law.analysis_arrays({"r": 3.0}) == law.analysis_arrays({"r": 9.0}) == {}


def test_no_analysis_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _keep_analysis(PARAMS, 0, tmp_path / "analysis.npz")
    assert not (tmp_path / "analysis.npz").exists()
