"""Laws of an own plant that their own tests show to be poor are not shipped, and the report and the table say why."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from own_cases import controllers_of_a_lag
from rich.console import Console
from undrawn import draw_nothing

from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.evaluation.law_evidence import LawMetrics
from loopwright.pipeline.evaluation.open_loop import errors_at_rest
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.metrics import mae
from loopwright.pipeline.report.results import show_results
from loopwright.pipeline.stages.code import listing
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.validate import validate

PI = {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 3.0}
HARDLY = PI | {"kc": 0.002}
ARTIFACTS = Path("artifacts/it")


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    draw_nothing(monkeypatch)


def validated(*names: str) -> Validation:
    for name in names:
        design(f"it-{name}")
        validate(f"it-{name}")
    report("it")
    return Validation.read(ARTIFACTS / "validation.json")


def withheld(law: str) -> str:
    return str(json.loads((ARTIFACTS / f"{law}.json").read_text())["withheld"])


def test_a_law_that_controls_no_better_than_mvs_at_rest_is_not_shipped() -> None:
    controllers_of_a_lag({"pid": PI, "hardly": HARDLY})
    found = validated("pid", "hardly")
    assert found.best == "pid"
    assert (ARTIFACTS / "pid.onnx").is_file()
    assert not (ARTIFACTS / "hardly.onnx").exists()
    assert withheld("hardly").startswith("controllers.it-hardly controls no better than no control (MAE ")
    own = LawMetrics.read(Path("work/it/validation/hardly/metrics.json"))
    error = own.forms["base"].tests["held_out"].median["mae"]
    assert 0.9 * own.at_rest["held_out"] < error < own.at_rest["held_out"]  # it is a little better
    assert found.laws["hardly"].withheld == own.poor
    assert found.laws["pid"].withheld == ""
    show_results(Path("artifacts"), Console(file=(terminal := io.StringIO())), "it")
    page = (ARTIFACTS / "report.md").read_text()
    for said in (page, terminal.getvalue()):
        assert said.count("it controls no better than no control") == 1
    assert "**`hardly` is not shipped**" in page
    assert f"| {own.at_rest['held_out']:.3g} |" in page


def test_a_law_in_a_limit_cycle_on_a_model_as_it_is_is_not_shipped_and_its_loop_is_drawn() -> None:
    controllers_of_a_lag({"pid": PI, "hard": PI | {"kc": 2.0}})
    found = validated("pid", "hard")
    assert not (ARTIFACTS / "hard.onnx").exists()
    assert withheld("hard").startswith("controllers.it-hard ends in a limit cycle (y0 swings by ± ")
    own = LawMetrics.read(Path("work/it/validation/hard/metrics.json"))
    cycle = own.cycles["held_out"]
    assert (cycle.signal, cycle.unit) == ("y0", "m")
    assert cycle.times > 1
    assert cycle.period_s == pytest.approx(2.0)  # the MV goes from one end to the other with each sample
    assert found.laws["hard"].withheld == own.poor
    page = (ARTIFACTS / "report.md").read_text()
    assert "**To do:**" not in page  # another law is shipped
    assert "spoilt" in own.cycles  # where it swings farther, and any law may
    assert "in spoilt" not in own.poor
    assert "[Picture](figures/cycle_hard.png)" in page
    assert "figures/cycle_pid.png" not in page
    assert own.lock_ups == 0


def test_a_limit_cycle_on_models_gone_wrong_alone_is_told() -> None:
    controllers_of_a_lag({"pid": PI | {"kc": 1.4}})
    found = validated("pid")
    assert found.best == "pid"
    assert set(LawMetrics.read(Path("work/it/validation/pid/metrics.json")).cycles) == {"spoilt"}
    page = (ARTIFACTS / "report.md").read_text()
    assert ": at worst y0 swings by ± " in page
    assert "figures/cycle_pid.png" in page


def test_where_nothing_is_shipped_the_report_says_once_which_step_test_helps() -> None:
    case = controllers_of_a_lag({"pid": HARDLY, "hard": PI | {"kc": 2.0}})
    found = validated("pid", "hard")
    assert found.best is None
    for name in ("report.md", "report.html"):
        page = (ARTIFACTS / name).read_text()
        assert page.count("A step test gives a better model") == 1
        assert "u0 by 0.24 V" in page  # of a range of 2 V
        assert case.settling_s == 10.0  # a third of the shortest hold
        assert "each held for 15 s." in page
        assert "Keep the old loop" not in page  # which nobody knows


def test_the_error_at_rest_is_that_of_the_plant_where_it_stands() -> None:
    case = controllers_of_a_lag({})
    found = errors_at_rest(case)
    tests = case.scenarios()
    starts = [(t.plant or case.plant).measure(t.x0)[:1] for t in tests["held_out"]]
    errors = [mae(t.sp[:, 0], y.repeat(len(t.sp))) for t, y in zip(tests["held_out"], starts, strict=True)]
    assert found["held_out"] == pytest.approx(sum(errors) / len(errors))
    assert found["load"] > 0
    assert set(found) == set(tests)


def test_an_error_at_rest_counts_as_far_as_the_range_of_its_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    case = controllers_of_a_lag({})
    tests = dict(case.scenarios())
    far = [replace(t, changes={name: 1e3 * load for name, load in t.changes.items()}) for t in tests["load"]]
    monkeypatch.setattr(type(case), "scenarios", lambda _: {**tests, "load": far})
    (cv,) = case.plant.sp_signals
    assert 0.2 * (cv.high - cv.low) < errors_at_rest(case)["load"] <= cv.high - cv.low


def test_a_design_goes_by_the_numbers_of_the_old_loop_that_stands_beside_it() -> None:
    controllers_of_a_lag({"pid": PI, "old_loop": PI})
    root = Path(__file__).parents[2]
    first = listing(root, "design", "it")["params.yaml"]
    controllers_of_a_lag({"pid": PI, "old_loop": PI | {"kc": 0.3}})
    assert listing(root, "design", "it")["params.yaml"] != first
    assert all_cases()["it"].old_loop == "old_loop"
