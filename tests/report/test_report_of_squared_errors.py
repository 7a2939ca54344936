"""The report of cases that are scored by squared errors, have adaptive laws, and models of their own tables."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import made_up_case as made_up
import numpy as np
import pytest
from made_up_case import BATCH, PH, Miniature
from rich.console import Console
from undrawn import draw_nothing

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.batch_reactor.case import CALMED
from loopwright.pipeline.evaluation.case import Curve, Figure, PaperFigure, Requirement
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.metric import METRICS
from loopwright.pipeline.evaluation.model_evidence import candidates, model_figure
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.evaluation.verdicts import plain_reason
from loopwright.pipeline.pictures.loop_picture import History, summary
from loopwright.pipeline.pictures.loop_pictures import info_picture
from loopwright.pipeline.pictures.numbers import ratio
from loopwright.pipeline.report.page import headline
from loopwright.pipeline.report.results import show_results
from loopwright.pipeline.report.verdicts import gate_id, judge, requirement, table_row
from loopwright.pipeline.tracking.card import version_description
from loopwright.pipeline.tracking.gate import Gate


def load(root: Path, mini: Miniature, own_data: bool = False) -> Evidence:
    work = root / "work" / mini.case
    return Evidence.load(
        mini.of, made_up.bounds(mini), work, root / "timing" / mini.case, tuple(mini.quality), own_data=own_data
    )


@pytest.fixture(scope="module", params=[PH, BATCH], ids=lambda mini: mini.case)
def written(request, tmp_path_factory) -> tuple[Path, Evidence]:
    """A report's folder, and the evidence that it shows; its pictures are drawn in tests/pictures."""
    root = tmp_path_factory.mktemp(request.param.case)
    made_up.write_case(root, mini=request.param)
    evidence, out = load(root, request.param), root / "artifacts" / request.param.case
    with pytest.MonkeyPatch.context() as undrawn:
        draw_nothing(undrawn)
        made_up.report(evidence, out)
    return out, evidence


@pytest.fixture(scope="module")
def batch(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("claims")
    made_up.write_case(root, mini=BATCH)
    return root


def test_programs_learn_which_metric_counts(written):
    out, evidence = written
    tree, case = json.loads((out / "validation.json").read_text()), evidence.case
    assert tree["metric"] == "sse"
    assert tree["titles"]["metric"] == "sum of squared errors"
    assert tree["best"] == "gauss_newton_pid"
    assert made_up.for_programs(evidence).to_json() == (out / "validation.json").read_text()
    for laws in tree["scenarios"].values():
        for row in laws.values():
            assert row["sse_min"] <= row["sse"] <= row["sse_max"]
            assert "mae_min" not in row
    (std,) = case.noise.values()
    for name, tests in evidence.tests.items():
        samples = np.mean([test.samples for test in tests])
        assert tree["gate"]["floors"][name] == pytest.approx(std**2 * samples)


def test_the_gate_counts_what_noise_would_hide_as_nothing(written):
    _, evidence = written
    mini = {m.case: m for m in (PH, BATCH)}[evidence.case.name]
    for law, quality in mini.quality.items():
        expected = 0.0
        for name, weight in evidence.case.gate.items():
            floor, bound = evidence.floors[name], mini.bound[name]
            expected += weight * max(bound * quality, floor) / max(bound, floor)
        assert evidence.score(law) == pytest.approx(expected)


def test_scores_in_another_metric_are_of_another_gate(batch):
    evidence = load(batch, BATCH)

    class InMae(type(evidence.case)):
        metric = "mae"

    other = replace(evidence, case=InMae(evidence.case.held_out_seeds))
    alike = {name: {"nmpc": {"mae": 1.0, "sse": 1.0}} for name in evidence.bounds}
    assert gate_id(replace(evidence, bounds=alike)) != gate_id(replace(other, bounds=alike))


def test_pages_show_the_case_in_its_own_words(written):
    out, evidence = written
    html, text = (out / "report.html").read_text(), (out / "report.md").read_text()
    links = re.findall(r'(?:src|href)="([^"#][^"]*)"', html) + re.findall(r"\]\(([^)]+)\)", text)
    for link in links:
        assert link.startswith(("http://127.0.0.1", "../report.")) or (out / link).exists(), link
    assert {f"figures/figure_{f.number:02d}.png" for f in evidence.case.figures} <= set(links)
    for page in (html, text):
        assert "Sum of squared errors" in page
        assert "ean absolute" not in page
        assert "None" not in page
        assert "nan" not in page
        assert not re.search(r"\de\+\d", page)  # thousands are written out
        assert "RMSE, free run" in page
        assert "gauss newton PID" in page or evidence.case is not CASES["ph_neutralization"]
    for table in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        assert len({row.count("|") - row.count("\\|") for row in table.splitlines()}) == 1, table
    late = ["The optimal temperature profile, from 200 s on", "mean of 10 draws", "recipes"]
    for words in late:
        assert (words in text) is (evidence.case.name == "batch_reactor")


def test_the_headline_is_the_cases_own(written):
    _, evidence = written
    rows = headline(evidence)
    assert rows[0][1].startswith("× SSE of the perfect-model NMPC on")
    words = " ".join(text for _, text in rows)
    if evidence.case.name == "batch_reactor":
        assert rows[0][0] == "1.001"  # two decimals would show every law at the bound
        assert "late SSE on trajectory with noise; at most 15 is asked" in words
    else:
        assert "on held-out set points" in rows[0][1]
        assert "on disturbance" in words
        assert "lower sum of squared errors than the PID" in words


def test_only_a_metric_with_a_late_figure_has_a_late_part(batch):
    class Absolute(type(BATCH.of)):
        metric = "mae"

    evidence = load(batch, BATCH)
    assert evidence.late_s("trajectory") == 200
    absolute = replace(evidence, case=Absolute(evidence.case.held_out_seeds))
    assert absolute.late_s("trajectory") == 0
    assert not any("from 200 s on" in words for _, words in headline(absolute))


def test_requirements_with_noise_with_late_errors_and_of_variants(batch):
    evidence = load(batch, BATCH)
    noisy = 13_252 * 1.001 * 1.1 + 1e-4

    def met(*args, **more) -> bool | None:
        return requirement(Requirement(*args, **more), evidence).holds

    assert met(None, "trajectory_noise", "sse", noisy + 1) is True
    assert met(None, "trajectory_noise", "sse", noisy - 1) is False
    assert met(None, "trajectory_noise", "sse_late", noisy / 1000 + 0.01) is True
    assert met(None, "trajectory_noise", "sse_late", noisy / 1000 - 0.01) is False
    assert met(None, "held_out", "sse", 1.0011, times="nmpc") is True
    assert met(None, "held_out_noise", "sse", 2.0, times="nmpc") is None  # no bound with noise
    assert met("linearized_pid", "trajectory", "sse", 1e9, setting=CALMED.setting) is True
    assert met("linearized_pid", "trajectory", "sse", 1e9, setting={"penalty": 3.0}) is None
    need = Requirement("linearized_pid", "trajectory", "sse", 13_320.0, setting=CALMED.setting)
    row = requirement(need, evidence)
    assert row.what == "linearized PID (calmed), trajectory"
    assert row.limit == "SSE ≤ 13,320 °C²"


def test_a_model_sets_figures_have_their_place_in_a_table(batch):
    evidence = load(batch, BATCH)

    def judged(path: str, paper: float):
        row = PaperFigure("x", "identification_example", "", path, paper)
        return table_row(row, evidence, plain_reason)

    row = judged("one_step.recursive_0.8", 2.6)
    assert (row.ours, row.holds, row.metric) == (2.6, True, "one step")
    assert (row.low, row.high) == pytest.approx((2.34, 2.86))
    assert judged("one_step.nnarx", 0.03).verdict.startswith("does not, because it is 1.8 times")
    assert "no such figure" in judged("one_step.fuzzy", 1.0).verdict
    assert evidence.figure("nnarx", "", "free_run_rmse") == 0.0041
    seeds = {"0": {"a.b": {"c": [1.0, 5.0]}}, "1": {"a.b": {"c": [3.0]}}}
    model = {"parts": {"p": {"per_seed": {"0": {}}}, "q": {"per_seed": seeds}}}
    assert model_figure(model, "a.b.c") == 3.0
    assert model_figure(model, "a.b.c", "max") == 5.0
    assert model_figure(model, "a.b") is None


def test_the_search_over_sizes_is_told_over_all_seeds(batch):
    (table,) = candidates("nnarx", load(batch, BATCH).models["nnarx"])
    assert [row["chosen"] for row in table["rows"]] == [0, 0, 2, 1]
    assert table["rows"][1]["hidden"] == "6"
    assert table["rows"][2]["free_run_rmse"] == pytest.approx(0.0041 * 1.1)  # the middle one of three


def test_a_statement_is_judged_once():
    for name in CASES:
        texts = [check.what for check in made_up.claims_of(name).statements]
        assert len(set(texts)) == len(texts), name


def rewrite(root: Path, mini: Miniature, law: str, of: tuple[str, str], **figures: float) -> None:
    """Change some measured figures of a law: of a form, in a test."""
    file = root / "work" / mini.case / "validation" / law / "metrics.json"
    metrics = json.loads(file.read_text())
    form, test = of
    metrics["forms"][form]["tests"][test]["median"] |= figures
    file.write_text(json.dumps(metrics))


def test_claims_of_the_tank_follow_the_measurement(tmp_path):
    made_up.write_case(tmp_path, mini=PH)
    claims, set_point = made_up.claims_of(PH.case), ("base", "set_point")

    def outcomes() -> dict[str, bool | None]:
        return {v.what: v.holds for v in judge(load(tmp_path, PH), claims).statements}

    before = outcomes()
    rewrite(tmp_path, PH, "linearized_pid", ("penalty=20", "set_point"), sse=43.4)
    rewrite(tmp_path, PH, "linearized_pid", ("adaptive", "set_point"), sse=5.0)
    rewrite(tmp_path, PH, "recursive_pid", set_point, sse=9.0)
    rewrite(tmp_path, PH, "recursive_pid", ("base", "disturbance"), max_asse=0.2)
    rewrite(tmp_path, PH, "pid", ("tuning=itae, sampling=1", "set_point"), overshoot=0.02)
    after = outcomes()
    turned = {
        "the PID with fixed settings overshoots and oscillates": False,
        "a fixed penalty of 20 is slow": True,
        "the adaptive penalty is needed": True,
        "the linearized PID is ahead of the recursive one": True,
        "the linearized PID is ahead of the self-tuning one": True,
        "the recursive PID is unstable under disturbances": True,
    }
    for text, holds in turned.items():
        assert (before[text], after[text]) == (not holds, holds), text
    assert before["the disturbance is one of the buffer's flow"] is False
    assert before["the best settings without bounds are negative"] is False  # no made-up gain lies at a bound
    row = next(r for t in CASES[PH.case].tables for r in t.rows if r.law == "self_tuning_pid")
    assert "does not print its tuning" in table_row(row, load(tmp_path, PH), claims.reason).verdict


def test_claims_of_the_reactor_follow_the_measurement(tmp_path):
    made_up.write_case(tmp_path, mini=BATCH)
    claims = made_up.claims_of(BATCH.case)

    def outcome(text: str) -> bool | None:
        return {v.what: v.holds for v in judge(load(tmp_path, BATCH), claims).statements}[text]

    ahead = "the linearized PID tracks better than the recursive one"
    assert outcome(ahead) is False
    rewrite(tmp_path, BATCH, "linearized_pid", ("base", "trajectory_noise"), sse=13_000.0)
    assert outcome(ahead) is False  # better in all, not after the start
    rewrite(tmp_path, BATCH, "linearized_pid", ("base", "trajectory_noise"), sse_late=1.0)
    assert outcome(ahead) is True
    assert outcome("filter and update criterion calm the settings") is True
    row = CASES[BATCH.case].tables[0].rows[1]
    said = table_row(row, load(tmp_path, BATCH), claims.reason).verdict
    assert "13,252 is lost while full heating cannot reach the profile" in said
    assert "the paper's 11,121" in said


def test_a_persons_own_data_get_no_reasons_of_the_papers(batch, tmp_path, monkeypatch):
    evidence = load(batch, BATCH, own_data=True)
    draw_nothing(monkeypatch)
    made_up.report(evidence, tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "full heating" not in text
    assert "does not, because it is 0.6 times the paper's" in text


def test_info_is_drawn_by_its_name_whatever_else_the_setting_tells(batch):
    evidence = load(batch, BATCH)
    law = evidence.laws["linearized_pid"]
    figure = Figure(1, "x", (Curve("linearized_pid", CALMED.setting),), "trajectory", info=("kc", "penalty"))
    canvas = info_picture(evidence, figure)
    loop = law.loop("trajectory", CALMED.setting)
    assert loop is not None
    for axes, column in zip(canvas.axes, (0, 3), strict=True):
        assert np.array_equal(axes.lines[0].get_ydata(), loop["info"][:, column])
    calmed = replace(law.metrics.forms["calmed"], info=("penalty", "x", "y", "kc", "z"))
    turned = replace(law.metrics, forms={**law.metrics.forms, "calmed": calmed})
    swapped = replace(evidence, laws={**evidence.laws, "linearized_pid": replace(law, metrics=turned)})
    canvas = info_picture(swapped, figure)
    assert np.array_equal(canvas.axes[0].lines[0].get_ydata(), loop["info"][:, 3])
    for other in (replace(figure, info=("colour",)), replace(figure, curves=(Curve("gauss_newton_pid"),))):
        with pytest.raises(NotMeasuredError):
            info_picture(evidence, other)


def test_the_table_in_the_terminal_and_the_card_in_the_registry(written):
    out, evidence = written
    page = io.StringIO()
    show_results(out.parent, Console(file=page))
    main = evidence.main_test
    (row,) = (line.split() for line in page.getvalue().splitlines() if " gauss_newton_pid *" in line)
    own, bound = evidence.figure("gauss_newton_pid", main), evidence.bound(main)
    assert own is not None
    assert bound is not None
    assert ratio(own / bound) in row
    tree = Validation.read(out / "validation.json")
    card = version_description(tree, Gate.of(tree, "gauss_newton_pid"), "run", None)
    unit = evidence.case.unit  # none for a pH
    assert f"Scenario (sum of squared errors{unit and f' [{unit}]'})" in card
    assert f"{own / bound:.2f}" in card
    assert "e+" not in card


def test_a_loop_tried_by_hand_is_told_in_the_cases_metric():
    sp, pv = (np.array([[7.0], [8.0]]), np.array([[7.0], [7.5]]))
    mv = np.array([[900.0], [950.0]])
    history = History([0.0, 60.0], ["AUTO"] * 2, list(sp), list(pv), list(pv), list(mv), ["", ""])
    assert summary(PH.of.plant, history, METRICS["sse"]).splitlines() == [
        "SSE pH 0.25, MAE pH 0.25, final error 0.5",
        "travel of q3 50 ml/min",
    ]
