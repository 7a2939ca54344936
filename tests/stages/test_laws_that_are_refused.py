"""Laws that cannot be designed for an own plant: which errors withhold a law, and what the case then shows."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from own_cases import controllers_of_a_lag
from rich.console import Console
from undrawn import draw_nothing

from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.errors import LawError, ModelError, ParamsError, PlantError, RecordError
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.report.results import show_results, without_controller
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.validate import validate
from loopwright.pipeline.tracking.gate import Gate

GIVEN = {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 3.0}


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no picture is drawn: the words of the reports are looked at."""
    monkeypatch.chdir(tmp_path)
    draw_nothing(monkeypatch)


@pytest.fixture
def plant(_in_a_folder_of_its_own: None) -> None:
    controllers_of_a_lag({"pid": GIVEN})


def reason_of(law: str) -> str:
    return str(json.loads(Path(f"artifacts/it/{law}.json").read_text())["withheld"])


@pytest.mark.parametrize("kind", [LawError, ModelError, PlantError, ParamsError, RecordError])
def test_every_error_of_ours_in_a_design_withholds_the_law(
    plant: None, monkeypatch: pytest.MonkeyPatch, kind: type[Exception]
) -> None:
    def refuses(*_: object) -> None:
        raise kind("the valve is stuck")

    monkeypatch.setattr(PID, "design", refuses)
    design("it-pid")
    validate("it-pid")
    assert reason_of("pid") == "law 'pid' is withheld: the valve is stuck"


def test_equations_without_a_solution_withhold_the_law_in_words(plant: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PID, "design", lambda *_: np.linalg.inv(np.zeros((2, 2))))
    design("it-pid")
    validate("it-pid")
    assert reason_of("pid") == (
        "law 'pid' is withheld: its equations have no single solution over the model of the plant (Singular matrix)"
    )


@pytest.mark.parametrize("error", [TypeError("a bug"), KeyError("a bug"), ZeroDivisionError("a bug")])
def test_a_mistake_in_the_program_ends_the_run(plant: None, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(PID, "design", fails)
    with pytest.raises(type(error)):
        design("it-pid")
    assert not Path("work/it/controllers/pid/metrics.json").exists()


def test_models_that_cannot_be_read_end_the_run(plant: None) -> None:
    """They are not the law's: no other law could be designed on them either."""
    Path("work/it/models/identified/seed0/plant1.npz").write_bytes(b"cut off")
    with pytest.raises(ModelError):
        design("it-pid")


def designed_and_validated(*names: str) -> Validation:
    for name in names:
        design(f"it-{name}")
        validate(f"it-{name}")
    report("it")
    return Validation.read(Path("artifacts/it/validation.json"))


def pages() -> tuple[str, str]:
    """The report as Markdown, and the terminal's table."""
    show_results(Path("artifacts"), Console(file=(terminal := io.StringIO())))
    return Path("artifacts/it/report.md").read_text(), terminal.getvalue()


def test_a_pid_that_locks_up_need_not_be_beaten_and_the_report_says_so() -> None:
    controllers_of_a_lag({"pid": GIVEN | {"kc": -2.0}, "other": GIVEN})
    found = designed_and_validated("pid", "other")
    assert re.search(
        r"it: pid is not shipped, because it locked up or left its limits on .*; say with --known .*\.\n",
        pages()[1],
    )
    assert "as_printed" not in "".join(pages())  # an own plant reproduces no paper
    assert found.gate.no_baseline.startswith("it locked up or left its limits on ")
    assert Gate.of(found, "other").refusal() is None
    assert "locked up" in str(Gate.of(found, "pid").refusal())
    assert f"**There is no PID to beat**, because {found.gate.no_baseline}. " in pages()[0]


def test_without_a_pid_another_law_passes_and_with_one_it_must_win(monkeypatch: pytest.MonkeyPatch) -> None:
    controllers_of_a_lag({"pid": GIVEN, "other": GIVEN | {"kc": 0.05}})  # slower, so worse
    found = designed_and_validated("pid", "other")
    assert found.gate.no_baseline == ""
    assert "does not beat the PID's" in str(Gate.of(found, "other").refusal())
    assert "no PID to beat" not in pages()[0]
    assert found.gate.relative_to == "nmpc"

    # A simulator has no NMPC: the PID's error counts as 1.
    monkeypatch.setattr(OwnCase, "stand_in", "simulator")
    report("it")
    found = Validation.read(Path("artifacts/it/validation.json"))
    assert found.gate.relative_to == "baseline"
    assert found.gate.laws["pid"].score == pytest.approx(1.0)
    assert found.gate.laws["other"].score is not None
    assert found.gate.laws["other"].score > 1
    page, terminal = pages()
    assert "MAE / PID's MAE over held_out" in page
    assert "and 1 is the PID's error." in page
    assert re.search(r"pid \* .* 1\.0+ × PID", terminal), terminal

    # Nor a PID: what noise can hide counts as 1.
    controllers_of_a_lag({"other": GIVEN})
    report("it")
    found = Validation.read(Path("artifacts/it/validation.json"))
    assert found.gate.relative_to == "floor"
    assert found.gate.no_baseline == "params.yaml has no controller 'pid' for this plant"
    assert Gate.of(found, "other").refusal() is None
    page, terminal = pages()
    assert "MAE / the error that noise can hide over held_out" in page
    assert "× noise floor" in terminal


def test_without_any_law_the_report_shows_the_model_and_the_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    controllers_of_a_lag({"pid": GIVEN, "other": GIVEN})

    def refuses(*_: object) -> None:
        raise PlantError("the valve is stuck")

    monkeypatch.setattr(PID, "design", refuses)
    found = designed_and_validated("pid", "other")
    assert found.best is None
    assert found.laws == {}
    page, terminal = pages()
    assert "**No controller is shipped:** every law was withheld" in page
    assert "**`pid`, `other` were not designed**, because the valve is stuck." in page.replace(
        "`other`, `pid`", "`pid`, `other`"
    )
    for said in (page, terminal):
        assert said.count("the valve is stuck") == 1  # one reason, however many laws
    assert not re.search(r"simulate \S+\.onnx", terminal)  # there is no file to try
    assert "None.onnx" not in page
    assert "every test ran" not in page
    html = Path("artifacts/it/report.html").read_text()
    assert "No controller is shipped" in html
    assert '<a href="#laws">' not in html
    assert "it: no controller is shipped" in terminal
    assert without_controller(Path("artifacts"), "it")


def test_a_plant_without_loads_is_scored_by_its_other_tests(plant: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopwright.pipeline.cases.own_plant.held_load", lambda *_: None)
    found = designed_and_validated("pid")
    assert found.gate.laws["pid"].score is not None
    assert found.gate.weights == {"held_out": 0.5882, "held_out_noise": 0.2353, "spoilt": 0.1765}
    for name in ("report.md", "report.html"):
        page = (Path("artifacts/it") / name).read_text()
        assert "held_out (0.5882), held_out_noise (0.2353), spoilt (0.1765)." in page
        assert "There is no test with loads: from where the plant rests, the MVs within their ranges cannot" in page
