"""A controller in plain C: compiled without a warning, the same bits, the same loop; a wrong number is found."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from identified_models import random_model
from kits import CASES, name
from predictive_loops import law_of

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.export.gate import export

if shutil.which("gcc") is None or shutil.which("make") is None:
    pytest.skip("no C compiler is installed (Debian: apt install gcc make)", allow_module_level=True)

WARNINGS = "-Wall -Wextra -Wconversion -Wshadow -Wdouble-promotion -Werror"
FILES = [min(case.glob("*.onnx")) for case in CASES]


def checked(folder: Path, flags: str = "-std=c99 -O1") -> subprocess.CompletedProcess[str]:
    """The self-test, compiled with every warning an error."""
    command = ["make", "-C", str(folder), "check", f"CFLAGS={flags} {WARNINGS}"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def written(file: Path, folder: Path) -> Path:
    assert main(["c", str(file), str(folder)]) == 0
    return folder


@pytest.mark.parametrize("file", FILES, ids=name)
def test_steps_have_the_same_bits_and_scans_go_as_the_kit_says(file: Path, tmp_path: Path) -> None:
    done = checked(written(file, tmp_path / "c"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"3\d\d steps, 0 entries differ", done.stdout)
    assert re.search(r"[34]\d\d scans, 0 wrong", done.stdout)


def test_a_law_that_operators_steer(tmp_path: Path) -> None:
    model = random_model(5, n_y=2, n_mv=3, n_dv=1)
    law = law_of(model, horizon=15, operate={"y1.low": -0.5}, preview="course")
    export(law, tmp_path / "law.onnx", case="made", provenance={})
    folder = written(tmp_path / "law.onnx", tmp_path / "c")
    for flags in ("-std=c99 -O0", "-std=c99 -O2"):
        done = checked(folder, flags)
        assert done.returncode == 0, done.stdout + done.stderr
        subprocess.run(["make", "-C", str(folder), "clean"], check=True, capture_output=True)


def test_a_wrong_constant_is_found(tmp_path: Path) -> None:
    folder = written(FILES[0], tmp_path / "c")
    source = next(f for f in folder.glob("*.c") if "_" in f.stem and not f.stem.endswith(("_guard", "_selftest")))
    text, count = re.subn(
        r"(static const double c\d+\[\d+\] = \{\n +)(-?[\d.e-]+)",
        lambda found: found[1] + repr(float(found[2]) + 1e-3),
        source.read_text(),
    )
    assert count > 0
    source.write_text(text)
    done = checked(folder)
    assert done.returncode != 0
    assert "instead of" in done.stdout


@pytest.mark.parametrize(("words", "says"), [([], "is there already"), (["--name", "2x"], "no name")])
def test_what_cannot_be_written_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    out = tmp_path / ("there" if not words else "new")
    if not words:
        out.mkdir()
    assert main(["c", str(FILES[0]), str(out), *words]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1
    assert not words or not out.exists()
