"""The notebooks run, and what is stored of them is small, has pictures and tells nothing of a machine."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
LARGEST_KB, LARGEST = 200, 200_000
WITHIN_S = 600  # a minute of processor time, on a machine that does other things
FOLDERS = re.compile(
    r"""(?<![\w./<])/(?:home|root|Users|tmp|var|work|opt|usr|mnt|private|srv)/[.\w]|\b[A-Za-z]:\\{1,2}\w|file://"""
)

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("nbclient") is None or importlib.util.find_spec("ipykernel") is None,
    reason="nbclient and ipykernel are not installed; `make docs` brings them",
)
each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def outputs(path: Path) -> list[dict]:
    """All outputs of a notebook's cells."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [output for cell in cells for output in cell.get("outputs", [])]


def source(path: Path) -> list[str]:
    """The texts of a notebook's cells."""
    return ["".join(cell["source"]) for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]]


def test_there_are_seven() -> None:
    assert len(NOTEBOOKS) == 7


@each
def test_a_notebook_runs(path: Path, tmp_path: Path) -> None:
    """A copy, beside copies of what it reads: it writes nothing into the checkout."""
    for name in ("own_plant", "operated_plant"):
        shutil.copytree(ROOT / "examples" / name, tmp_path / name)
    (tmp_path / "notebooks").mkdir()
    copy = Path(shutil.copy(path, tmp_path / "notebooks"))
    tool = [sys.executable, str(ROOT / "tools" / "run_notebooks.py"), str(copy)]
    done = subprocess.run(tool, cwd=tmp_path, capture_output=True, text=True, timeout=WITHIN_S)
    assert done.returncode == 0, done.stderr[-4000:]
    assert "Warning" not in done.stderr
    assert source(copy) == source(path)
    assert [o["output_type"] for o in outputs(copy)] == [o["output_type"] for o in outputs(path)]
    assert [p.name for p in (tmp_path / "notebooks").iterdir()] == [path.name]


@each
def test_what_is_stored_has_a_picture_and_no_error(path: Path) -> None:
    stored = outputs(path)
    assert any("image/png" in o.get("data", {}) for o in stored)
    assert [o["ename"] for o in stored if o["output_type"] == "error"] == []
    assert [o["text"] for o in stored if o.get("name") == "stderr"] == []
    assert path.stat().st_size <= LARGEST, f"{path.name} is larger than {LARGEST_KB} kB: fewer or smaller pictures"


@each
def test_what_is_stored_tells_nothing_of_a_machine(path: Path) -> None:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    texts = [json.dumps({k: v for k, v in o.get("data", o).items() if k != "image/png"}) for o in outputs(path)]
    assert [found[0] for text in texts if (found := FOLDERS.search(text))] == []
    assert notebook["metadata"]["language_info"] == {"name": "python"}
    assert [cell["metadata"] for cell in notebook["cells"] if cell["metadata"]] == []


def test_a_path_of_a_machine_is_seen() -> None:
    for text in ("/home/anna/loop.csv", "in /tmp/tmpab12/export.csv", r"C:\\Users\\anna", '"/root/.cache"'):
        assert FOLDERS.search(text), text
    for text in ("[°C/(m3/h)]", "%/degC", "</td>", "its own/tmp", "../own_plant/make_export.py"):
        assert not FOLDERS.search(text), text
