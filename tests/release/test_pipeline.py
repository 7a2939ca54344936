"""The real pipeline under the real DVC, on a copy of the repository with small numbers."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from processes import within

from loopwright.pipeline.engine.cluster import STAGES
from loopwright.pipeline.engine.dvc import COMMAND, PYTHON

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from reduced import reduced

ROOT = Path(__file__).parents[2]
CASE = "thiosulfate_cstr"
PID = f"{CASE}-pid"
# All but the reports and the registry, which follow whatever comes out and take as long as all others.
LAWS = (f"validate@{CASE}-inc", f"validate@{PID}")
ENVIRONMENT = {
    **os.environ,
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    "DVC_NO_ANALYTICS": "1",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "PYTHONPATH": str(ROOT / "tools/roots"),
    "LOOPWRIGHT_WORKERS": "1",  # each loads its libraries for seconds, and these stages are small
    STAGES: "excite,fit,design,validate",
}
# Runs DVC with one list of arguments after another, each in a process of its own that begins with DVC loaded: loading
# takes as long as most of what it does. Another program than DVC is run as it is.
WARM = """
import json, os, subprocess, sys
import dvc.cli, dvc.cli.parser, dvc.commands.repro, dvc.commands.status, dvc.repo.reproduce, dvc.repo.status
for line in sys.stdin:
    program, *arguments = json.loads(line)
    child = os.fork() if program == "dvc" else None
    if child == 0:
        os.dup2(1, 2)
        code = dvc.cli.main(arguments)
        sys.stdout.flush()
        os._exit(code)
    if child is None:
        code = subprocess.run([program, *arguments], stderr=subprocess.STDOUT).returncode
    else:
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print("ended with", code, flush=True)
"""


class Copy:
    """A copy of the repository in which DVC runs, in a shell (see WARM) whose stages share one cluster."""

    def __init__(self, path: Path, shell: subprocess.Popen[str]) -> None:
        self.path, self.shell = path, shell

    def run(self, *command: str) -> str:
        found = subprocess.run(
            command, cwd=self.path, env=ENVIRONMENT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert found.returncode == 0, found.stdout
        return found.stdout

    def warm(self, *command: str) -> tuple[str, int]:
        """Run a command in the shell; what it printed and its exit status."""
        assert self.shell.stdin is not None
        assert self.shell.stdout is not None
        self.shell.stdin.write(f"{json.dumps(command)}\n")
        self.shell.stdin.flush()
        said = ""
        while not (end := re.search(r"^ended with (\d+)$", said, re.MULTILINE)):
            line = self.shell.stdout.readline()
            assert line, f"the shell ended: {said}"
            said += line
        return said[: end.start()], int(end[1])

    def dvc(self, *arguments: str) -> str:
        said, code = self.warm("dvc", *arguments)
        assert code == 0, said
        return said

    def repro(self, *targets: str) -> set[str]:
        """Run the pipeline, or what some stages need; the stages that ran, by name."""
        return set(re.findall(r"Running stage '([^']+)'", self.dvc("repro", *targets)))

    def edit(self, keys: Sequence[str], value: object) -> None:
        path = self.path / "params.yaml"
        tree = yaml.safe_load(path.read_text())
        at = tree
        for key in keys[:-1]:
            at = at[key]
        at[keys[-1]] = value
        path.write_text(yaml.safe_dump(tree, sort_keys=False))


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Copy]:
    """The pipeline run once: one record, two model sets, two controllers, one data seed."""
    path = tmp_path_factory.mktemp("repository")
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in listed.stdout.splitlines():
        if (ROOT / name).is_file() and not name.startswith("artifacts/") and name != "dvc.lock":
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, path / name)
    for package in ("pipeline", "serving"):
        # What Python and numba have compiled, which takes them seconds.
        for compiled in (ROOT / package).rglob("__pycache__"):
            shutil.copytree(compiled, path / compiled.relative_to(ROOT))
    tree = reduced(yaml.safe_load((path / "params.yaml").read_text()))
    keep = {
        "records": ["random_steps"],
        "models": ["inverse", "linearized"],
        "controllers": ["inc", "pid"],
    }
    tree["cases"] = {CASE: tree["cases"][CASE]}
    for section, names in keep.items():
        tree[section] = {f"{CASE}-{name}": tree[section][f"{CASE}-{name}"] for name in names}
    tree["records"][f"{CASE}-random_steps"]["seeds"] = [0]
    tree["controllers"][PID] |= {"tuning": "imc", "lambda_s": 1.5}
    tree["cases"][CASE]["held_out_seeds"] = tree["cases"][CASE]["held_out_seeds"][:1]
    (path / "params.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))
    subprocess.run(["git", "init", "--quiet"], cwd=path, check=True)
    warm = [sys.executable, "-m", "loopwright.pipeline.engine.with_cluster", *PYTHON, "-c", WARM]
    with subprocess.Popen(
        warm, cwd=path, env=ENVIRONMENT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as shell:
        repository = Copy(path, shell)
        stages = repository.repro()
        kinds = {"code", "excite", "fit", "design", "validate", "report", "overview", "publish"}
        assert {s.split("@")[0] for s in stages} == kinds
        yield repository
        assert shell.stdin is not None
        shell.stdin.close()


def test_every_output_is_there(copy: Copy) -> None:
    artifacts = copy.path / "artifacts" / CASE
    for name in ("inc.onnx", "inc.json", "pid.onnx", "pid.json", "validation.json", "report.html", "report.md"):
        assert (artifacts / name).is_file(), name
    assert (copy.path / "published.json").is_file()
    for name in ("report.html", "report.md"):
        assert PID in (copy.path / "artifacts" / name).read_text(), name
    assert "inc" in copy.run("python", "-m", "loopwright.pipeline", "results")
    assert "held_out / NMPC" in copy.run("python", "-m", "loopwright.pipeline", "results", CASE)


def test_a_second_run_does_nothing(copy: Copy) -> None:
    assert copy.repro() == set()
    assert "up to date" in copy.dvc("status")


def test_another_number_reruns_its_own_design_and_validation_only(copy: Copy) -> None:
    copy.edit(("controllers", PID, "lambda_s"), 2.0)
    assert copy.repro(*LAWS) == {"code", f"design@{PID}", f"validate@{PID}"}
    # Back again: DVC's cache has it, nothing is computed twice.
    copy.edit(("controllers", PID, "lambda_s"), 1.5)
    assert not {s for s in copy.repro(f"validate@{PID}") if s.startswith(("excite", "fit", "design"))}


def test_a_run_killed_in_the_middle_loses_nothing(copy: Copy) -> None:
    before = (copy.path / "artifacts" / CASE / "inc.onnx").read_bytes()
    copy.edit(("models", f"{CASE}-linearized", "parts", "linearized", "at"), 0.6)
    process = subprocess.Popen(
        [*COMMAND, "repro"],
        cwd=copy.path,
        env={**ENVIRONMENT, "PYTHONUNBUFFERED": "1"},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if "Running stage 'fit@" in line:
            os.killpg(process.pid, signal.SIGKILL)
            break
    process.stdout.close()
    process.wait()
    ran = copy.repro(*LAWS)
    assert {f"fit@{CASE}-linearized", f"design@{PID}"} <= ran
    assert not {s for s in ran if s.startswith("excite") or s.endswith(("-inverse", "-inc"))}
    assert "up to date" in copy.dvc("status", "--with-deps", *LAWS)
    assert (copy.path / "artifacts" / CASE / "inc.onnx").read_bytes() == before


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("whole_group", [True, False])  # Ctrl-C in a terminal; kill -INT
def test_ctrl_c_leaves_one_line_and_no_process_and_a_run_goes_on(copy: Copy, whole_group: bool) -> None:
    """Started by its full path, where ``python`` is none that has the packages.

    The second run begins with the stage that the first one could not finish.
    """
    copy.edit(("controllers", PID, "lambda_s"), 3.0)
    mark = f"{os.getpid()}-{whole_group}"
    bare = {**ENVIRONMENT, "PATH": "/usr/bin:/bin", "MARK": mark}
    command, pipe = [sys.executable, "-m", "loopwright.pipeline", "run", PID], subprocess.PIPE
    process = subprocess.Popen(
        command, cwd=copy.path, env=bare, text=True, stdout=pipe, stderr=subprocess.STDOUT, start_new_session=True
    )
    assert process.stdout is not None
    said = []
    for line in process.stdout:
        said.append(line)
        if line.startswith("stage 1 of 2: design"):
            (os.killpg if whole_group else os.kill)(process.pid, signal.SIGINT)
    assert process.wait() == 130, said
    process.stdout.close()
    assert said[-1] == f"stopped; finished stages are kept, `loopwright run {PID}` goes on from there\n", said
    assert said[-2].startswith("stage 1 of 2: design"), said
    assert within(10, lambda: not _marked(f"MARK={mark}".encode()))
    if not whole_group:
        assert copy.repro(f"validate@{PID}") == {f"design@{PID}", f"validate@{PID}"}


def _marked(variable: bytes) -> list[str]:
    """Processes that have a variable in their environment."""
    marked = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if variable in path.read_bytes().split(b"\0"):
                marked.append(path.parent.name)
    return marked


def test_a_mistake_in_the_parameters_is_one_line(copy: Copy) -> None:
    copy.edit(("controllers", PID, "narowing"), 2.0)
    said, code = copy.warm("python", "-m", "loopwright.pipeline.engine.start", "design", PID)
    assert code == 2
    assert said.count("\n") == 1
    assert f"controllers.{PID}: unknown key 'narowing'" in said
    assert "Traceback" not in said
