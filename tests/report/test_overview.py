"""The overview of all cases, on the page and in the terminal: what validation.json says, and nothing else."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from jinja2 import DictLoader
from markupsafe import Markup
from rich.console import Console

from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.evaluation.leaderboard import CaseStanding, tally
from loopwright.pipeline.evaluation.validation import VALIDATION_SCHEMA
from loopwright.pipeline.report import templating
from loopwright.pipeline.report.overview import write_overview
from loopwright.pipeline.report.results import show_results
from loopwright.pipeline.report.templating import render
from loopwright.pipeline.stages.overview import overview


def verdict(what: str, holds: bool | None, because: str = "") -> dict[str, Any]:
    return {"what": what, "limit": "asked | found", "measured": "3 < 4", "holds": holds, "because": because}


def printed(paper: float, holds: bool | None) -> dict[str, Any]:
    return {"table": 1, "label": "x", "metric": "e", "paper": paper, "ours": 1.0, "verdict": "words", "holds": holds}


def a_case(name: str, metric: str, bound: float | None, errors: dict[str, float], floor: float = 0.0) -> dict[str, Any]:
    """A validation.json; the main test is the noisy one, and its bound may be missing."""
    rows = {
        law: {metric: e, f"{metric}_min": 0.9 * e, f"{metric}_max": 1.1 * e, "seeds": 3} for law, e in errors.items()
    }
    return {
        "schema": VALIDATION_SCHEMA,
        "case": name,
        "metric": metric,
        "best": "alpha",
        "main": "steps_noise",
        "scenarios": {"steps": rows, "steps_noise": rows, "held_out": rows},
        "bounds": {} if bound is None else {"steps_noise": {"nmpc": {metric: bound}}},
        "gate": {
            "id": "g1",
            "weights": {"steps_noise": 0.7, "held_out": 0.3},
            "baseline": "pid",
            "baseline_name": "PID",
            "floor": floor,
            "floors": {"steps": floor, "held_out": floor},
            "laws": {},
        },
        "laws": {law: {"seeds": 3, "lock_ups": 0, "step_us": 20.0} for law in errors},
        "requirements": [verdict("fast", True), verdict("exact", False, "noise"), verdict("cheap", None)],
        "claims": [verdict(f"{name} is <stable>", False), verdict("it is quick", True)],
        "paper": [
            printed(1.0, True),
            printed(1.0, None),
            printed(1.0, False),
        ],
        "titles": {
            "case": f"The {name}",
            "metric": "error in words",
            "metric_short": "ERR",
            "figures": {},
            "laws": {law: f"Law {law.title()}" for law in errors},
            "scenarios": {"steps": "Steps up"},
            "unit": "mol/l" if name == "tank" else "",
        },
    }


@pytest.fixture
def artifacts(tmp_path: Path) -> Path:
    """Two cases: one with a bound, one without; files and pictures of some laws."""
    cases = [
        a_case("tank", "mae", 0.02, {"alpha": 0.03, "pid": 0.05, "beta": 0.02}),
        a_case("reactor", "tracking", None, {"alpha": 12_345.6, "pid": 2.0}),
    ]
    for tree in cases:
        folder = tmp_path / tree["case"]
        (folder / "figures").mkdir(parents=True)
        (folder / "validation.json").write_text(json.dumps(tree))
        (folder / "alpha.onnx").write_bytes(b"x" * 20_480)
        for name in ("report.html", "report.md", "figures/closed_loop.png", "figures/closed_loop_alpha.png"):
            (folder / name).write_bytes(b"x")
    return tmp_path


def standings(artifacts: Path) -> list[CaseStanding]:
    return [CaseStanding.read(artifacts / name) for name in ("tank", "reactor")]


def test_a_standing_is_what_programs_were_told(artifacts: Path) -> None:
    tank, reactor = standings(artifacts)
    assert [law.law for law in tank.laws] == ["beta", "alpha", "pid"]  # the best figure first
    assert [law.ratio for law in tank.laws] == pytest.approx([1.0, 1.5, 2.5])
    assert tank.best is not None
    assert (tank.best.law, tank.best.bytes, tank.best.step_us, tank.best.seeds) == ("alpha", 20_480, 20.0, 3)
    assert (tank.test_title, tank.bound) == ("Steps up with noise", 0.02)
    assert tally(tank.requirements) == (1, 2)  # what was not measured counts neither way
    assert tally(tank.claims) == tank.reproduced == (1, 2)
    assert reactor.bound is None
    assert all(law.ratio is None for law in reactor.laws)


def test_where_noise_would_hide_the_bound_the_ratio_is_to_what_it_hides(tmp_path: Path) -> None:
    tree = a_case("tank", "mae", 1e-8, {"alpha": 0.03, "beta": 1e-5}, floor=0.02)
    (tmp_path / "tank").mkdir()
    (tmp_path / "tank" / "validation.json").write_text(json.dumps(tree))
    standing = CaseStanding.read(tmp_path / "tank")
    assert (standing.bound, standing.hidden) == (1e-8, True)
    assert [law.ratio for law in standing.laws] == pytest.approx([1.0, 1.5])
    text = "\n".join(shown(tmp_path))
    assert "1.50n" in text
    assert "n          noise can hide more than the bound" in text
    html, _ = write_overview([standing], tmp_path)
    assert "1.50 †" in html.read_text()


def test_the_page_shows_every_law_and_links_to_what_exists(artifacts: Path) -> None:
    paths = write_overview(standings(artifacts), artifacts)
    assert [p.name for p in paths] == ["report.html", "report.md"]
    html, text = (p.read_text() for p in paths)
    links = re.findall(r'(?:src|href)="([^"#]+)[^"]*"', html) + re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) > 15
    for link in links:
        assert link.startswith("http://127.0.0.1") or (artifacts / link).exists(), link
    ids = set(re.findall(r'id="([^"]+)"', html))
    assert set(re.findall(r'href="#([^"]+)"', html)) <= ids
    for page in (html, text):
        for name in ("tank-alpha", "tank-beta", "tank-pid", "reactor-alpha", "reactor-pid"):
            assert f"/#/models/{name}" in page
        for words in ("Law Beta", "1.50", "20 kB", "12,346", "Steps up with noise", "The reactor"):
            assert words in page, words
        assert "None" not in page
        # The figure's unit, where it has one.
        assert "rror in words (ERR) in mol/l: Steps up with noise" in page
        assert "rror in words (ERR): Steps up with noise" in page
        assert page.count("figures/closed_loop_alpha.png") == 2
    assert "tank is &lt;stable&gt;" in html
    assert "2 of 4 requirements met" in text
    assert "2 of 4 statements of the papers reproduce" in text
    for table in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        assert len({row.count("|") - row.count("\\|") for row in table.splitlines()}) == 1, table
    missed = html[html.index('id="missed"') : html.index('id="claims"')]
    assert missed.count("<td>exact") == 2
    assert "cheap" not in missed


def test_the_stage_shows_the_cases_that_params_yaml_lists(
    artifacts: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(artifacts)
    (artifacts / "artifacts").mkdir()
    for name in ("tank", "reactor"):
        (artifacts / name).rename(artifacts / "artifacts" / name)
    (artifacts / "params.yaml").write_text("cases: {reactor: {noise_seed: 1}}\n")
    assert run_stage(overview, ["overview"]) == 0
    assert "reactor-alpha" in (page := (artifacts / "artifacts" / "report.html").read_text())
    assert "tank" not in page  # a folder that an earlier run left
    (artifacts / "params.yaml").write_text("cases: {reactor: {}, mill: {}}\n")
    assert run_stage(overview, ["overview"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "validation.json cannot be read" in said


def shown(artifacts: Path, case: str | None = None) -> list[str]:
    page = io.StringIO()
    show_results(artifacts, Console(file=page), case)
    return page.getvalue().splitlines()


def test_the_terminal_has_one_table_over_all_cases(artifacts: Path) -> None:
    lines = shown(artifacts)
    assert max(map(len, lines)) <= 120
    rows = [line.split() for line in lines]
    assert ["alpha", "*", "0.0300", "0.0200", "1.50", "20", "us", "20", "kB"] in [row[-9:] for row in rows]
    assert ["pid", "2.0000", "-", "-", "20", "us", "-"] in [row[-7:] for row in rows]  # no bound, no file
    text = "\n".join(lines)
    for words in ("1 of 2 requirements", "1 of 2 claims reproduce", "1 of 2 figures reproduce"):
        assert text.count(words) == 2, words
    assert text.count(" ERR [mol/l], steps_noise ") == text.count(" ERR, steps_noise ") == 1
    assert f"overview   {artifacts / 'report.html'}" in text
    assert "registry   make registry" in text


def test_a_lock_up_stands_beside_the_laws_name(artifacts: Path) -> None:
    assert not any("!" in line for line in shown(artifacts))
    path = artifacts / "tank" / "validation.json"
    tree = json.loads(path.read_text())
    tree["laws"]["pid"] |= {"lock_ups": 9, "locked_up": {"steps": {"0": 9}}, "as_printed": True}
    path.write_text(json.dumps(tree))
    lines = shown(artifacts)
    assert max(map(len, lines)) <= 120
    assert any(" pid !9 " in line for line in lines)
    assert any(line.startswith("!  ") and "do not run it on a plant" in line for line in lines)
    assert ["lock-ups", "0", "0", "9"] in [line.split() for line in shown(artifacts, "tank")]


def test_set_points_beyond_the_record_are_said_aloud(artifacts: Path) -> None:
    path = artifacts / "tank" / "validation.json"
    tree = json.loads(path.read_text())
    for far, said in (({}, False), ({"T[1]": 61.5}, True)):
        path.write_text(json.dumps(tree | {"grounds": {"fit": {"T[1]": 93.0}, "set_points": far, "loops": {}}}))
        for case, wanted in ((None, said), ("tank", said), ("reactor", False)):
            lines = [line for line in shown(artifacts, case) if "beyond the record" in line]
            words = "tank: Set points of the tests go beyond the record, T[1] by 61.5 % of its recorded range"
            assert [line.startswith(words) for line in lines] == [True] * wanted


def test_one_case_is_shown_in_all_of_its_tests(artifacts: Path) -> None:
    text = "\n".join(shown(artifacts, "tank"))
    assert "steps_noise / NMPC" in text
    assert "held_out" in text
    assert "NMPC" in next(line for line in text.splitlines() if line.split()[:1] == ["test"])
    assert "reactor" not in text
    row = next(line.split() for line in text.splitlines() if line.split()[:1] == ["held_out"])
    assert row == ["held_out", "-", "0.0200", "0.0300", "0.0500"]  # the bound first, then the laws
    with pytest.raises(PipelineError, match=r"no case 'tanc'; it has reactor, tank"):
        show_results(artifacts, case="tanc")


def test_what_cannot_be_read_is_one_clear_error(artifacts: Path, tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="none holds no results"):
        show_results(tmp_path / "none")
    (artifacts / "tank" / "validation.json").write_text('{"scenarios": {}}')
    with pytest.raises(PipelineError, match=r"tank.validation\.json has schema None.*dvc repro"):
        CaseStanding.read(artifacts / "tank")


def test_the_overview_needs_no_heavy_import() -> None:
    heavy = "{'torch', 'mlflow', 'onnxruntime', 'casadi', 'scipy', 'matplotlib', 'pandas'}"
    code = f"import sys, loopwright.pipeline.stages.overview; print({heavy} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert found.stdout.strip() == "set()"


def test_a_text_that_acts_on_a_reader_is_spelt_out_in_any_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names with such a text are refused where files are loaded; a page does not rely on it."""
    pages = dict.fromkeys(("a.html.j2", "a.md.j2"), "<{{ x }}\n{{ y }}>")
    monkeypatch.setattr(templating, "PackageLoader", lambda _: DictLoader(pages))
    monkeypatch.setattr(templating, "_environment", templating._environment.__wrapped__)  # made before, with ours
    content = {"x": "T\x1b[2J\u202e<b>\nline", "y": Markup("<i>\n</i>")}
    assert render("a.md.j2", content) == "<T\\x1b[2J\\u202e<b>\nline\n<i>\n</i>>"
    assert render("a.html.j2", content) == "<T\\x1b[2J\\u202e&lt;b&gt;\nline\n<i>\n</i>>"
