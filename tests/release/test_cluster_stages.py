"""Stages on a real cluster: the same bytes as here, and nothing half-written."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from dask_cluster import ROOT, joined, two_workers  # noqa: F401
from own_cases import controllers_of_a_lag
from processes import within

from loopwright.pipeline.engine.cluster import ADDRESS, connected
from loopwright.pipeline.engine.stage_files import DATA, read_files
from loopwright.pipeline.files import write_json
from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.excite import excite
from loopwright.pipeline.stages.fit import fit
from loopwright.pipeline.stages.validate import validate

# Dask closes some of its sockets only as it is collected.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
GIVEN = {"law": "pid", "tuning": "manual", "kc": 0.2, "ti_s": 3.0}


@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dvc.yaml").write_text((ROOT / "dvc.yaml").read_text())
    controllers_of_a_lag({"pid": GIVEN})
    write_json(DATA, {"it": ["data/it/record.parquet"]})  # as the stage `code` leaves it
    return tmp_path


def begin(stage: str, name: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
    command, pipe = [sys.executable, "-m", "loopwright.pipeline.engine.start", stage, name], subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True)


def run(stage: str, name: str) -> tuple[int, str]:
    """The stage's exit status, and what it said on standard error."""
    process = begin(stage, name)
    _, said = process.communicate(timeout=120)
    return process.returncode, said


def made() -> dict[str, bytes]:
    # The step's time is measured, and stands in no other file.
    return read_files([Path("work/it/controllers"), Path("work/it/validation"), Path("artifacts")])


def test_stages_on_the_cluster_write_the_same_bytes_as_here(address: str, plant: Path) -> None:
    (plant / "artifacts/it").mkdir(parents=True)
    for stage, words in (("design", ""), ("validate", "validate it-pid: one step takes")):
        status, said = run(stage, "it-pid")
        assert status == 0, said
        assert words in said
    there = made()
    assert "artifacts/it/pid.onnx" in there
    os.environ.pop(ADDRESS)
    design("it-pid")
    validate("it-pid")
    assert made() == there


def test_records_and_models_of_the_cluster_are_the_same_bytes_as_here(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An experiment on a plant in equations, and networks trained on the records of two seeds."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "dvc.yaml", tmp_path)
    record, model = "reversible_cstr-aprbs", "reversible_cstr-plant_network"
    params = yaml.safe_load((ROOT / "params.yaml").read_text())
    params["records"] = {record: {**params["records"][record], "seeds": [0, 1], "samples": 600}}
    small = {"steps": 5, "free_run_iterations": 2, "long_run": 50, "trainer": {"kind": "lm", "iterations": 5}}
    parts = {name: {**part, **small} for name, part in params["models"][model]["parts"].items()}
    params["models"] = {model: {**params["models"][model], "parts": parts}}
    (tmp_path / "params.yaml").write_text(yaml.safe_dump({**params, "controllers": {}}))
    write_json(DATA, {})
    made = Path("work/reversible_cstr")
    for stage, name in (("excite", record), ("fit", model)):
        status, said = run(stage, name)
        assert status == 0, said
    found = read_files([made])
    assert {Path(name).suffix for name in found} >= {".parquet", ".npz"}
    shutil.rmtree(made)
    os.environ.pop(ADDRESS)
    excite(record)
    fit(model)
    assert read_files([made]) == found


def test_a_mistake_is_one_line_and_leaves_what_was_there(address: str, plant: Path) -> None:
    design("it-pid")
    before = made()
    params = plant / "params.yaml"
    params.write_text(params.read_text().replace("kc: 0.2", "kcc: 0.2"))
    status, said = run("design", "it-pid")
    assert status == 2
    assert said.count("\n") == 1
    assert "controllers.it-pid: unknown key 'kcc'" in said
    assert made() == before


def test_a_client_that_is_killed_leaves_nothing_half_written_and_idle_workers(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "dvc.yaml", tmp_path)
    record = "reversible_cstr-aprbs"
    params = yaml.safe_load((ROOT / "params.yaml").read_text())
    params["records"] = {record: {**params["records"][record], "seeds": [0, 1]}}
    (tmp_path / "params.yaml").write_text(yaml.safe_dump({**params, "models": {}, "controllers": {}}))
    write_json(DATA, {})
    client = connected(address)
    process = begin("excite", record)
    assert within(60, lambda: any(client.processing().values()))
    process.kill()
    process.communicate(timeout=20)
    assert within(60, lambda: not any(client.processing().values()))
    assert read_files([Path("work/reversible_cstr")]) == {}
