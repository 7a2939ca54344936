"""The old loop of a record through the stages: in every table, never shipped, and to be beaten by the best law."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from own_cases import controllers_of_a_lag
from rich.console import Console
from undrawn import draw_nothing

from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.records.record_file import RecordedSetPoints
from loopwright.pipeline.report.results import show_results
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.validate import validate
from loopwright.pipeline.tracking.gate import Gate

GOOD = {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 3.0}
SLUGGISH, EAGER = GOOD | {"kc": 0.05}, GOOD | {"kc": 1.4}
ARTIFACTS = Path("artifacts/it")


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    draw_nothing(monkeypatch)


def through_the_stages(pid: dict[str, object], old: dict[str, object], *, replayed: bool = False) -> Validation:
    case = controllers_of_a_lag({"pid": pid, "old_loop": old})
    if replayed:  # a set point that the PV crosses all the time
        RecordedSetPoints(("y0",), np.full((len(case.record), 1), 0.1)).write(case.data)
    for name in ("it-pid", "it-old_loop"):
        design(name)
        validate(name)
    report("it")
    return Validation.read(ARTIFACTS / "validation.json")


def pages() -> tuple[str, str]:
    """The report as Markdown, and the table of the case in the terminal."""
    show_results(Path("artifacts"), Console(file=(terminal := io.StringIO())), "it")
    return (ARTIFACTS / "report.md").read_text(), terminal.getvalue()


def test_a_law_that_beats_it_is_best_and_is_shipped_alone() -> None:
    found = through_the_stages(GOOD, SLUGGISH)
    assert (found.best, found.old_loop, found.gate.baseline) == ("pid", "old_loop", "old_loop")
    assert (ARTIFACTS / "pid.onnx").is_file()
    assert not (ARTIFACTS / "old_loop.onnx").exists()
    assert "run by before" in json.loads((ARTIFACTS / "old_loop.json").read_text())["withheld"]
    assert all({"pid", "old_loop"} <= set(rows) for rows in found.scenarios.values())
    assert "daily" not in found.scenarios
    page, terminal = pages()
    own, old = (found.scenarios["held_out"][law]["mae"] for law in ("pid", "old_loop"))
    share = f"{100 * (1 - own / old):.0f} %"
    assert f"- **{share}** lower MAE than the old loop on held-out set points; " in page
    assert f"lower MAE than the old loop: held_out {share}" in terminal
    assert "old_loop is not shipped" not in terminal
    assert Gate.of(found, "pid").refusal() is None


def test_a_law_that_is_better_in_some_tests_alone_is_shipped_and_not_called_best() -> None:
    found = through_the_stages(EAGER, GOOD | {"kc": 0.4})
    assert found.best is None
    assert (ARTIFACTS / "pid.onnx").is_file()
    page, terminal = pages()
    assert "**No controller beats the old loop**" in page
    assert "has a higher MAE than the old loop in " in page
    assert "the best" not in terminal
    assert "no controller beats the old loop in all tests" in terminal
    assert found.gate.laws["pid"].worse == ("spoilt",)
    gate = Gate.of(found, "pid")
    assert gate.score is not None
    assert gate.score < (gate.baseline or 0.0)  # by this one figure it would pass
    assert "larger than under the old loop in spoilt" in str(gate.refusal())
    assert gate.tags()["worse_than_old_loop"] == "spoilt"


def test_a_law_that_is_worse_in_every_test_is_not_shipped() -> None:
    found = through_the_stages(SLUGGISH, GOOD)
    assert found.best is None
    assert not (ARTIFACTS / "pid.onnx").exists()
    why = json.loads((ARTIFACTS / "pid.json").read_text())["withheld"]
    assert why.startswith("controllers.it-pid is worse than the old loop in every test (MAE ")
    assert all(test in why for test in ("held_out", "load", "spoilt"))
    assert found.laws["pid"].withheld.startswith("is worse than the old loop in every test")
    assert str(Gate.of(found, "pid").refusal()).startswith("it is worse than the old loop in every test")
    page, terminal = pages()
    assert page.count("is worse than the old loop in every test") == 1
    assert "**No controller is shipped:**" in page
    assert terminal.count("it is worse than the old loop in every test") == 1
    assert "| MVs at rest |" in page
    assert page.count("Keep the old loop until then.") == 1


def test_where_the_old_loop_gets_stuck_a_law_need_not_beat_it() -> None:
    found = through_the_stages(SLUGGISH, GOOD | {"kc": -2.0})
    assert found.best == "pid"
    assert found.gate.laws["pid"].worse == ()


def test_daily_work_is_a_test_of_all_and_counts_for_the_best() -> None:
    found = through_the_stages(GOOD, SLUGGISH, replayed=True)
    assert found.best == "pid"
    daily = found.scenarios["daily"]
    assert daily["pid"]["mae"] < daily["old_loop"]["mae"]
    assert "nmpc" not in found.bounds.get("daily", {})
    page, terminal = pages()
    assert "in the record itself the MAE was" in page
    assert "MV travel [V/min]: Daily work" in page
    assert "on daily work" in page
    assert "daily" in terminal
