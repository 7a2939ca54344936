"""An export that grows, under the real DVC: which stages are stale, and what the models learn from."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from dirty_plant import cells, clean, write

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.config.exports import screened_record
from loopwright.pipeline.engine.dvc import COMMAND

ROOT = Path(__file__).parents[2]
ROLES = ["--pv", "TIC-101.PV[degC]=0..120", "--mv", "TIC-101.OP[%]", "--dv", "FI-7[kg/h]=300..700"]
FIT = "fit@tank-identified"
# The sources in the present folder, and one worker: each loads its libraries for seconds.
OWN = {"DVC_NO_ANALYTICS": "1", "PYTHONPATH": str(ROOT / "tools/roots"), "LOOPWRIGHT_WORKERS": "1"}


def dvc(*arguments: str) -> str:
    """What DVC prints in the present folder."""
    environment = {**os.environ, **OWN}
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    done = subprocess.run(
        [*COMMAND, *arguments], env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture
def _repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for package in ("pipeline", "serving"):
        # With what Python and numba have compiled, which takes them many seconds.
        shutil.copytree(ROOT / package, package)
    Path(".dvc").mkdir()
    for name in ("dvc.yaml", ".dvcignore", ".gitignore", ".dvc/config", ".dvc/.gitignore"):
        shutil.copy(ROOT / name, name)
    subprocess.run(["git", "init", "--quiet"], check=True)
    # Without the section of exports, as written before there was one.
    Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")


def small() -> None:
    """Linear models of first order, learnt in seconds."""
    tree: dict[str, Any] = yaml.safe_load(Path("params.yaml").read_text())
    part = {"kind": "identified", "orders": [1, 1], "units": [], "lagged": False, "minutes": 0.02, "rows": 400}
    tree["models"]["tank-identified"]["parts"] = {
        "identified": part,
        "plant1": {**part, "member": 1},
        "plant2": {**part, "member": 2},
    }
    tree["controllers"] = {}
    Path("params.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))


def stale(said: str) -> set[str]:
    """The stages that `loopwright run` lists before it runs them."""
    head, *lines = said.partition("stage 1 of ")[0].splitlines()
    assert head.endswith("Changed:"), said
    return {line.split()[0] for line in lines if line.startswith("  ")}


def data() -> tuple[int, bool]:
    """Rows of the record, and whether the models were learnt from it."""
    record = json.loads(screened_record("tank").with_name("metrics.json").read_text())["per_seed"]["0"]
    learnt = json.loads(Path("work/tank/models/identified/metrics.json").read_text())["data"]["0"]
    return record["rows"], record["digest"] == learnt


@pytest.mark.usefixtures("_repository")
def test_an_export_that_grows_makes_its_own_record_and_models_anew(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert dvc("stage", "list", "--name-only").split() == ["code", "overview", "publish"]
    write(Path("x.csv"), cells(clean(600)))
    assert main(["new", "tank", "x.csv", *ROLES]) == 0
    small()
    dvc("repro", "--quiet", FIT)
    assert data() == (600, True)
    write(Path("x.csv"), cells(clean(900)))
    capfd.readouterr()
    for name, value in OWN.items():
        monkeypatch.setenv(name, value)
    main(["run", "tank-identified"])  # its table lacks a report, which no stage here made
    said = capfd.readouterr().out
    assert stale(said) == {"screen@tank"}  # and after it, as `run` says, what depends on it
    assert data() == (900, True)
