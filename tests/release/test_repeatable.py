"""The stages run twice on the same inputs: the same bytes, and durations only where they are meant to be."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
import yaml

from loopwright.pipeline.stages.design import design
from loopwright.pipeline.stages.excite import excite
from loopwright.pipeline.stages.fit import fit
from loopwright.pipeline.stages.paths import TIMING, step_time_file
from loopwright.pipeline.stages.validate import validate

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from reduced import reduced

ROOT = Path(__file__).parents[2]
CASE = "thiosulfate_cstr"
# A sweep of partitions, a search over the sizes of an NNARX, a law with an RBF network, and a tuned one.
KEEP = {
    "records": (f"{CASE}-random_steps", "ph_neutralization-aprbs"),
    "models": (f"{CASE}-inverse", f"{CASE}-linearized", "ph_neutralization-nnarx"),
    "controllers": (f"{CASE}-incad", f"{CASE}-pid"),
}
STAGES = {"records": (excite,), "models": (fit,), "controllers": (design, validate)}


def run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """Every stage but the report, in an empty folder; the files that it leaves."""
    for name in ("plants", "models"):
        shutil.copytree(ROOT / "pipeline" / name, folder / "pipeline" / name)
    tree = reduced(yaml.safe_load((ROOT / "params.yaml").read_text()))
    for section, names in KEEP.items():
        tree[section] = {name: tree[section][name] for name in names}
    for record in tree["records"].values():
        record |= {"seeds": [0], "samples": 800}
    tree["models"]["ph_neutralization-nnarx"]["parts"]["nnarx"] |= {"trainer": {"kind": "lm", "iterations": 5}}
    for controller in tree["controllers"].values():
        controller.pop("variants", None)
    tree["controllers"][f"{CASE}-pid"]["tuning"] = "imc"
    tree["cases"][CASE]["held_out_seeds"] = tree["cases"][CASE]["held_out_seeds"][:1]
    (folder / "params.yaml").write_text(yaml.safe_dump(tree))
    monkeypatch.chdir(folder)
    for section, stages in STAGES.items():
        for name in KEEP[section]:
            for stage in stages:
                stage(name)
    made = (p for top in ("work", "artifacts", TIMING) for p in Path(top).rglob("*") if p.is_file())
    return {p.as_posix(): p.read_bytes() for p in made}


def test_the_same_inputs_give_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = (run(tmp_path / name, monkeypatch) for name in ("one", "other"))
    assert set(one) == set(other)
    receipts = {step_time_file(CASE, law).as_posix() for law in ("incad", "pid")}
    assert receipts == {name for name in one if name.startswith(TIMING.as_posix())}
    for name in receipts:
        assert 0 < json.loads(one[name])["p50"] <= json.loads(one[name])["p99"]
    kinds = {Path(name).name for name in one}
    assert {"seed0.parquet", "sweep.json", "sweep.png", "predictions.npz", "incad.onnx", "trajectories.npz"} <= kinds
    assert [name for name in sorted(set(one) - receipts) if one[name] != other[name]] == []


def test_no_stage_depends_on_a_duration() -> None:
    stages = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]
    for stage in stages.values():
        for dependency in stage.get("do", stage).get("deps", ()):
            assert not Path(dependency).is_relative_to(TIMING), dependency
            assert not TIMING.is_relative_to(dependency), dependency
    (receipt,) = [out for out in stages["validate"]["do"]["outs"] if str(out).startswith(TIMING.as_posix())]
    assert receipt == step_time_file("${item.case}", "${item.name}").as_posix()
