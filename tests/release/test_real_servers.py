"""docs/cluster.md with real servers: a case through a cluster, PostgreSQL, S3 and MLflow, then a second clone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
from servers import ROOT, Servers, servers

CASE = "thiosulfate_cstr"
KEPT = {f"{CASE}-{name}" for name in ("operating_point", "linearized", "pid")}
OFF = {"DVC_NO_ANALYTICS": "1", "MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "1", "PYTHONUNBUFFERED": "1"}
# `loopwright` with one line of arguments after another, in a process that loads MLflow once.
PROMPT = """
import sys
from loopwright.pipeline.__main__ import main
for line in sys.stdin:
    print("ended with", main(line.split()), file=sys.stderr, flush=True)
"""
GIT = ("git", "-c", "user.name=test", "-c", "user.email=test@localhost", "-c", "commit.gpgsign=false")


class Person:
    """One who works in a clone, with the variables that point to the servers."""

    def __init__(self, clone: Path, variables: dict[str, str]) -> None:
        self.clone, self.variables = clone, variables

    @property
    def environment(self) -> dict[str, str]:
        own = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        without = {k: v for k, v in os.environ.items() if not k.startswith(("AWS_", "MLFLOW_", "DASK_"))}
        return {**without, **OFF, **self.variables, "PATH": own, "PYTHONPATH": str(self.clone / "tools/roots")}

    def asks(self, *command: object) -> subprocess.CompletedProcess[str]:
        words = [str(word) for word in command]
        return subprocess.run(words, cwd=self.clone, env=self.environment, capture_output=True, text=True, timeout=900)

    def does(self, *command: object) -> str:
        done = self.asks(*command)
        assert done.returncode == 0, f"{command}: {done.stdout[-3000:]}{done.stderr[-3000:]}"
        return done.stdout + done.stderr

    def loopwright(self, *words: object) -> str:
        return self.does(sys.executable, "-m", "loopwright.pipeline", *words)

    def dvc(self, *words: object) -> str:
        return self.does(sys.executable, "-m", "dvc", *words)

    def mistake(self, module: str, *words: object) -> str:
        """What ``python -m MODULE`` says, in one line, where it cannot."""
        done = self.asks(sys.executable, "-m", module, *words)
        assert done.returncode in (1, 2), done.stdout + done.stderr
        (line,) = done.stderr.splitlines()
        return line

    @contextmanager
    def prompt(self) -> Iterator[Callable[[str], str]]:
        """A function: what `loopwright` says, in one line, of arguments with which it cannot."""
        command, pipe = [sys.executable, "-c", PROMPT], subprocess.PIPE
        with subprocess.Popen(
            command, cwd=self.clone, env=self.environment, text=True, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe
        ) as process:
            assert process.stdin is not None
            assert process.stderr is not None
            asked, said = process.stdin, process.stderr

            def mistake(words: str) -> str:
                asked.write(f"{words}\n")
                asked.flush()
                line, end = said.readline(), said.readline()
                assert end == "ended with 2\n", line + end
                return line

            yield mistake
            asked.close()
            assert said.read() == ""


def small_copy(folder: Path) -> None:
    """The sources as they stand here, and one case of the reduced copy: a record, a model, a controller."""
    listed = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    found = subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in found.split("\0"):
        away = name.startswith(("artifacts/", "tests/")) or name in ("", "dvc.lock")
        if not away and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    params = folder / "params.yaml"
    subprocess.run([sys.executable, ROOT / "tools/reduced.py", params], check=True)
    tree = yaml.safe_load(params.read_text())
    tree["cases"] = {CASE: tree["cases"][CASE]}
    for kind in ("records", "models", "controllers"):
        tree[kind] = {name: entry for name, entry in tree[kind].items() if name in KEPT}
    params.write_text(yaml.safe_dump(tree, sort_keys=False))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def around() -> Iterator[tuple[Servers, dict[str, str]]]:
    with servers() as made:
        yield made


def test_a_run_on_real_servers_reaches_a_second_clone(around: tuple[Servers, dict[str, str]], tmp_path: Path) -> None:
    running, variables = around
    first = Person(tmp_path / "first", variables)
    first.clone.mkdir()
    small_copy(first.clone)
    first.does(*GIT, "init", "--quiet")
    first.dvc("remote", "add", "--default", "cluster", "s3://dvc/cache")
    said = first.loopwright("run")
    assert f"champion: {CASE}-pid" in said
    assert "the work at a glance" not in said  # which a cluster of this machine would say
    first.dvc("push")
    first.does(*GIT, "add", "--all")
    first.does(*GIT, "commit", "--quiet", "--message", "a run")
    # Nothing was kept on this side: the database and the artifacts are the servers'.
    assert not any((first.clone / name).exists() for name in ("mlflow.db", "mlruns", "mlartifacts"))

    here = {name: value for name, value in variables.items() if name != "DASK_SCHEDULER_ADDRESS"}
    second = Person(tmp_path / "second", here)
    first.does("git", "clone", "--quiet", first.clone, second.clone)
    second.loopwright("registry", "fetch", CASE, "deploy")
    fetched = contents(second.clone / "deploy")
    assert fetched == {
        name: (first.clone / f"artifacts/{CASE}/{name}").read_bytes() for name in ("pid.onnx", "pid.json")
    }
    second.dvc("pull")
    made = contents(first.clone / "work")
    assert f"{CASE}/controllers/pid/base/seed0.onnx" in str(sorted(made))
    assert contents(second.clone / "work") == made

    # The servers go away one by one: each time one line says which, and nothing is left half-written.
    with second.prompt() as mistake:
        for gone, words in (
            ("s3", "the store of files behind the server"),
            ("postgres", "was answered by error 503; is its server running, and the database behind it?"),
            ("mlflow", "is its server running"),
        ):
            running.stop(gone)
            line = mistake(f"registry fetch {CASE} again")
            assert words in line, line
            assert not (second.clone / "again").exists()
    running.stop("scheduler")
    line = first.mistake("loopwright.pipeline.engine.start", "design", f"{CASE}-pid")
    assert variables["DASK_SCHEDULER_ADDRESS"] in line
