"""What ``make release`` builds: a wheel's content, a wheel beside the runtime's packages alone, bill and licences.

The environments in build/release are made here if ``make release`` has not made them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import zipfile
from base64 import b64decode
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from loopwright import serving

ROOT = Path(__file__).parents[2]
RELEASE, MADE = ROOT / "tools" / "release", ROOT / "build" / "release"
CONTROLLER = ROOT / "artifacts" / "thiosulfate_cstr" / "pid.onnx"
TOOLS = MADE / "tools" / "bin" / "python"
# As a person's shell has it: without the path of these tests.
BARE = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}


def run(*words: str | Path, fails: bool = False, **more: str) -> str:
    """What a command prints that ends well, or its errors where it must fail."""
    done = subprocess.run(
        [*map(str, words)], cwd=ROOT, env={**BARE, **more}, capture_output=True, text=True, timeout=300
    )
    assert bool(done.returncode) is fails, done.stderr
    return done.stderr if fails else done.stdout


@pytest.fixture(scope="module")
def tools() -> Path:
    run("bash", "tools/release/venvs.sh", "build/release", PYTHON=sys.executable)
    return TOOLS


@pytest.fixture(scope="module")
def dist(tools: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder ``one`` of two builds, which ran side by side."""
    base = tmp_path_factory.mktemp("dist")
    folders = [base / name for name in ("one", "two")]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda f: run("bash", "tools/release/build.sh", f, PYTHON=str(tools)), folders))
    return folders[0]


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (found,) = dist.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment that holds the wheel and the runtime's packages."""
    venv = tmp_path_factory.mktemp("runtime")
    run(sys.executable, "-m", "venv", "--without-pip", venv)
    (packages,) = (MADE / "bare").glob("lib/python3*/site-packages")
    (own,) = venv.glob("lib/python3*/site-packages")
    (own / "bare.pth").write_text(f"{packages}\n")
    python = venv / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "-qq", "--no-compile")
    run(*pip, "--disable-pip-version-check", "--no-index", "--no-deps", wheel)
    return python


def module(name: str) -> ModuleType:
    spec = spec_from_file_location(f"release_{name}", RELEASE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    made = module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def test_a_wheel_holds_the_modules_and_what_they_open(wheel: Path) -> None:
    content = module("content")
    with zipfile.ZipFile(wheel) as held:
        names = set(held.namelist())
        assert content.faults(names, content.sources()) == []
        assert content.named_cases(held) == []
    assert wheel.name == f"loopwright-{serving.__version__}-py3-none-any.whl"
    assert not [n for n in names if "bounds" in n and n.endswith(".json")]
    assert not [n for n in names if n.startswith("tests") or "/test_" in n]
    assert {
        "loopwright/serving/page/static/uPlot.iife.min.js",
        "loopwright/pipeline/report/templates/report.html.j2",
    } <= names


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda n: n | {"tests/test_x.py"}, "tests/test_x.py: does not belong"),
        (lambda n: n | {"loopwright/pipeline/cases/tank/bounds.json"}, "bounds.json: does not belong"),
        (lambda n: n | {"loopwright/serving/left_over.py"}, "loopwright/serving/left_over.py: does not belong"),
        (lambda n: n | {"loopwright/serving/page/static/secret.pem"}, "secret.pem: does not belong"),
        (lambda n: n - {"loopwright/serving/loop.py"}, "loopwright/serving/loop.py: not in the wheel"),
        (lambda n: n - {"loopwright/serving/py.typed"}, "loopwright/serving/py.typed: not in the wheel"),
    ],
)
def test_what_does_not_belong_or_is_lost_is_named(
    change: Callable[[set[str]], set[str]], says: str, wheel: Path
) -> None:
    content = module("content")
    with zipfile.ZipFile(wheel) as held:
        (line,) = content.faults(change(set(held.namelist())), content.sources())
    assert says in line


def test_a_runtime_that_names_a_case_is_found(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.whl", "w") as made:
        made.writestr("loopwright/serving/loop.py", "if case == 'thiosulfate_cstr': ...")
        made.writestr("loopwright/pipeline/laws/x.py", "thiosulfate_cstr")
    with zipfile.ZipFile(tmp_path / "x.whl") as held:
        assert module("content").named_cases(held) == ["loopwright/serving/loop.py: names a case"]


def test_the_source_archive_has_what_the_wheel_leaves_out(dist: Path) -> None:
    (archive,) = dist.glob("*.tar.gz")
    with tarfile.open(archive) as held:
        names = {name.partition("/")[2] for name in held.getnames()}
    assert {"CITATION.cff", "CHANGELOG.md", "constraints.txt", "pipeline/cases/bibliography.md"} <= names
    assert {p.relative_to(ROOT).as_posix() for p in (ROOT / "pipeline/cases").glob("*/bounds*.json")} <= names


def test_the_same_sources_give_the_same_wheel(wheel: Path, dist: Path) -> None:
    assert (dist.with_name("two") / wheel.name).read_bytes() == wheel.read_bytes()


def test_what_is_built_can_be_uploaded(dist: Path, tools: Path) -> None:
    assert run(tools, "-m", "twine", "--no-color", "check", "--strict", *dist.iterdir()).count("PASSED") == 2


def test_the_runtime_alone_steps_and_names_the_extra_of_every_other_command(installed: Path) -> None:
    assert "pid stepped; asks for numpy" in run(installed, RELEASE / "smoke.py", CONTROLLER)
    assert "No module named 'torch'" in run(installed, "-c", "import torch", fails=True)


def test_an_environment_with_more_than_the_runtime_is_refused(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "torch.py").touch()
    said = run(installed, RELEASE / "smoke.py", CONTROLLER, fails=True, PYTHONPATH=str(tmp_path))
    assert "not only the runtime is here: ['torch']" in said


@pytest.fixture(scope="module")
def closure() -> list[dict[str, object]]:
    found: list[dict[str, object]] = module("closure").closure()
    return found


@pytest.fixture(scope="module")
def environment(tools: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bill that cyclonedx-py makes of this very Python."""
    out = tmp_path_factory.mktemp("bill") / "environment.json"
    words = ("environment", "--no-validate", "--output-reproducible", "--short-PURLs", "-o", out, sys.executable)
    run(tools.with_name("cyclonedx-py"), *words)
    return out


def billed(closure: list[dict[str, object]], environment: Path, folder: Path, fails: bool = False) -> str:
    (folder / "closure.json").write_text(json.dumps(closure))
    return run(TOOLS, RELEASE / "bill.py", folder / "closure.json", environment, folder, fails=fails)


def test_every_extra_brings_what_it_asks_for(closure: list[dict[str, object]]) -> None:
    by = {row["name"]: row["by"] for row in closure}
    assert {name for name, extras in by.items() if "runtime" in extras} >= {"numpy", "onnxruntime"}
    assert "runtime" not in by["torch"]
    assert "pipeline" in by["torch"]
    assert by["asyncua"] == ["plant"]
    assert not {"pytest", "ruff", "moto"} & set(by)  # the developers' own


def test_every_package_has_a_licence_and_the_runtime_is_permissive(
    closure: list[dict[str, object]], environment: Path, tmp_path: Path, tools: Path
) -> None:
    """And the copyleft ones are those that docs/release.md names. Validating the whole bill takes 10 s: see below."""
    code = f"""import json, sys
sys.path.insert(0, {str(RELEASE)!r})
from bill import rows
print(json.dumps(rows(json.load(open({str(tmp_path / "all.json")!r})))))"""
    (tmp_path / "all.json").write_text(json.dumps(closure))
    rows = json.loads(run(tools, "-c", code))
    assert len(rows) == len(closure) > 100
    assert all(row["kind"] == 0 for row in rows if "runtime" in row["by"])
    copyleft = {row["name"]: row for row in rows if row["kind"] > 0}
    assert {"asyncua", "casadi"} <= set(copyleft)
    assert "torch" not in copyleft
    page = (ROOT / "docs" / "release.md").read_text().partition("## Copyleft")[2]
    told = {cells[1].strip("` "): cells for line in page.splitlines() if len(cells := line.split("|")) == 5}
    assert {name: (r["expression"], ", ".join(r["by"])) for name, r in copyleft.items()} == {
        name: (cells[2].strip(), cells[3].strip()) for name, cells in told.items() if name not in {"package", "---"}
    }


def test_the_bill_is_valid_and_holds_the_page_s_script(
    closure: list[dict[str, object]], environment: Path, tmp_path: Path
) -> None:
    few = [row for row in closure if "runtime" in row["by"] or row["name"] in {"asyncua", "casadi", "cmake"}]
    reviewed = ("fmpy", "grandalf", "huey", "pygit2", "python-dateutil", "skops")
    said = billed(few + [row for row in closure if row["name"] in reviewed], environment, tmp_path)
    assert "copyleft: " in said
    bill = json.loads((tmp_path / f"loopwright-{serving.__version__}.cdx.json").read_text())
    assert bill["metadata"]["component"]["version"] == serving.__version__
    held = {component["name"]: component for component in bill["components"]}
    assert held["uPlot"]["version"] in (ROOT / "serving/page/static/uPlot.iife.min.js").read_text()[:100]
    assert held["asyncua"]["licenses"] == [{"expression": "LGPL-3.0-or-later"}]
    edges = {edge["ref"]: edge.get("dependsOn", []) for edge in bill["dependencies"]}
    ours = edges[bill["metadata"]["component"]["bom-ref"]]
    assert {held[name]["bom-ref"] for name in ("uPlot", "onnxruntime_c_api.h")} <= set(ours)
    assert held["onnxruntime_c_api.h"]["licenses"] == [{"expression": "MIT"}]
    lock = json.loads((ROOT / "pipeline/playground/npm/package-lock.json").read_text())["packages"]
    page = (tmp_path / f"loopwright-{serving.__version__}-licences.md").read_text()
    by_purl = {component["purl"]: component for component in bill["components"]}
    for path, row in lock.items():
        if path:  # what npm fetches for the playground
            name = path.removeprefix("node_modules/")
            component = by_purl[f"pkg:npm/{name.replace('@', '%40')}@{row['version']}"]
            assert component["licenses"] == [{"expression": row["license"]}]
            assert bytes.fromhex(component["hashes"][0]["content"]) == b64decode(
                row["integrity"].removeprefix("sha512-")
            )
            assert f"| {name} | {row['version']} | {row['license']} | npm, for loopwright playground |" in page
    web = by_purl["pkg:npm/onnxruntime-web@1.30.0"]["bom-ref"]
    assert web in ours
    assert len(edges[web]) == len(lock["node_modules/onnxruntime-web"]["dependencies"])
    assert "file:" not in json.dumps(bill)
    assert str(Path.home()) not in json.dumps(bill)
    assert "| asyncua |" in (tmp_path / f"loopwright-{serving.__version__}-licences.md").read_text()


def test_an_unclear_licence_ends_the_release(
    closure: list[dict[str, object]], environment: Path, tmp_path: Path
) -> None:
    unclear = {
        "name": "new-one",
        "version": "1.0",
        "by": ["plant"],
        "expression": None,
        "classifiers": [],
        "licence": "",
    }
    # And a package that states its licence itself by now: its entry of reviewed.toml must go.
    others = [row | {"expression": "MIT"} if row["name"] == "huey" else row for row in closure]
    said = billed([*others, unclear], environment, tmp_path, fails=True)
    assert said.startswith("bill: huey ")
    assert "states MIT itself: drop it from reviewed.toml; new-one 1.0: its metadata leaves the licence open" in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == [tmp_path / "closure.json"]


def test_copyleft_is_told_from_the_rest(tools: Path) -> None:
    kinds = {
        "MIT": 0,
        "Apache-2.0 WITH LLVM-exception": 0,
        "BSD, clauses not stated": 0,
        "Apache-2.0 OR GPL-2.0-or-later": 0,
        "MPL-2.0 AND MIT": 1,
        "GPL-2.0-only OR EPL-1.0": 1,
        "GPL-2.0-only WITH GCC-exception-2.0": 1,
        "LGPL-3.0-or-later": 1,
        "MIT AND GPL-3.0-only": 2,
        "AGPL-3.0-only": 2,
        "BUSL-1.1": 3,
    }
    code = f"""import json, sys
sys.path.insert(0, {str(RELEASE)!r})
from licences import has_choice, kind
print(json.dumps([[kind(text), has_choice(text)] for text in {list(kinds)!r}]))"""
    found = dict(zip(kinds, json.loads(run(tools, "-c", code)), strict=True))
    assert {text: row[0] for text, row in found.items()} == kinds
    assert {text for text, row in found.items() if row[1]} == {text for text in kinds if " OR " in text}


def test_the_citation_follows_its_format_and_names_the_bibliography(tools: Path) -> None:
    run(tools, RELEASE / "citation.py")
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == serving.__version__
    table = (ROOT / "pipeline" / "cases" / "bibliography.md").read_text().splitlines()
    rows = [[cell.strip() for cell in line.split("|")] for line in table if line.startswith("| `")]
    known = {row[1].strip("`"): row[3].removesuffix(" (from the abstract)") for row in rows}
    assert {entry["notes"].partition(";")[0]: entry["title"] for entry in cited["references"]} == known
