"""examples/embed/c: a program around a controller in plain C, built as its page says, with sanitizers."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from identified_models import random_model
from kits import EMBED, PID, scans_of_a_loop
from predictive_loops import law_of

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.export.gate import export
from loopwright.serving import Controller

if shutil.which("gcc") is None:
    pytest.skip("no C compiler is installed (Debian: apt install gcc)", allow_module_level=True)

SANITIZED = "-std=c11 -O1 -g -Wall -Wextra -Wpedantic -Wconversion -Werror -fsanitize=address,undefined"


def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=120, check=False)


def built(file: Path, folder: Path, source: Path = EMBED / "c" / "main.c") -> Path:
    """The example around one controller."""
    law, program = folder / "law", folder / "main"
    assert main(["c", str(file), str(law), "--name", "law"]) == 0
    parts = [source, law / "law.c", law / "law_guard.c"]
    words = ["gcc", *SANITIZED.split(), "-fno-sanitize-recover=all", "-ffp-contract=off", f"-I{law}"]
    made = subprocess.run(
        [*words, *map(str, parts), "-lm", "-o", str(program)], capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr
    return program


def test_the_example_closes_a_loop_once_a_period(tmp_path: Path) -> None:
    program = built(PID, tmp_path)
    rows = scans_of_a_loop(lambda _file, *words: run(program, *words))
    (mv,) = Controller(PID).manifest.mv
    moved = [float(row[5]) for row in rows]
    assert all(mv.low <= value <= mv.high for value in moved)
    assert len(set(moved)) > 1


def test_the_example_takes_a_law_with_disturbances_and_operators(tmp_path: Path) -> None:
    model = random_model(5, n_y=2, n_mv=3, n_dv=1)
    export(law_of(model, horizon=15, operate={}), tmp_path / "law.onnx", case="made", provenance={})
    done = run(built(tmp_path / "law.onnx", tmp_path), "30", "0.02")
    assert done.returncode == 0, done.stderr
    signals = Controller(tmp_path / "law.onnx").manifest.mv
    assert done.stdout
    for row in (line.split() for line in done.stdout.splitlines()):
        assert all(s.low <= float(v) <= s.high for s, v in zip(signals, row[5:], strict=True))


def test_the_example_writes_nothing_before_it_has_read_the_plant(tmp_path: Path) -> None:
    """The example as it is shipped, on a plant that cannot be read at the first two scans and tells of each write."""
    text = (EMBED / "c" / "main.c").read_text()
    for place, more in (
        ("static int read_plant(law_sample *s) {\n", "  static int reads;\n  if (reads++ < 2) return 0;\n"),
        ("static int write_plant(const double *wanted) {\n", '  printf("written %g\\n", wanted[0]);\n'),
    ):
        assert text.count(place) == 1
        text = text.replace(place, place + more)
    (tmp_path / "changed.c").write_text(text)
    first, second, third, *_ = run(built(PID, tmp_path, tmp_path / "changed.c"), "60", "0.02").stdout.splitlines()
    assert first.endswith("HOLD fault 1 at 0")
    assert second.endswith("HOLD fault 1 at 0")
    assert third == "written 250"  # the read-back: where the made-up plant's actuator stands
