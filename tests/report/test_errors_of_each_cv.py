"""Several CVs are compared in shares of their ranges; each one's own error stands beside, in its unit."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from own_cases import controllers_of_a_lag, two_lags
from rich.console import Console

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import BASE, Form, LawEvidence, LawMetrics, OverSeeds
from loopwright.pipeline.evaluation.validation import FILE
from loopwright.pipeline.evaluation.verdicts import PLAIN
from loopwright.pipeline.report.page import headline
from loopwright.pipeline.report.results import show_results
from loopwright.pipeline.report.verdicts import judge, validation

TESTS = ("held_out", "held_out_noise", "load", "spoilt")


def law(name: str, development: float, mae: float) -> LawEvidence:
    row = {"mae": mae, "max_asse": 0.0, "mae_y0": mae / 10, "mae_y1": mae / 100}
    form = Form({}, (), {test: OverSeeds(row, row, row, {"0": row}) for test in TESTS})
    return LawEvidence(LawMetrics(name, name, "mae", (0,), 0, {BASE: form}, development={"0": development}), Path())


def evidence(case: Case) -> Evidence:
    bounds = {test: {"nmpc": {"mae": 1.0, "mae_y0": 0.11, "mae_y1": 0.012}} for test in TESTS}
    return Evidence(case, bounds, {"predictive": law("predictive", 1.0, 2.0), "pid": law("pid", 2.0, 3.0)}, {})


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def table(found: Evidence) -> list[list[str]]:
    """The words of each row of the terminal's table."""
    folder = Path("artifacts/it")
    folder.mkdir(parents=True)
    (folder / FILE).write_text(validation(found, judge(found, PLAIN)).to_json())
    out = io.StringIO()
    show_results(Path("artifacts"), Console(file=out), "it")
    return [line.split() for line in out.getvalue().splitlines()]


def test_the_headline_and_the_table_have_each_variable_s_own_error() -> None:
    found = evidence(two_lags())
    rows = headline(found)
    assert ("0.2 m", "MAE y0 on held-out set points; the PID has 0.3") in rows
    assert ("0.02 m", "MAE y1 on held-out set points; the PID has 0.03") in rows
    printed = table(found)
    at = printed.index(["held_out", "1.0000", "2.0000", "3.0000"])
    assert printed[at + 1] == ["MAE", "y0", "[m]", "0.1100", "0.2000", "0.3000"]
    assert printed[at + 2] == ["MAE", "y1", "[m]", "0.0120", "0.0200", "0.0300"]


def test_without_a_pid_its_figure_is_left_out() -> None:
    found = evidence(two_lags())
    alone = replace(found, laws={"predictive": found.laws["predictive"]})
    assert ("0.2 m", "MAE y0 on held-out set points") in headline(alone)


def test_one_variable_has_its_error_once() -> None:
    found = evidence(controllers_of_a_lag({}))
    assert not any("MAE y0" in words for _, words in headline(found))
    assert not any("y0" in row for row in table(found))
