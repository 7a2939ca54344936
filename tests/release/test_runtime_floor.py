"""Every shipped controller loads and agrees at the oldest and at the newest versions that pyproject.toml allows."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import shipped_files

from loopwright.pipeline.export.gate import GATE_TOLERANCE
from loopwright.serving import Controller

ROOT = Path(__file__).parents[2]
SHIPPED = sorted(f"{file.parent.name}/{file.stem}" for file in shipped_files.SHIPPED)
# law whose plan amplifies rounding -> by how much its MVs may differ, times 1e-12
AMPLIFYING = {
    "batch_reactor/predictive": 10,
    "henson_seborg_cstr/predictive": 10,
    "ph_neutralization_15s/predictive": 1,  # its plan is 5e-12 off after 200 samples, its MVs are not
}
DEPENDENCIES = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
Runs = Mapping[str, Mapping[str, np.ndarray]]


def command(*words: str | Path) -> str:
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT / "tools/roots"), "PYTHONNOUSERSITE": "1"}
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, cwd=ROOT, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def pythons() -> dict[str, Path]:
    """The interpreters; those of the two environments are made here unless an earlier run made them."""
    done = subprocess.run(
        ["bash", "tools/runtime_venvs.sh", "build/runtime"],
        cwd=ROOT,
        env={**os.environ, "PYTHON": sys.executable},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    made = {name: ROOT / "build" / "runtime" / name / "bin" / "python" for name in ("floor", "newest")}
    return {"here": Path(sys.executable), **made}


@pytest.fixture(scope="module")
def runs(pythons: Mapping[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """Trajectories of every shipped controller in each environment."""
    results = {}
    for name, python in pythons.items():
        out = tmp_path_factory.mktemp("runtime") / f"{name}.npz"
        command(python, "tools/step_shipped.py", "artifacts", out)
        with np.load(out) as file:
            results[name] = {key: file[key] for key in file if key in SHIPPED}
    return results


def installed(python: Path) -> dict[str, tuple[int, ...]]:
    names = [dependency.partition(">=")[0] for dependency in DEPENDENCIES]
    code = f"from importlib.metadata import version\nfor name in {names}: print(version(name))"
    numbers = command(python, "-c", code).split()
    return {name: _parts(number) for name, number in zip(names, numbers, strict=True)}


def _parts(number: str) -> tuple[int, ...]:
    parts = tuple(map(int, number.split(".")))
    return parts + (0,) * (3 - len(parts))


def test_the_environments_are_what_they_are_called(pythons: Mapping[str, Path]) -> None:
    promised = dict(dependency.split(">=") for dependency in DEPENDENCIES)
    assert installed(pythons["floor"]) == {name: _parts(number) for name, number in promised.items()}
    newest = installed(pythons["newest"])
    assert all(newest[name] >= _parts(version(name)) > _parts(number) for name, number in promised.items())


def test_nothing_of_the_pipeline_is_there(pythons: Mapping[str, Path]) -> None:
    code = "from importlib.util import find_spec\nprint([n for n in ('torch', 'onnx', 'scipy') if find_spec(n)])"
    for name in ("floor", "newest"):
        assert command(pythons[name], "-c", code).strip() == "[]"


def test_every_shipped_controller_runs_in_every_environment(runs: Runs) -> None:
    assert SHIPPED
    for name, run in runs.items():
        assert sorted(run) == SHIPPED, name


@pytest.mark.parametrize("controller", SHIPPED)
def test_trajectories_agree(runs: Runs, controller: str) -> None:
    """To rounding: 1e-12 of the largest value of each MV, state and info entry.

    A plan whose moves cost next to nothing amplifies the rounding before it, by some thousands in 200 samples. States
    and info of such a law agree to the tolerance of the parity gate, its MVs to 1e-12 or 1e-11.
    """
    newest = runs["newest"][controller]
    assert len(np.unique(newest, axis=0)) > len(newest) / 2  # the samples move the law
    scale = np.abs(newest).max(axis=0)
    if controller in AMPLIFYING:
        n_mv = len(Controller(ROOT / "artifacts" / f"{controller}.onnx").manifest.mv)
        scale[:n_mv] *= AMPLIFYING[controller]
        scale[n_mv:] *= GATE_TOLERANCE / 1e-12
    for name in ("floor", "here"):
        assert (np.abs(runs[name][controller] - newest) <= 1e-12 * scale).all(), name
