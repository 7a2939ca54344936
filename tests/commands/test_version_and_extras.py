"""One version everywhere, and one line with the extra that brings what a command lacks."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import grimp
import pytest

from loopwright import serving
from loopwright.pipeline.__main__ import main
from loopwright.pipeline.commands import extras
from loopwright.pipeline.commands.extras import advice, extra_of
from loopwright.pipeline.stages import check
from loopwright.pipeline.stages.code import PACKAGES

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_version_is_the_same_everywhere(capsys: pytest.CaptureFixture[str]) -> None:
    """The installed one goes into every controller's provenance; ``make setup`` installs anew where it changed."""
    assert PROJECT["dynamic"] == ["version"]
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"loopwright {serving.__version__}\n"
    assert version("loopwright") == serving.__version__
    assert re.search(rf"^## {re.escape(serving.__version__)}\b", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def test_every_package_that_the_sources_import_is_asked_for_by_an_extra() -> None:
    graph = grimp.build_graph(*PACKAGES, include_external_packages=True, cache_dir=None)
    imported = {m for m in graph.modules if graph.is_module_squashed(m)} - sys.stdlib_module_names
    base = {re.split(r"[<>=]", line)[0] for line in PROJECT["dependencies"]}
    brought = {module: extra_of(module) for module in imported - base}
    assert {"torch", "asyncua", "sklearn"} <= set(brought)
    # asyncua brings cryptography
    assert {module for module, extra in brought.items() if extra is None} <= {"cryptography"}
    assert {extra_of(m) for m in ("torch", "sklearn", "yaml", "mlflow.onnx")} == {"pipeline"}
    assert {extra_of(m) for m in ("asyncua", "starlette", "uvicorn")} == {"plant"}
    assert extra_of("fmpy") == "fmu"
    assert extra_of("pytest") is None  # the developers' own


def test_what_takes_half_a_second_to_load_is_loaded_where_it_is_used() -> None:
    """Every stage and command begins a process of its own, and few of them filter."""
    slow, at_once = re.compile(r"^(?:from|import) scipy\.(signal|ndimage|stats)\b", re.MULTILINE), {}
    for path in (ROOT / "pipeline").rglob("*.py"):
        if found := slow.findall(path.read_text()):
            at_once[path.name] = found
    assert at_once == {}


@pytest.mark.parametrize(
    ("words", "blocked", "extra"),
    [("simulate x.onnx", "casadi", "pipeline"), ("loop check", "asyncua", "plant"), ("laws", "torch", "pipeline")],
)
def test_a_command_without_its_packages_names_the_extra_in_one_line(words: str, blocked: str, extra: str) -> None:
    code = f"""import sys
sys.modules[{blocked!r}] = None
from loopwright.pipeline.__main__ import main
sys.exit(main({words.split()!r}))"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    name = words.split()[0]
    assert done.returncode == 2
    how = f"pip install -e '{ROOT}[{extra}]'"  # an index may hold another release than the clone does
    assert done.stderr == f"loopwright {name}: {blocked} is not installed; {how} brings it\n"


def test_a_wheel_is_completed_from_an_index(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "distributions", lambda **_: [])
    assert advice("asyncua") == "asyncua is not installed; pip install 'loopwright[plant]' brings it"


def test_a_missing_module_of_our_own_is_a_fault_and_stays_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "loopwright.pipeline.commands.laws", None)
    with pytest.raises(ModuleNotFoundError, match=r"pipeline\.commands\.laws"):
        main(["laws"])
    assert advice("loopwright.pipeline.commands.laws") is None


def test_check_says_once_that_a_wheel_holds_no_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """And does not ask for what would be computed into site-packages."""
    monkeypatch.chdir(ROOT)
    wheel = Path("/venv/lib/python3.11/site-packages/pipeline/cases")
    monkeypatch.setattr(check, "bounds_path", lambda case: wheel / case.name / "bounds.json")
    said = [line for line in check.notes() if "bounds" in line]
    assert said == [check.FROM_A_WHEEL]
    monkeypatch.setattr(check, "bounds_path", lambda case: ROOT / "pipeline/cases" / case.name / "none.json")
    assert any("run `loopwright bounds" in line for line in check.notes())


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("loopwright.serving.station.command", {"starlette", "torch"}),  # the page is a process of its own
        ("loopwright.pipeline.stages.validate", {"torch"}),
        ("loopwright.pipeline.engine.start", {"numpy", "torch"}),
    ],
)
def test_who_starts_often_loads_nothing_heavy(module: str, heavy: set[str]) -> None:
    """Nor what an extra brings that the command can do without."""
    code = f"import sys, {module}; print(sorted({heavy} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert found.stdout.strip() == "[]"
