"""From a historian's export to a controller file and its report: the example of the README, with small numbers."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from undrawn import draw_nothing

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.stages.check import mistakes
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.fit import fit
from loopwright.pipeline.stages.overview import overview
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.screen import screen
from loopwright.pipeline.stages.validate import validate
from loopwright.serving import Controller
from loopwright.serving.card import card

ROOT = Path(__file__).parents[2]
ROLES = ("--pv", "TIC-101.PV[degC]=0..120", "--mv", "TIC-101.OP[%]=0..100", "--dv", "FI-7[kg/h]", "--sp", "TIC-101.SP")
# The plant settles in 27 minutes, so that predictive control looks as far; a test has a sixth of the samples.
PERIOD = ("--period", "60")
# A third of it gives another controller for each phase of the rows: 1.06 to 1.24 and 1.86 beside its PID's 1.17.
SMALL = {"kind": "identified", "orders": [2, 4], "units": [4], "minutes": 0.15, "rows": 1500}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which every stage of an own plant has run."""
    path = tmp_path_factory.mktemp("own")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        patch.setattr(sys, "argv", ["make_export.py", "export.csv"])
        runpy.run_path(str(ROOT / "examples/own_plant/make_export.py"), run_name="__main__")
        Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")
        with pytest.MonkeyPatch.context() as undrawn:  # only the report's pictures are looked at
            draw_nothing(undrawn)
            assert main(["new", "tank", "export.csv", *ROLES, *PERIOD]) == 0
            screen("tank")
        tree = yaml.safe_load(Path("params.yaml").read_text())
        for part in tree["models"]["tank-identified"]["parts"].values():
            part |= SMALL
        tree["cases"]["tank"]["held_out_seeds"] = [9001]
        tree["controllers"]["tank-predictive"] |= {"tuning": "given", "horizon": 12, "moves": 4}
        tree["controllers"]["tank-pid"] |= {"development_seeds": [1], "development_set_points": 3}
        Path("params.yaml").write_text(yaml.safe_dump(tree))
        assert mistakes() == []
        fit("tank-identified")
        for name in ("tank-predictive", "tank-pid"):
            design(name)
            validate(name)
        report("tank")
        overview()
    return path


def test_each_controller_is_one_file_that_says_what_it_was_tested_on(folder: Path) -> None:
    for name in ("predictive", "pid"):
        controller = Controller(folder / f"artifacts/tank/{name}.onnx")
        manifest = controller.manifest
        assert manifest.evidence["plant"] == "identified"
        assert manifest.evidence["on"]["fit"]["TIC-101.PV"] > 80
        assert "on models identified from your data" in card(controller)
        assert manifest.evidence["lock_ups"] == 0
        assert [s.name for s in (*manifest.sp, *manifest.mv, *manifest.dv)] == ["TIC-101.PV", "TIC-101.OP", "FI-7"]
        step = controller.step(sp=[60.0], pv=[55.0], dv=[900.0], mv_applied=[50.0], state=controller.cold_state())
        assert 0 <= step.mv[0] <= 100


def test_the_report_says_models_and_no_paper(folder: Path) -> None:
    text = (folder / "artifacts/tank/report.md").read_text()
    assert "On models identified from your data" in text
    assert "paper" not in text.lower()
    assert "no bounds" not in text
    assert "free-run fit over unseen rows: TIC-101.PV" in text
    html = (folder / "artifacts/tank/report.html").read_text()
    for heading in ("The model of the plant", "Replay over the record"):
        assert f"## {heading}" in text
        assert f">{heading}</h2>" in html
    for picture in ("model_free_run", "model_step_responses", "model_gains", "replay_predictive", "replay_pid"):
        assert (folder / f"artifacts/tank/figures/{picture}.png").stat().st_size > 10_000
        assert f"figures/{picture}.png" in html
    validation = json.loads((folder / "artifacts/tank/validation.json").read_text())
    assert validation["on_models"] is True
    assert set(validation["grounds"]) == {"record", "fit", "set_points", "loops", "farthest", "proven"}
    assert 1 <= validation["gate"]["laws"]["predictive"]["score"] < validation["gate"]["laws"]["pid"]["score"]
    assert validation["bounds"]["held_out"]["nmpc"]["failures"] == 0
    tests = validation["scenarios"]
    assert {"held_out", "held_out_noise", "spoilt", "load"} <= set(tests)
    assert all(np.isfinite(row["mae"]) for laws in tests.values() for row in laws.values())
    assert "Models as likely as this one differ by" in text
    assert "% in the gain of TIC-101.OP" in text
    assert "The tests ask for TIC-101.PV from " in text


def test_the_overview_lists_the_plant(folder: Path) -> None:
    assert "tank" in (folder / "artifacts/report.md").read_text().lower()
