"""The report: verdicts follow what was measured, pages hold together, programs get their JSON."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path

import made_up_case as made_up
import numpy as np
import pytest
import yaml
from made_up_case import CASE
from undrawn import draw_nothing

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.config.params import CertificateParams
from loopwright.pipeline.errors import ReportError
from loopwright.pipeline.evaluation.case import Curve, PaperFigure, Requirement
from loopwright.pipeline.evaluation.certificate.plan import CertificatePlan
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.evidence_basis import Grounds
from loopwright.pipeline.evaluation.law_evidence import LawMetrics
from loopwright.pipeline.evaluation.stress.loops import StressOutcome
from loopwright.pipeline.evaluation.verdicts import PLAIN, close
from loopwright.pipeline.optimal import bounds
from loopwright.pipeline.report.page import context
from loopwright.pipeline.report.templating import render
from loopwright.pipeline.report.verdicts import acceptance, judge, requirement, table_row
from loopwright.pipeline.stages.report import report

LAWS = ("inc", "incad", "incadec", "pid", "inverse_dob", "forward_dob")


def load(root: Path) -> Evidence:
    return Evidence.load(CASES[CASE], made_up.bounds(), root / "work" / CASE, root / "timing" / CASE)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    made_up.write_case(folder)
    return folder


@pytest.fixture(scope="module")
def out(root) -> Path:
    folder = root / "artifacts" / CASE
    made_up.report(load(root), folder)
    return folder


def test_programs_get_the_agreed_shape(out):
    tree = json.loads((out / "validation.json").read_text())
    assert tree["case"] == CASE
    assert tree["best"] == "inverse_dob"
    assert {"sp_a", "sp_b", "tin", "ua", "ua_gradual", "held_out", "sp_a_noise"} <= set(tree["scenarios"])
    for laws in tree["scenarios"].values():
        assert set(laws) == set(LAWS)
        for row in laws.values():
            assert {*made_up.figures(0.1), "seeds"} <= set(row)
            assert row["mae_min"] <= row["mae"] <= row["mae_max"]
    assert tree["bounds"]["held_out"]["nmpc"]["mae"] == 0.036
    # the made-up bounds of the disturbances lie below the noise, and so does the PID's error for one of them
    tin, ua = max(0.0002 * 1.35, 5e-4) / 5e-4, 0.0004 * 1.35 / 5e-4
    assert tree["gate"]["laws"]["pid"]["score"] == pytest.approx(0.8 * 1.35 + 0.1 * tin + 0.1 * ua)


def test_pages_refer_only_to_what_exists(out):
    html, text = (out / "report.html").read_text(), (out / "report.md").read_text()
    links = re.findall(r'(?:src|href)="([^"#][^"]*)"', html) + re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) >= 25
    for link in links:
        assert link.startswith(("http://127.0.0.1", "../report.")) or (out / link).exists(), link
    assert {f"figures/figure_{n:02d}.png" for n in range(5, 12)} <= set(links)
    ids = set(re.findall(r'id="([^"]+)"', html))
    assert set(re.findall(r'href="#([^"]+)"', html)) <= ids
    for page in (html, text):
        assert "INCADEC (r=10)" in page
        assert "/#/models" in page
        assert "None" not in page
        assert "nan" not in page
    tables = re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE)
    assert len(tables) > 8
    for table in tables:
        assert len({row.count("|") - row.count("\\|") for row in table.splitlines()}) == 1, table


@pytest.mark.parametrize("far", [{}, {"T": 61.5}])
def test_set_points_beyond_the_record_stand_at_the_head(root: Path, far: dict[str, float]) -> None:
    evidence = load(root)
    vars(evidence)["grounds"] = Grounds({"T": 90.0}, far, {})  # as the property keeps it
    content = context(evidence, judge(evidence, PLAIN), {}, ())
    for name in ("report.html.j2", "report.md.j2"):
        head = render(name, content).partition("Requirements")[0]
        assert ("Set points of the tests go beyond the record, T by 61.5 %" in head) == bool(far)


def test_the_same_evidence_gives_the_same_files(root, out, tmp_path):
    again = load(root)
    assert made_up.for_programs(again).to_json() == (out / "validation.json").read_text()
    alone = replace(again, laws={"pid": again.laws["pid"]})
    made_up.report(alone, tmp_path)
    picture = Path("figures") / "closed_loop_pid.png"
    assert (tmp_path / picture).read_bytes() == (out / picture).read_bytes()


def with_laws(root: Path, **quality: float) -> Evidence:
    for law, value in quality.items():
        made_up.write_validation(root, law, value)
    return load(root)


def rewrite(root: Path, law: str, scenario: str, **figures: float) -> None:
    """Change some measured figures of a law."""
    path = root / "work" / CASE / "validation" / law / "metrics.json"
    metrics = json.loads(path.read_text())
    metrics["forms"]["base"]["tests"][scenario]["median"] |= figures
    path.write_text(json.dumps(metrics))


def test_verdicts_follow_the_measurement(tmp_path):
    claims = made_up.claims_of(CASE)
    with_laws(tmp_path, pid=1.35, inc=2.7)
    table = {(r.label, t.number): r for t in CASES[CASE].tables for r in t.rows}

    def verdict(label: str, number: int):
        evidence = load(tmp_path)
        return table_row(table[label, number], evidence, claims.reason)

    assert verdict("INC", 2).holds
    assert verdict("PID", 2).verdict.startswith("does not, because our IMC")
    rewrite(tmp_path, "pid", "sp_a", mae=0.22)
    assert verdict("PID", 2).verdict == "reproduces"
    rewrite(tmp_path, "inc", "sp_a", mae=0.4)
    assert "oscillates around" in verdict("INC", 2).verdict
    rewrite(tmp_path, "inc", "ua", mae=0.002, max_asse=0.01)
    assert "an offset from the network's error" in verdict("INC", 6).verdict
    rewrite(tmp_path, "inc", "ua", mae=0.002, max_asse=1e-4)
    assert "holds this point with our networks" in verdict("INC", 6).verdict
    assert verdict("INCAD (r=2.5)", 2).holds is None
    with_laws(tmp_path, incadec=3.0)
    rewrite(tmp_path, "incadec", "sp_a", max_asse=0.2)
    assert "does not settle, steady error up to 0.2" in verdict("INCADEC (r=5.5)", 4).verdict
    assert "with back-calculation" in verdict("INCADEC (r=5.5)", 4).verdict
    rewrite(tmp_path, "incadec", "sp_a", max_asse=1e-5)
    assert "without offset" in verdict("INCADEC (r=5.5)", 4).verdict


def test_claims_follow_the_measurement(tmp_path):
    claims = made_up.claims_of(CASE)

    def outcome(text: str) -> bool | None:
        return {v.what: v.holds for v in judge(load(tmp_path), claims).statements}[text]

    with_laws(tmp_path, pid=1.35, inc=2.7)
    assert outcome("the PID is slow, or unstable when tuned faster") is False
    rewrite(tmp_path, "pid", "sp_a", mae=0.2)
    assert outcome("the PID is slow, or unstable when tuned faster") is True
    assert outcome("INC cannot hold the unstable point") is True
    rewrite(tmp_path, "inc", "sp_a", mae=0.07)
    assert outcome("INC cannot hold the unstable point") is False
    assert outcome("the error correction leaves no offset") is None
    with_laws(tmp_path, incadec=3.0, incad=1.8)
    assert outcome("the error correction leaves no offset") is False
    rewrite(tmp_path, "incadec", "sp_a", max_asse=1e-4)
    assert outcome("the error correction leaves no offset") is True
    assert outcome("the MAE over r has a minimum") is False  # it lies at the smallest r that was made up
    rewrite(tmp_path, "incad", "sp_a", mae=9.0)
    assert outcome("the MAE over r has a minimum") is True
    assert outcome("88 fuzzy sets an input give 726 centres") is None
    made_up.write_models(tmp_path)
    assert outcome("88 fuzzy sets an input give 726 centres") is True
    assert outcome("validation RMSE 18.76 K") is True


def test_requirements_are_met_or_not(root, tmp_path, monkeypatch):
    evidence = load(root)

    def met(need: Requirement) -> bool | None:
        return requirement(need, evidence).holds

    assert met(Requirement(None, "held_out", "mae", 1.2, times="nmpc")) is True
    assert met(Requirement(None, "held_out", "mae", 1.1, times="nmpc")) is False
    assert met(Requirement("inc", "sp_a", "mae", 0.18, low=0.15)) is True
    assert met(Requirement("inc", "sp_a", "mae", 0.18, low=0.175)) is False
    assert met(Requirement("incad", "sp_b", "mae", 0.018, setting={"r": 1.5})) is True
    assert met(Requirement("incad", "sp_b", "mae", 0.018, setting={"r": 1.6})) is None
    assert met(Requirement(None, "tin", "mae", 1.2, times="offline")) is None
    rows = {v.what: v for v in acceptance(evidence, made_up.claims_of(CASE))}
    assert rows["best controller, data seeds"].holds is False  # three were made up
    assert rows["eigenvalues at the middle steady state [1/s]"].holds
    assert rows["steady states at Tj = 250 K"].holds
    assert rows["turning points"].holds
    made_up.write_validation(tmp_path, "pid", 1.3, lock_ups=1)
    locked = load(tmp_path)
    assert locked.best is None
    rows = {v.what: v for v in acceptance(locked, PLAIN)}
    assert rows["best controller, data seeds"].holds is False
    draw_nothing(monkeypatch)
    made_up.report(locked, tmp_path / "out")  # a report also of a case where nothing works
    assert "No law qualifies" in (tmp_path / "out" / "report.html").read_text()
    for page in ("report.html", "report.md"):
        text = (tmp_path / "out" / page).read_text()
        assert re.search(r"`?pid(`|</code>) locked up in one closed loop(\*\*|</b>): sp_a \(seed 0\). It is", text)


@pytest.mark.parametrize(
    ("ours", "paper", "same"),
    [(0.124, 0.1, True), (0.126, 0.1, False), (0.0001, 0.0, True), (0.0002, 0.0, False), (0.0001, 0.00005, True)],
)
def test_what_reproduces(ours, paper, same):
    assert close(ours, paper) is same


def test_a_figure_may_say_how_near_ours_must_be(root):
    """A slip of 0.1 % in what follows from equations alone would pass under a quarter of the figure."""
    evidence, row = load(root), PaperFigure("x", "pid", "sp_a", "mae", 0.0)
    ours = evidence.figure("pid", "sp_a", "mae")
    assert ours is not None

    def judged(paper: float, within: float | None):
        return table_row(replace(row, paper=paper, within=within), evidence, PLAIN.reason)

    assert judged(ours * 1.001, None).verdict == "reproduces"
    slip = judged(ours * 1.001, 5e-4 * ours)
    assert slip.holds is False
    assert slip.digits > judged(ours, None).digits
    assert re.search(r"it is -\S+ from the paper's, where \S+ is allowed", slip.verdict)
    assert judged(ours * 1.0004, 5e-4 * ours).verdict.startswith("reproduces within")


def test_settings_find_their_variant(root):
    evidence = load(root)
    incad, incadec, back = evidence.laws["incad"], evidence.laws["incadec"], made_up.BACK
    assert incad.form_of({}) == incad.form_of({"r": 1.5}) == "base"
    assert incad.form_of({"r": 10}) == "r=10"
    assert incad.form_of({"r": 7}) is None
    assert incadec.form_of({"r": 10}) == "r=10"
    assert incadec.form_of(back) == "r=5.5, back"
    assert incadec.form_of({"r": 10, **back}) == "r=10, back"
    renamed = {"wide" if name == "r=10" else name: form for name, form in incad.metrics.forms.items()}
    assert replace(incad, metrics=replace(incad.metrics, forms=renamed)).form_of({"r": 10}) == "wide"
    loop = evidence.loop(Curve("incad", {"r": 2.5}), "sp_a_hold160")
    assert loop is not None
    assert loop["pv"].shape == (1120, 2)
    assert np.all(np.diff(loop["time_s"]) > 0)
    assert evidence.loop(Curve("inc"), "sp_a_hold7") is None
    plain = PaperFigure("x", "pid", "sp_a", "mae", 0.2)
    assert "times the paper's" in table_row(plain, evidence, PLAIN.reason).verdict


def test_nothing_to_report_is_one_clear_error(tmp_path):
    with pytest.raises(ReportError, match="run `dvc repro`"):
        load(tmp_path)
    made_up.write_validation(tmp_path, "pid", 1.3)
    (tmp_path / "work" / CASE / "validation" / "pid" / "metrics.json").write_text("{half")
    with pytest.raises(ReportError, match=r"pid.metrics\.json cannot be read"):
        load(tmp_path)


def test_the_report_needs_no_heavy_import():
    code = "import sys, loopwright.pipeline.stages.report; print({'torch', 'mlflow', 'onnxruntime'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert found.stdout.strip() == "set()"


def test_a_partial_file_of_bounds_gives_a_report_that_says_what_is_missing(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = json.loads(bounds.bounds_path(CASES[CASE]).read_text())
    del stored["figures"]["ua"]
    partial = tmp_path / "partial.json"
    partial.write_text(json.dumps(stored))
    for module in ("loopwright.pipeline.optimal.bounds", "loopwright.pipeline.stages.report"):
        monkeypatch.setattr(f"{module}.bounds_path", lambda case: partial)
    laws = {f"{CASE}-{law}": {"case": CASE, "name": law, "law": law, "model": "one_step"} for law in LAWS}
    case = {"held_out_seeds": list(CASES[CASE].held_out_seeds)}
    models = {f"{CASE}-one_step": {"case": CASE, "model": "one_step", "data": "work", "parts": {}}}
    params = {"cases": {CASE: case}, "records": {}, "models": models, "controllers": laws}
    own = tmp_path / "own"
    shutil.copytree(root, own)
    (own / "params.yaml").write_text(yaml.safe_dump(params))
    monkeypatch.chdir(own)
    draw_nothing(monkeypatch)
    report(CASE)
    assert "has no nmpc figures of scenario 'ua' as it is now; run `loopwright bounds" in capsys.readouterr().err
    folder = own / "artifacts" / CASE
    tree = json.loads((folder / "validation.json").read_text())
    assert "ua" not in tree["bounds"]
    assert tree["bounds"]["held_out"]["nmpc"]["mae"] > 0
    for name in ("report.html", "report.md"):
        text = (folder / name).read_text()
        assert "The perfect-model NMPC was not computed for: ua." in text
        assert "This case has no bounds" not in text


def test_certificates_of_the_shipped_laws_are_shown_with_what_they_rest_on(root):
    case = CASES[CASE]
    plan = CertificatePlan("a" * 64, case, CertificateParams(loops=8))
    outcomes = [StressOutcome(k, {"mae": 0.1}, k == 3, False, 0, False) for k in range(8)]
    certificate = plan.certificate(outcomes, "a host")
    evidence = load(root)
    before = context(evidence, judge(evidence, PLAIN), {}, ())
    law = evidence.laws["pid"]
    evidence.laws["pid"] = replace(law, metrics=replace(law.metrics, certificate=certificate))
    content = context(evidence, judge(evidence, PLAIN), {}, ())
    assert content["certificates"] == {"pid": certificate}
    for page in ("report.html.j2", "report.md.j2"):
        shown = unescape(render(page, content))
        assert certificate.sentence[3:] in shown
        assert all(words[1:] in shown for words in certificate.grounds)
        assert "Certificates" not in render(page, before)
    path = root / "metrics.json"
    evidence.laws["pid"].metrics.write(path)
    assert LawMetrics.read(path).certificate == certificate
