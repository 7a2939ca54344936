"""A controller in plain C without an operating system: on a Cortex-M7 in qemu it gives the same bits."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from identified_models import random_model
from kits import EMBED, PID
from predictive_loops import law_of

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.export.gate import export

NEEDED = ("arm-none-eabi-gcc", "qemu-system-arm", "make")
if missing := [program for program in NEEDED if shutil.which(program) is None]:
    packages = "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm make"
    pytest.skip(f"{missing[0]} is not installed (Debian: apt install {packages})", allow_module_level=True)


def made(file: Path, folder: Path, target: str = "check", *more: str) -> subprocess.CompletedProcess[str]:
    """The Makefile of the example on a controller's plain C, which is written at the first call."""
    if not folder.exists():
        assert main(["c", str(file), str(folder), "--name", "law"]) == 0
    words = ["make", "-s", "-C", str(EMBED / "c" / "cortex_m7"), target, f"LAW={folder}", *more]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)


def test_a_pid_gives_the_same_bits_and_fits_into_a_few_kilobytes(tmp_path: Path) -> None:
    done = made(PID, tmp_path / "law")
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"3\d\d steps, 0 entries differ: the same bits\n[34]\d\d scans, 0 wrong", done.stdout)
    sizes = [line.split() for line in made(PID, tmp_path / "law", "size").stdout.splitlines() if line.endswith(".o")]
    assert sum(int(text) for text, *_ in sizes) < 6_000
    assert all(data == bss == "0" for _, data, bss, *_ in sizes)


def test_a_law_that_operators_steer_gives_the_same_bits(tmp_path: Path) -> None:
    law = law_of(random_model(5, n_y=2, n_mv=3, n_dv=1), horizon=10, operate={"y1.low": -0.5}, preview="course")
    export(law, tmp_path / "law.onnx", case="made", provenance={})
    done = made(tmp_path / "law.onnx", tmp_path / "law")
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_product_and_a_sum_that_are_rounded_once_together_are_found(tmp_path: Path) -> None:
    """This processor can; the self-test says so, and the exit status of the program in qemu."""
    law = law_of(random_model(5), horizon=10)
    export(law, tmp_path / "law.onnx", case="made", provenance={})
    flags = "-mcpu=cortex-m7 -mthumb -mfpu=fpv5-d16 -mfloat-abi=hard -O2 -ffp-contract=fast"
    done = made(tmp_path / "law.onnx", tmp_path / "law", "check", f"CFLAGS={flags}")
    assert done.returncode != 0
    assert "other bits" in done.stdout
