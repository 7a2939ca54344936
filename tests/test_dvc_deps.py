"""dvc.yaml: a stage runs again when a file that it runs was edited."""

from __future__ import annotations

from pathlib import Path

import grimp
import pytest
import yaml

from pipeline.cases import CASES

ROOT = Path(__file__).parents[1]
STAGES = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]
# What carries a stage's work from place to place and has no part in its result.
CARRIERS = {
    "pipeline/command.py",
    "pipeline/errors.py",
    "pipeline/parallel.py",
    "pipeline/params.py",
    "pipeline/stages/__init__.py",
    "pipeline/cases/__init__.py",
    "pipeline/cases/effort.py",
    "serving/errors.py",
    "serving/manifest.py",
}
# A law is designed from trained models: what trained them has had its effect. The parity gate says whether the
# runtime agrees with the law, and changes nothing.
TRAINING = {"pipeline/metrics.py", "pipeline/record.py", "pipeline/record_file.py"}
GATE = {"serving/controller.py", "serving/digest.py", "serving/graph_audit.py"}
# Which tests a case has does not change its plant; publishing reads results, whatever plant they are of.
APART = {
    "excite": {"pipeline/cases/base.py", "pipeline/reference_model.py"},
    "fit": {"pipeline/cases/base.py", "pipeline/reference_model.py"},
    "design": {"pipeline/cases/base.py", *TRAINING, *GATE},
    "publish": {"pipeline/cases/base.py", "pipeline/plants"},
}


def file_of(module: str) -> str:
    path = Path(*module.split("."))
    return (path / "__init__.py" if (ROOT / path).is_dir() else path.with_suffix(".py")).as_posix()


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("pipeline", "serving", cache_dir=None)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("stage", STAGES)
def test_every_file_that_a_stage_runs_is_a_dependency(stage: str, case: str, graph: grimp.ImportGraph) -> None:
    deps = STAGES[stage].get("do", STAGES[stage])["deps"]
    known = {d.replace("${item.case}", case).replace("${key}", case) for d in deps} | APART.get(stage, set())
    start = f"pipeline.stages.{stage}"
    # Of the cases a stage runs one, and what that one is made of.
    others = {f"pipeline.cases.{c}" for c in CASES} - {f"pipeline.cases.{case}"}
    others -= graph.find_upstream_modules(f"pipeline.cases.{case}") if stage == "validate" else set()
    files = {file_of(m) for m in {start, *graph.find_upstream_modules(start)} - others} - CARRIERS
    assert sorted(f for f in files if not any(f == d or f.startswith(f"{d}/") for d in known)) == []
