"""The guard in C and the runtime's loop command the same over random histories."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
from random_scans import random_rows

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.export.plain_code.c_files import c_folder
from loopwright.pipeline.export.plain_code.lowering import lowered
from loopwright.pipeline.export.plain_code.self_test import KitInC, kit_in_c, printed_self_test
from loopwright.serving import Controller, Signal

if shutil.which("gcc") is None:
    pytest.skip("no C compiler is installed (Debian: apt install gcc)", allow_module_level=True)

pytest_plugins = ["small_laws"]
U, V = Signal("u", "%", 0.0, 100.0), Signal("v", "%", -5.0, 5.0)
SLOW_U, SLOW_V = replace(U, max_move=4.0), replace(V, max_move=0.9)
HISTORIES, SCANS = 8, 400


def _both(law: Any, sp: Any, pv: Any, dv: Any, mv_applied: Any, state: Any) -> Any:
    """PI on the first MV, an integrator on the second; no MV moves by more than 0.9."""
    error = sp - pv[..., :1]
    last = torch.where(state[..., :1] > 0, state[..., 1:], error)
    most = torch.tensor(0.9)
    move = torch.cat([7.1 * (error - last) + 1.3 * error, 0.2 - 3.0 * error], dim=-1)
    mv = torch.minimum(torch.maximum(mv_applied + torch.clamp(move, -most, most), law.low), law.high)
    return mv, torch.cat([torch.ones_like(error), error], dim=-1), error


@pytest.mark.parametrize(
    "mv", [(U, V), (SLOW_U, SLOW_V), (U, SLOW_V), (SLOW_U, V)], ids=["free", "rated", "second rated", "first rated"]
)
def test_random_histories(mv: tuple[Signal, ...], make_formula: Any, pi_law: Any, tmp_path: Path) -> None:
    path = tmp_path / "law.onnx"
    export(make_formula(_both, 2, ("error",), replace(pi_law.signals, mv=mv)), path, case="tank", provenance={})
    controller = Controller(path)
    folder, program = tmp_path / "c", lowered(onnx.load(path))
    folder.mkdir()
    for name, text in c_folder(controller, "law").items():
        (folder / name).write_text(text, encoding="utf-8")
    kit = kit_in_c(controller, program)
    rows = [random_rows(controller, seed, SCANS) for seed in range(HISTORIES)]
    written = [row["mv"] is not None for history in rows for row in history]
    assert 0.3 < sum(written) / len(written) < 0.9
    assert {row["mode"] for history in rows for row in history} == {"MANUAL", "AUTO", "HOLD", "SHADOW"}
    for seed, history in enumerate(rows):
        said = _played(program, replace(kit, scans=history), folder)
        assert f"{SCANS} scans, 0 wrong" in said, f"history {seed}: {re.findall('scan .*', said)[:1]}"


def _played(program: Any, kit: KitInC, folder: Path) -> str:
    text = printed_self_test("histories", "law", program, kit)
    (folder / "law_selftest.c").write_text(text, encoding="utf-8")
    sources = ["law.c", "law_guard.c", "law_selftest.c"]
    subprocess.run(["gcc", "-std=c99", "-O0", "-ffp-contract=off", *sources, "-lm", "-o", "t"], cwd=folder, check=True)
    return subprocess.run([str(folder / "t")], capture_output=True, text=True, check=False).stdout
