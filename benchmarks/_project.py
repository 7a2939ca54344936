"""A fresh project folder with the sources of the product, as a user has it, and commands that run in it."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROJECT = ("dvc.yaml", ".dvcignore", ".gitignore", ".dvc/config", ".dvc/.gitignore")
SOURCES = ("pipeline", "serving")


def fresh_project(folder: Path) -> None:
    """A project of nothing but the product's sources; FileExistsError where the folder is one already."""
    (folder / ".dvc").mkdir(parents=True)
    for package in SOURCES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "tools" / "roots", folder / "tools" / "roots", symlinks=True)
    for name in PROJECT:
        shutil.copy(ROOT / name, folder / name)
    subprocess.run(["git", "init", "--quiet"], check=True, cwd=folder)
    (folder / "params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")


def run_module(folder: Path, module: str, *words: str) -> tuple[int, list[str]]:
    """Exit status of a module of the product, run in a project, and the lines that it printed, behind the command."""
    own = {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(folder / "tools/roots"),
    }
    done = subprocess.run(
        [sys.executable, "-m", module, *words],
        cwd=folder, env={**os.environ, **own}, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    return done.returncode, [f"$ python -m {module} {' '.join(words)}", *done.stdout.splitlines()]


@dataclass(frozen=True, slots=True)
class UsersRun:
    """What `loopwright new` and `loopwright run` said and shipped, and their processor time [s].

    ``files`` are the controllers' files by name; ``added`` says whether `new` took the record, ``ended`` whether `run`
    came to its end.
    """

    said: list[str]
    files: dict[str, Path]
    seconds: float
    added: bool
    ended: bool


def new_and_run(project: Path, name: str, files: Sequence[Path], options: Sequence[str]) -> UsersRun:
    """A plant of this name from a record in a fresh project, in place of what its folder had.

    ``files`` go into it; the first one is the record.
    """
    shutil.rmtree(project, ignore_errors=True)
    fresh_project(project)
    for file in files:
        shutil.copy(file, project / file.name)
    began = resource.getrusage(resource.RUSAGE_CHILDREN)
    code, said = run_module(project, "loopwright.pipeline", "new", name, files[0].name, *options)
    added = code == 0
    if added:
        code, more = run_module(project, "loopwright.pipeline", "run", name)
        said += more
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - began.ru_utime - began.ru_stime
    for package in SOURCES:  # runs of many states of the sources are kept side by side
        shutil.rmtree(project / package)
    (project / "said.txt").write_text("\n".join(said), encoding="utf-8")
    shipped = {path.stem: path for path in sorted((project / "artifacts" / name).glob("*.onnx"))}
    return UsersRun(said, shipped, seconds, added, added and code == 0)


def withheld(project: Path, name: str) -> list[str]:
    """Why a controller of a finished run is not shipped, a line each."""
    why = []
    for path in sorted((project / "work" / name / "controllers").glob("*/metrics.json")):
        text = json.loads(path.read_text()).get("withheld")
        why += [f"{path.parent.name}: {text}"] if text else []
    return why
