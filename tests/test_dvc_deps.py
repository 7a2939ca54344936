"""dvc.yaml and stage code: a stage runs again when a file that it runs was edited, and only then."""

from __future__ import annotations

import shutil
from pathlib import Path

import grimp
import pytest
import yaml

from pipeline.cases import CASES
from pipeline.stages.code import APART, BY_CASE, CARRIERS, LAST, STAGES, cases, imports, listing, modules

ROOT = Path(__file__).parents[1]
DVC = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("pipeline", "serving", cache_dir=None)


def test_the_cases_are_those_that_run() -> None:
    assert cases(ROOT) == sorted(CASES)


def test_imports_are_read_as_another_reader_reads_them(graph: grimp.ImportGraph) -> None:
    for module in graph.modules:
        assert imports(ROOT, module) == graph.find_modules_directly_imported_by(module), module


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_of_a_case_depends_on_its_files(stage: str) -> None:
    entry = DVC[stage]["do"]
    assert any(d.startswith(f"work/code/{stage}-") for d in entry["deps"])
    assert entry["cmd"].startswith(f"python -m pipeline.start {stage} ")
    assert not any(d.startswith(("pipeline/", "serving/")) for d in entry["deps"])


def test_the_list_of_files_is_made_of_all_of_them_and_before_the_rest() -> None:
    assert DVC["code"]["deps"] == ["pipeline", "serving"]
    assert DVC["code"]["outs"] == ["work/code"]
    assert set(DVC) == {"code", *STAGES, *LAST}
    assert "work/code/overview.json" in DVC["overview"]["deps"]
    assert "work" in DVC["publish"]["deps"]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("stage", STAGES)
def test_nothing_is_missing_but_what_is_named_as_apart(stage: str, case: str, graph: grimp.ImportGraph) -> None:
    everything = {f"pipeline.stages.{stage}", *graph.find_upstream_modules(f"pipeline.stages.{stage}")}
    missing = everything - modules(ROOT, stage, case) - CARRIERS - BY_CASE
    apart = {module for _, module in APART.get(stage, ())}
    # What the rest was reached through: a module that is apart, or another case.
    through = apart | {f"{package}.{c}" for package in BY_CASE for c in CASES if c != case}
    for module in missing - through:
        importers = graph.find_modules_that_directly_import(module) & everything
        assert importers <= missing | BY_CASE | CARRIERS | apart, module


@pytest.mark.parametrize(
    ("stage", "case", "path", "runs"),
    [
        ("excite", "thiosulfate_cstr", "pipeline/plants/thiosulfate_cstr.py", True),
        ("excite", "thiosulfate_cstr", "pipeline/plants/batch_reactor.py", False),
        ("excite", "thiosulfate_cstr", "pipeline/laws/pid.py", False),
        ("fit", "ph_neutralization_15s", "pipeline/plants/ph_neutralization.py", True),
        ("fit", "thiosulfate_cstr", "pipeline/models/rbf.py", True),
        ("fit", "thiosulfate_cstr", "pipeline/cases/base.py", False),
        ("design", "thiosulfate_cstr", "pipeline/laws/pid.py", True),
        ("design", "thiosulfate_cstr", "pipeline/graph.py", True),
        ("design", "thiosulfate_cstr", "pipeline/metrics.py", False),
        ("validate", "thiosulfate_cstr", "pipeline/metrics.py", True),
        ("validate", "thiosulfate_cstr", "serving/controller.py", True),
        ("validate", "thiosulfate_cstr", "pipeline/laws/pid.py", False),
        ("validate", "ph_neutralization_15s", "pipeline/cases/ph_neutralization.py", True),
        ("validate", "thiosulfate_cstr", "pipeline/cases/ph_neutralization.py", False),
        ("report", "thiosulfate_cstr", "pipeline/report/claims/thiosulfate_cstr.py", True),
        ("report", "thiosulfate_cstr", "pipeline/report/claims/batch_reactor.py", False),
        ("report", "thiosulfate_cstr", "pipeline/report/templates/report.html.j2", True),
        ("report", "thiosulfate_cstr", "pipeline/cases/thiosulfate_cstr.bounds.json", True),
        ("overview", "", "pipeline/report/templates/overview.html.j2", True),
        ("publish", "", "pipeline/tracking/registry.py", True),
    ],
)
def test_a_stage_has_the_files_that_it_runs(stage: str, case: str, path: str, runs: bool) -> None:
    assert (ROOT / path).is_file()
    assert (path in listing(ROOT, stage, case)) is runs


def test_an_edit_shows_in_the_stages_that_run_it_alone(tmp_path: Path) -> None:
    for package in ("pipeline", "serving"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    before = {(s, c): listing(tmp_path, s, c) for s in STAGES for c in CASES}
    assert before[("design", "batch_reactor")] == listing(ROOT, "design", "batch_reactor")
    with (tmp_path / "pipeline" / "plants" / "batch_reactor.py").open("a") as file:
        file.write("# edited\n")
    edited = {key for key in before if listing(tmp_path, *key) != before[key]}
    assert edited == {(stage, "batch_reactor") for stage in STAGES}
