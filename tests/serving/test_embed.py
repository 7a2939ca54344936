"""The embedding examples run on a real controller, are as short as promised and agree to the bit."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from kits import DAMAGES, an_old_version, kit_of, spoilt, verdict_on
from shipped_files import SHIPPED

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import ControlLaw
from loopwright.serving import Controller

pytest_plugins = ["operated_laws"]
ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples" / "embed" / "python"
# An example with one file after another, in a process that loads its libraries once: what it prints of each, and
# whether it brought our package.
MANY = """
import contextlib, io, json, runpy, sys
example, *files = sys.argv[1:]
said = {}
for file in files:
    sys.argv[:] = [example, file]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        try:
            runpy.run_path(example, run_name="__main__")
        except BaseException:
            print(file, file=sys.stderr)
            raise
    said[file] = out.getvalue()
print(json.dumps({"said": said, "ours": "loopwright" in sys.modules}))
"""


def run(example: str, file: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
    command = [sys.executable, "-W", "error", str(EXAMPLES / example), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["pid", "incadec"])
def test_both_examples_give_the_controllers_bits(make_law: object, name: str, tmp_path: Path) -> None:
    law: ControlLaw = make_law(name)  # type: ignore[operator]
    file = tmp_path / "law.onnx"
    export(law, file, case="thiosulfate_cstr", provenance={})
    ours, plain = run("python_runtime.py", file), run("plain_onnxruntime.py", file)
    assert ours == plain
    assert len(ours.splitlines()) == 100
    assert len(set(ours.splitlines())) > 10  # it does something
    controller = Controller(file)
    first = controller.step(sp=0.5, pv=[0.0, 200.0], mv_applied=0.0, state=controller.cold_state())
    assert ast.literal_eval(ours.partition("] ")[0] + "]") == first.mv.tolist()
    assert np.isfinite(first.mv).all()


def test_a_law_that_operators_steer_has_its_defaults_in_the_examples(operated_file: Path, tmp_path: Path) -> None:
    ours, plain = run("python_runtime.py", operated_file), run("plain_onnxruntime.py", operated_file)
    assert ours == plain
    assert len(set(ours.splitlines())) > 10
    words = [
        sys.executable,
        str(EXAMPLES / "conformance.py"),
        str(kit_of(operated_file)),
        str(tmp_path / "answers.json"),
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 0, done.stderr
    assert verdict_on(operated_file, tmp_path / "answers.json").identical


@pytest.fixture(scope="module")
def said() -> dict[str, dict[str, str]]:
    """What two examples print, by example and file: a process for each file would load the libraries 72 times."""
    found = {}
    for example in ("python_runtime.py", "plain_onnxruntime.py"):
        environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
        command = [sys.executable, "-W", "error", "-c", MANY, str(EXAMPLES / example), *map(str, SHIPPED)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
        assert done.returncode == 0, done.stderr
        answer = json.loads(done.stdout)
        assert answer["ours"] is (example == "python_runtime.py")
        found[example] = answer["said"]
    return found


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: f"{file.parent.name}-{file.stem}")
def test_every_shipped_controller_gives_the_same_bits_without_our_package(
    said: dict[str, dict[str, str]], file: Path
) -> None:
    ours = said["python_runtime.py"][str(file)]
    assert len(ours.splitlines()) == 100
    assert ours == said["plain_onnxruntime.py"][str(file)]


@pytest.mark.parametrize(("example", "lines"), [("python_runtime.py", 10), ("plain_onnxruntime.py", 20)])
def test_the_examples_are_as_short_as_promised(example: str, lines: int) -> None:
    text = (EXAMPLES / example).read_text()
    body = text.split('"""', 2)[2].splitlines()
    assert len([line for line in body if line.strip()]) <= lines


def test_the_plain_example_needs_nothing_of_ours() -> None:
    tree = ast.parse((EXAMPLES / "plain_onnxruntime.py").read_text())
    imported = {a.name.partition(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names}
    assert imported - set(sys.stdlib_module_names) == {"numpy", "onnxruntime"}
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(tree))


@pytest.mark.parametrize("example", ["python_runtime.py", "plain_onnxruntime.py", "control_loop.py"])
def test_an_example_without_a_file_says_what_it_wants(example: str) -> None:
    done = subprocess.run([sys.executable, str(EXAMPLES / example)], capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert done.stderr.startswith("usage: ")
    assert "FILE.onnx" in done.stderr


@pytest.mark.parametrize("damage", [None, *DAMAGES])
def test_python_s_conformance_run_passes_the_kit_and_no_damaged_one(damage: str | None, tmp_path: Path) -> None:
    file = next(f for f in SHIPPED if f.parent.name == "jacketed_batch_reactor")  # one of its MVs is discrete
    kit = kit_of(file) if damage is None else spoilt(file, tmp_path, DAMAGES[damage])
    command = [sys.executable, str(EXAMPLES / "conformance.py"), str(kit), str(tmp_path / "answers.json")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == (damage is not None), done.stderr
    verdict = verdict_on(file, tmp_path / "answers.json")
    if damage == "given":  # the state that it began from was another one
        assert verdict.one_step.same_bits == verdict.one_step.rows - 1
        assert verdict.chained.identical
    else:
        assert verdict.identical  # what it answers is right: it is the kit that is damaged


def test_python_s_conformance_run_refuses_an_old_kit(tmp_path: Path) -> None:
    kit = spoilt(SHIPPED[0], tmp_path, an_old_version)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
    command = [sys.executable, str(EXAMPLES / "conformance.py"), str(kit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 1
    assert done.stderr == f"{kit} has the version 3, not 6: write it again with loopwright conformance FILE.onnx KIT\n"


def test_the_example_loop_runs_once_a_period_and_begins_where_the_plant_is() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tools/roots")}
    file = ROOT / "artifacts" / "thiosulfate_cstr" / "pid.onnx"
    command = [sys.executable, "-W", "error", str(EXAMPLES / "control_loop.py"), str(file), "20", "0.05"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 0, done.stderr
    *rows, report = done.stdout.splitlines()
    assert rows
    assert "faults=0" in report
    assert all(row.split()[1] == "AUTO" for row in rows)
    controller = Controller(file)
    first = controller.step(sp=0.5, pv=[0.0, 200.0], mv_applied=250.0, state=controller.cold_state())
    assert float(rows[0].split()[2]) == first.mv[0]
