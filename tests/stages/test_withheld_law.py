"""A law of an own plant that locks up: nothing is shipped, the reason stays, and the case goes on."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from identified_models import first_order, scaled_model
from own_cases import case_of, section
from rich.console import Console

from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import LawEvidence, LawMetrics
from loopwright.pipeline.report.results import show_results
from loopwright.pipeline.stages.check import notes
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.report import report
from loopwright.pipeline.stages.validate import validate
from loopwright.serving import Controller

POLES = (0.6, 0.55, 0.65)


@pytest.fixture
def metrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LawMetrics:
    """Of a PID whose sign is wrong, designed and validated on a lag."""
    monkeypatch.chdir(tmp_path)
    mv = np.repeat(np.random.default_rng(0).uniform(-0.6, 0.6, (40, 1)), 10, axis=0)
    y = np.zeros((400, 1))
    for k in range(399):
        y[k + 1] = POLES[0] * y[k] + (1 - POLES[0]) * 2 * mv[k]
    lags = [scaled_model(1, 1, 0, 1, a=np.array([[p]]), b=np.array([[2 * (1 - p)]]), rest=np.eye(1, 3)) for p in POLES]
    case = case_of(section(1, 1), lags, y, mv)
    (case.models.parent / "metrics.json").write_text(json.dumps({"data": {"0": "x"}, "parts": {}}))
    tree = yaml.safe_load(Path("params.yaml").read_text())
    tree["cases"] = {"it": {"held_out_seeds": [9001, 9002]}}
    wrong = {"law": "pid", "tuning": "manual", "kc": -2.0, "ti_s": 3.0}
    tree["controllers"] = {"it-pid": {"case": "it", "name": "pid", "model": "identified", **wrong}}
    Path("params.yaml").write_text(yaml.safe_dump(tree))
    stale = Path("artifacts/it/pid.onnx")
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"of an earlier run")
    design("it-pid")
    validate("it-pid")
    return LawMetrics.read(Path("work/it/validation/pid/metrics.json"))


def test_no_file_is_shipped_and_the_reason_stays(metrics: LawMetrics) -> None:
    assert metrics.lock_ups > 0
    assert not Path("artifacts/it/pid.onnx").exists()
    why = json.loads(Path("artifacts/it/pid.json").read_text())["withheld"]
    assert why.startswith("controllers.it-pid locked up or left its limits on ")
    assert set(metrics.locked_up) >= {"held_out", "spoilt"}
    assert LawEvidence(metrics, Path("trajectories.npz")).withheld


def test_a_law_that_cannot_be_designed_leaves_the_reason_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two MVs that do the same cannot hold two controlled variables, and no pair of loops can be tuned."""
    monkeypatch.chdir(tmp_path)
    mv = np.repeat(np.random.default_rng(0).uniform(-0.6, 0.6, (40, 2)), 10, axis=0)
    y = np.zeros((400, 2))
    for k in range(399):
        y[k + 1] = 0.6 * y[k] + 0.4 * mv[k].sum()
    a, b = 0.6 * np.eye(2), np.full((2, 2), 0.4)
    twins = [scaled_model(2, 2, 0, 2, a=a, b=b, rest=np.eye(2, 5)) for _ in POLES]
    case = case_of(section(2, 2), twins, y, mv)
    (case.models.parent / "metrics.json").write_text(json.dumps({"data": {"0": "x"}, "parts": {}}))
    tree = yaml.safe_load(Path("params.yaml").read_text())
    tree["cases"] = {"it": {"held_out_seeds": [9001, 9002]}}
    tree["controllers"] = {"it-pid": {"case": "it", "name": "pid", "law": "pid", "model": "identified"}}
    Path("params.yaml").write_text(yaml.safe_dump(tree))
    design("it-pid")
    validate("it-pid")
    why = json.loads(Path("artifacts/it/pid.json").read_text())["withheld"]
    assert why.startswith("law 'pid' is withheld: the MVs do not hold the controlled variables independently")
    assert not Path("artifacts/it/pid.onnx").exists()


def test_a_law_that_does_not_suit_the_plant_is_not_designed_and_the_report_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A one-step law over four periods of dead time, beside a PID that goes on."""
    monkeypatch.chdir(tmp_path)
    mv = np.repeat(np.random.default_rng(0).uniform(-0.6, 0.6, (40, 1)), 10, axis=0)
    y = np.zeros((400, 1))
    for k in range(4, 399):
        y[k + 1] = 0.6 * y[k] + 0.8 * mv[k - 4]
    inflow = np.repeat(np.resize([0.3, 0.0, -0.3], 40), 10)[:, None]
    lags = [first_order(pole, dead=4, disturbance=0.5) for pole in POLES]
    case = case_of(section(1, 1, dv=[{"name": "d0", "unit": "V", "low": -1.0, "high": 1.0}]), lags, y, mv, inflow)
    (case.models.parent / "metrics.json").write_text(json.dumps({"data": {"0": "x"}, "parts": {}}))
    tree = yaml.safe_load(Path("params.yaml").read_text())
    own = {"case": "it", "model": "identified"}
    given = {"tuning": "manual", "kc": 0.2, "ti_s": 4.0, "development_seeds": [1], "mv_rate": None}
    tree |= {
        "cases": {"it": {"held_out_seeds": [9001, 9002]}},
        "models": {"it-identified": {**own, "data": "data/it/record.parquet", "parts": {}}},
        "controllers": {
            "it-pid": {**own, "name": "pid", "law": "pid", **given},
            "it-one_step": {**own, "name": "one_step", "law": "gauss_newton_pid"},
        },
    }
    Path("params.yaml").write_text(yaml.safe_dump(tree))
    why = "law 'gauss_newton_pid' is withheld: y0 answers 5 samples after u0 moves, the law looks 1 ahead"
    assert f"controllers.it-one_step: {why}; choose law 'predictive' or 'pid', or remove the section" in notes()
    for name in ("it-one_step", "it-pid"):
        design(name)
        validate(name)
    assert json.loads(Path("artifacts/it/one_step.json").read_text())["withheld"].startswith(why)
    assert not Path("artifacts/it/one_step.onnx").exists()
    report("it")
    found = why.removeprefix("law 'gauss_newton_pid' is withheld: ")
    page = Path("artifacts/it/report.md").read_text()
    assert f"**`one_step` was not designed**, because {found}" in page
    # Each absolute error has its unit, in the page, the terminal's table and the file.
    assert "It is the best because no other law is shipped." in page
    pid = LawMetrics.read(Path("work/it/validation/pid/metrics.json"))
    assert Controller(Path("artifacts/it/pid.onnx")).manifest.evidence["dead_time_periods"] == [5]
    (error,) = pid.development.values()
    worse = replace(pid, development=dict.fromkeys(pid.development, 2 * error))
    two = Evidence(all_cases()["it"], {}, {"pid": LawEvidence(pid, Path()), "worse": LawEvidence(worse, Path())}, {})
    assert two.why_best.endswith(f"is the lowest: {error:.4g} m (others: worse {2 * error:.4g})")
    assert "Mean absolute error in m: the median" in page
    assert re.search(r"MV travel \[[^\]]*(/min| a minute)\]", page)  # to compare with the old loop
    assert re.search(r"counts as the floor: \S+ m \(the measurement noise\)", page)
    terminal = io.StringIO()
    show_results(Path("artifacts"), Console(file=terminal))
    show_results(Path("artifacts"), Console(file=terminal), "it")
    assert "MAE [m], held_out" in terminal.getvalue()
    assert f"it: one_step is not shipped, because {found}" in terminal.getvalue()
    assert "it: mean absolute error [m]" in terminal.getvalue()
    # A controller that params.yaml no longer has is no news.
    del tree["controllers"]["it-one_step"]
    Path("params.yaml").write_text(yaml.safe_dump(tree))
    show_results(Path("artifacts"), Console(file=(later := io.StringIO())))
    assert "not shipped" not in later.getvalue()
    units = Controller("artifacts/it/pid.onnx").manifest.evidence["units"]
    assert units["mae"] == units["mae_median"] == units["max_asse"] == "m"
    assert units["overshoot"] == "of the step"  # a fraction
    # Every setting that was given is shown, a list too.
    assert "| development_seeds = [1], kc = 0.2, mv_rate = null, ti_s = 4.0, tuning = manual |" in page
    # The best law's picture stands at the top, and is shown once.
    html = Path("artifacts/it/report.html").read_text()
    for text in (page, html):
        assert text.count("figures/closed_loop.png") == 1
        assert "closed_loop_pid.png" not in text
        assert text.count("figures/closed_loop_test_measured.png") == 1
        assert "Each law on" not in text
    # The PID met the steps of the measured disturbance too, and the report shows them.
    assert "| A step of d0, and back, 2 draws |" in page
    assert Path("artifacts/it/figures/closed_loop_test_measured.png").stat().st_size > 0
