"""dvc.yaml and stage code: a stage runs again when a file that it runs was edited, and only then."""

from __future__ import annotations

import io
import shutil
import tokenize
from pathlib import Path

import pytest
import yaml

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.stages.code import (
    APART,
    CARRIERS,
    LAST,
    PACKAGES,
    STAGES,
    check_sources,
    code,
    graph,
    listing,
    modules,
    path_of,
    without_comments,
)

ROOT = Path(__file__).parents[2]
DVC = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_of_a_case_depends_on_its_files(stage: str) -> None:
    entry = DVC[stage]["do"]
    assert any(d.startswith(f"work/code/{stage}-") for d in entry["deps"])
    assert entry["cmd"].startswith(f"python -m loopwright.pipeline.engine.start {stage} ")
    assert not any(d.startswith(("pipeline/", "serving/")) for d in entry["deps"])


def test_the_list_of_files_is_made_of_all_of_them_and_before_the_rest() -> None:
    assert DVC["code"]["deps"] == ["pipeline", "serving", "params.yaml"]
    assert DVC["code"]["outs"] == ["work/code"]
    assert set(DVC) == {"code", *STAGES, *LAST}
    assert "work/code/overview.json" in DVC["overview"]["deps"]
    assert "work" in DVC["publish"]["deps"]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("stage", STAGES)
def test_nothing_is_missing_but_what_is_named_as_apart(stage: str, case: str) -> None:
    imports = graph()
    everything = {
        f"loopwright.pipeline.stages.{stage}",
        *imports.find_upstream_modules(f"loopwright.pipeline.stages.{stage}"),
    }
    own = modules(stage, case)
    named = (*CARRIERS, "loopwright.pipeline.cases", *(what for _, what in APART.get(stage, ())))

    def left_out(module: str) -> bool:
        return any(module == name or module.startswith(name + ".") for name in named if name not in PACKAGES)

    for module in {m for m in everything - own if not left_out(m)} - {"pipeline", "serving"}:
        importers = imports.find_modules_that_directly_import(module) & everything
        assert not {i for i in importers & own if i != "loopwright.pipeline.cases"}, module


@pytest.mark.parametrize(
    ("stage", "case", "path", "runs"),
    [
        ("excite", "thiosulfate_cstr", "pipeline/cases/thiosulfate_cstr/plant.py", True),
        ("excite", "thiosulfate_cstr", "pipeline/cases/batch_reactor/plant.py", False),
        ("excite", "thiosulfate_cstr", "pipeline/laws/pid/pid.py", False),
        ("fit", "ph_neutralization_15s", "pipeline/cases/ph_neutralization/plant.py", True),
        ("fit", "thiosulfate_cstr", "pipeline/models/static/rbf.py", True),
        ("fit", "thiosulfate_cstr", "pipeline/evaluation/case.py", False),
        ("fit", "batch_reactor", "pipeline/evaluation/proof.py", True),  # chooses between two models
        ("design", "thiosulfate_cstr", "pipeline/laws/pid/pid.py", True),
        ("design", "thiosulfate_cstr", "pipeline/export/graph.py", True),
        ("design", "thiosulfate_cstr", "pipeline/metrics.py", False),
        ("validate", "thiosulfate_cstr", "pipeline/metrics.py", True),
        ("validate", "thiosulfate_cstr", "serving/controller.py", True),
        ("validate", "thiosulfate_cstr", "pipeline/laws/pid/pid.py", False),
        ("validate", "ph_neutralization_15s", "pipeline/cases/ph_neutralization/case.py", True),
        ("validate", "thiosulfate_cstr", "pipeline/cases/ph_neutralization/case.py", False),
        ("report", "thiosulfate_cstr", "pipeline/cases/thiosulfate_cstr/paper.py", True),
        ("report", "thiosulfate_cstr", "pipeline/cases/batch_reactor/paper.py", False),
        ("report", "thiosulfate_cstr", "pipeline/report/templates/report.html.j2", True),
        ("report", "thiosulfate_cstr", "pipeline/cases/thiosulfate_cstr/bounds.json", True),
        ("overview", "", "pipeline/report/templates/overview.html.j2", True),
        ("publish", "", "pipeline/tracking/registry.py", True),
    ],
)
def test_a_stage_has_the_files_that_it_runs(stage: str, case: str, path: str, runs: bool) -> None:
    assert (ROOT / path).is_file()
    assert (path in listing(ROOT, stage, case)) is runs


def test_the_list_of_a_case_that_is_no_more_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever runs the stage finds what DVC finds, which empties the folder before."""
    (tmp_path / "params.yaml").write_text("cases: {}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("loopwright.pipeline.stages.code.listing", lambda *_: {})
    code()
    made = {file.name for file in Path("work/code").iterdir()}
    assert {"data.json", "overview.json", "publish.json", "fit-batch_reactor.json"} <= made
    Path("work/code/fit-tank.json").write_text("{}")
    code()
    assert {file.name for file in Path("work/code").iterdir()} == made


def test_an_edit_shows_in_the_stages_that_run_it_alone(tmp_path: Path) -> None:
    for package in ("pipeline", "serving"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    before = {(s, c): listing(tmp_path, s, c) for s in STAGES if s != "screen" for c in CASES}
    assert before[("design", "batch_reactor")] == listing(ROOT, "design", "batch_reactor")
    plant = tmp_path / "pipeline" / "cases" / "batch_reactor" / "plant.py"
    for added, cases in (("# a comment\n", set()), ("EDITED = True  # and another\n", {"batch_reactor"})):
        plant.write_text(plant.read_text() + added)
        edited = {key for key in before if listing(tmp_path, *key) != before[key]}
        assert edited == {key for key in before if key[1] in cases}


def test_sources_of_another_folder_are_refused(tmp_path: Path) -> None:
    """Results of the sources that run would be filed under those of the folder."""
    for package in ("pipeline", "serving"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    check_sources(tmp_path)  # the same ones
    check_sources(tmp_path / "pipeline")  # none at all
    with (tmp_path / "serving" / "words.py").open("a") as file:
        file.write("# edited\n")
    with pytest.raises(PipelineError, match="are not those that run"):
        check_sources(tmp_path)


def test_a_folder_of_compiled_files_hides_no_module(tmp_path: Path) -> None:
    """Git leaves it behind where a package became a module."""
    (tmp_path / "pipeline/models/tank/__pycache__").mkdir(parents=True)
    (tmp_path / "pipeline/models/tank.py").touch()
    assert path_of(tmp_path, "loopwright.pipeline.models.tank") == tmp_path / "pipeline/models/tank.py"
    (tmp_path / "pipeline/models/tank/__init__.py").touch()
    assert path_of(tmp_path, "loopwright.pipeline.models.tank") == tmp_path / "pipeline/models/tank/__init__.py"


def test_comments_are_those_of_the_tokenizer() -> None:
    """A ``#`` in a text is none, whatever its quotes."""
    for file in sorted((ROOT / "pipeline").rglob("*.py")):
        source = file.read_text(encoding="utf-8")
        lines: list[str | None] = [*source.split("\n")]
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                lines[token.start[0] - 1] = token.line[: token.start[1]].rstrip() or None
        assert without_comments(source) == "\n".join(line for line in lines if line is not None), file
