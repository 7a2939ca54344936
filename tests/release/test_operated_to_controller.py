"""From a historian's export to a law that operators steer: the tutorial's commands, with smaller numbers."""

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
from loopwright.serving.explain import Explainer

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
from pages import blocks
from test_manual_code_blocks import commands_of

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "docs/tutorials/operators_steer.md"
COMMANDS = [words for block in blocks(TUTORIAL) if block.language == "sh" for words in commands_of(block)]
SMALL = {"kind": "identified", "units": [], "minutes": 0.15, "rows": 1500}


def command(name: str) -> list[str]:
    """The words of the tutorial's only command of this name."""
    (found,) = [words[1:] for words in COMMANDS if words[:2] == ["loopwright", name]]
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which every stage of the tutorial's plant has run."""
    path = tmp_path_factory.mktemp("own")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        patch.setattr(sys, "argv", ["make_export.py", "basin.csv"])
        runpy.run_path(str(ROOT / "examples/operated_plant/make_export.py"), run_name="__main__")
        Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")
        with pytest.MonkeyPatch.context() as undrawn:  # only the report's pictures are looked at
            draw_nothing(undrawn)
            assert main(command("new")) == 0
            screen("basin")
        tree = yaml.safe_load(Path("params.yaml").read_text())
        shown = next(b for b in blocks(TUTORIAL) if b.language == "yaml")
        assert {"basin-predictive": tree["controllers"]["basin-predictive"]} == yaml.safe_load(shown.text)
        for part in tree["models"]["basin-identified"]["parts"].values():
            part |= SMALL
        tree["cases"]["basin"]["held_out_seeds"] = [9001]
        law = tree["controllers"]["basin-predictive"]
        law |= {"tuning": "given", "speed": 0.5}
        law["operate"] |= {f"FV-{i}.max_move": 4.0 for i in (1, 2, 3)}
        tree["controllers"]["basin-pid"] |= {"development_seeds": [1], "development_set_points": 3}
        Path("params.yaml").write_text(yaml.safe_dump(tree))
        assert mistakes() == []
        fit("basin-identified")
        for name in ("basin-predictive", "basin-pid"):
            design(name)
            validate(name)
        report("basin")
        overview()
    return path


def test_the_file_has_what_the_record_was_given(folder: Path) -> None:
    path = folder / "artifacts/basin/predictive.onnx"
    manifest = Controller(path).manifest
    assert [s.name for s in manifest.sp] == ["TIC-1", "LIC-2"]
    assert [s.name for s in manifest.pv] == ["TIC-1", "LIC-2", "FI-4"]
    defaults = {e.name: e.default for e in manifest.operate}
    assert (defaults["LIC-2.low"], defaults["FI-4.high"], defaults["FI-4.track"]) == (20.0, 9.0, 0.0)
    assert (defaults["FV-1.cost"], defaults["FV-3.rest"], defaults["FV-3.rest_use"]) == (1.0, 60.0, 1.0)
    assert Explainer(path.with_suffix(".explain.onnx")).controller.manifest == manifest


def test_the_report_and_the_overview_have_the_tests_of_operators_changes(folder: Path) -> None:
    tests = {"narrowed", "taken_out", "costs", "pushed", "at_odds", "resting"}
    text = (folder / "artifacts/basin/report.md").read_text()
    assert "## Operators' changes" in text
    for test in tests:
        assert (folder / f"artifacts/basin/figures/operated_predictive_{test}.png").stat().st_size > 10_000
        assert f"figures/operated_predictive_{test}.png" in text
    validation = json.loads((folder / "artifacts/basin/validation.json").read_text())
    assert set(validation["laws"]["predictive"]["operated"]) == tests
    assert "% of the profit to be gained" in (folder / "artifacts/report.md").read_text()


def test_the_changes_of_the_tutorial_are_simulated(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    capsys.readouterr()
    assert main([*command("simulate"), "--picture", "run.png", "--csv", "run.csv"]) == 0
    rows = np.genfromtxt("run.csv", delimiter=",", names=True, deletechars="", usecols=range(12))
    time_s, cold = rows["time_s"], rows[next(n for n in rows.dtype.names if n.startswith("FV-2"))]
    out = (time_s >= 1800) & (time_s < 2700)
    assert len(set(cold[out])) == 1
    assert len(set(cold[~out])) > 100
    level = rows[next(n for n in rows.dtype.names if n.startswith("LIC-2"))]
    assert level[(time_s > 300) & (time_s < 600)].mean() == pytest.approx(40.0, abs=1.0)
    said = capsys.readouterr().out
    assert "FV-2 out of use for 21.4 % of the time" in said
    assert "LIC-2 follows no set point for 85.7 % of the time" in said


def test_valves_rest_where_a_range_and_a_set_point_are_at_odds(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the cold valve held, 7 l/s and 46 degC cannot both be had."""
    monkeypatch.chdir(folder)
    changes = ("LIC-2.track=false", "LIC-2.low=35", "LIC-2.high=45", "FV-2.high=33@600", "FI-4.low=7@1200")
    given = [word for change in changes for word in ("--operate", change)]
    wanted = ["--sp", "TIC-1=46", "--sp", "LIC-2=40", "--duration", "3600"]
    files = ["--picture", "odds.png", "--csv", "odds.csv"]
    assert main(["simulate", "artifacts/basin/predictive.onnx", *given, *wanted, *files]) == 0
    rows = np.genfromtxt("odds.csv", delimiter=",", names=True, deletechars="", usecols=range(13))
    of = {tag: rows[next(n for n in rows.dtype.names if n.startswith(tag))][-60:] for tag in ("FI-4", "FV-1", "FV-3")}
    assert of["FI-4"].mean() > 6.9
    for valve in ("FV-1", "FV-3"):
        assert np.abs(np.diff(of[valve])).mean() < 0.05  # % a scan; up and down by its largest move that would be 4
