"""How far the MVs go stands beside the errors, in their unit or, of unlike MVs, in % of their ranges."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from identified_models import scaled_model
from own_cases import case_of, controllers_of_a_lag, section, two_lags
from rich.console import Console

from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.evaluation.case import SHARES_OF_RANGES, Case
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import BASE, Form, LawEvidence, LawMetrics, OverSeeds
from loopwright.pipeline.evaluation.metric import TRAVEL
from loopwright.pipeline.evaluation.validation import FILE, Validation
from loopwright.pipeline.evaluation.verdicts import PLAIN
from loopwright.pipeline.report.law_tables import scenario_rows
from loopwright.pipeline.report.results import show_results
from loopwright.pipeline.report.verdicts import judge, validation

TESTS = ("held_out", "held_out_noise", "load", "spoilt")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def two_valves(units: tuple[str, str]) -> OwnCase:
    """The case of a lag, with a second MV; ranges of 2 and of 100."""
    case, entry = controllers_of_a_lag({}), section(1, 2)
    entry["mv"][0]["unit"] = units[0]
    entry["mv"][1] |= {"unit": units[1], "low": 0.0, "high": 100.0}
    record = case.record
    mv = np.hstack([record.mv, 50 + 10 * record.mv])
    lag = scaled_model(1, 2, 0, 1, a=np.array([[0.6]]), b=np.array([[0.8, 0.0]]), rest=np.eye(1, 4))
    return case_of(entry, [lag, lag, lag], record.pv, mv)


@pytest.mark.parametrize(
    ("units", "travel", "unit"), [(("V", "%"), 100 * 1.0 / 2 + 100 * 20 / 100, SHARES_OF_RANGES), (("V", "V"), 21, "V")]
)
def test_mvs_of_unlike_units_travel_in_shares_of_their_ranges(units: tuple[str, str], travel: float, unit: str) -> None:
    case = two_valves(units)
    test = case.scenarios()["held_out"][0]
    mv = np.zeros((test.samples, 2))
    mv[5:] = [1.0, 20.0]
    assert case.score(test, np.zeros((test.samples, 1)), mv)[TRAVEL] == pytest.approx(travel)
    assert case.metrics[TRAVEL].unit_of(case.cv_unit) == unit


def test_of_several_controlled_variables_all_is_in_shares() -> None:
    case = two_lags()
    test = case.scenarios()["held_out"][0]
    mv = np.zeros((test.samples, 2))
    mv[5:] = [0.5, 1.0]  # ranges of 2
    assert case.score(test, test.sp, mv)[TRAVEL] == pytest.approx(25 + 50)
    assert case.metrics[TRAVEL].unit_of(case.cv_unit) == SHARES_OF_RANGES


def law(name: str, travel: float) -> LawEvidence:
    """A law that moves half as much again under noise."""
    rows = {test: {"mae": 0.1, "max_asse": 0.0, TRAVEL: travel * (1.5 if "noise" in test else 1.0)} for test in TESTS}
    form = Form({}, (), {test: OverSeeds(row, row, row, {"0": row}) for test, row in rows.items()})
    return LawEvidence(LawMetrics(name, name, "mae", (0,), 0, {BASE: form}, development={"0": 1.0}), Path())


def evidence(case: Case) -> Evidence:
    bounds = {test: {"nmpc": {"mae": 0.08, TRAVEL: 5.0}} for test in TESTS}
    return Evidence(case, bounds, {"predictive": law("predictive", 12.5), "pid": law("pid", 40.0)}, {})


def shown() -> list[list[str]]:
    show_results(Path("artifacts"), Console(file=(out := io.StringIO())), "it")
    return [line.split() for line in out.getvalue().splitlines()]


def test_the_table_of_a_run_has_the_travel_with_its_unit() -> None:
    found, file = evidence(controllers_of_a_lag({})), Path("artifacts/it") / FILE
    file.parent.mkdir(parents=True)
    file.write_text(validation(found, judge(found, PLAIN)).to_json())
    assert ["MV", "travel", "[V],", "held_out_noise", "5.0000", "18.7500", "60.0000"] in shown()
    assert Validation.read(file).travel_words == "MV travel [V]"
    tree = json.loads(file.read_text())
    del tree["titles"]["figures"][TRAVEL]  # of an older release, which summed whatever units there were
    file.write_text(json.dumps(tree))
    assert not any("travel" in row for row in shown())


def test_the_report_of_an_own_plant_has_it_in_a_minute() -> None:
    case = controllers_of_a_lag({})
    (row,) = [row for row in scenario_rows(evidence(case)) if row["title"].startswith("MV travel")]
    minutes = case.scenarios()["held_out"][0].samples * case.plant.period_s / 60
    assert row["cells"]["predictive"]["value"] == pytest.approx(12.5 / minutes)
    assert "[V/min]" in row["title"]
    assert row["nmpc"] == pytest.approx(5.0 / minutes)
    shares = evidence(two_valves(("V", "%")))
    assert any("[% of ranges a minute]" in row["title"] for row in scenario_rows(shares))
