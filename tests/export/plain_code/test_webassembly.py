"""A controller in plain C as a WebAssembly module: in Node it gives the bits of its statements, and is small."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from controller_fmus import controller_of
from kits import EMBED, PID, kit_of, verdict_on
from webassembly_modules import MISSING, module_of

from loopwright.pipeline.hosts.fmu.law_sources import plain_answers

if MISSING:
    pytest.skip(MISSING, allow_module_level=True)


def played(module: Path, kit: Path, answers: Path) -> subprocess.CompletedProcess[str]:
    words = ["node", EMBED / "wasm" / "host.mjs", module, "--conformance", kit, answers]
    return subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(
    ("of", "largest"), [("thiosulfate_cstr/pid", 4_000), ("ph_neutralization/predictive", 400_000)]
)
def test_a_module_gives_the_bits_of_the_statements(of: str, largest: int, tmp_path: Path) -> None:
    controller = controller_of(of)
    module = module_of(controller.path, tmp_path / "law")
    assert module.stat().st_size < largest
    done = played(module, kit_of(controller.path), tmp_path / "answers.json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert verdict_on(controller.path, tmp_path / "answers.json").passed
    compared = 0
    for ours, wanted in zip(
        json.loads((tmp_path / "answers.json").read_text())["steps"], plain_answers(controller), strict=True
    ):
        if wanted.step is None:
            assert ours == {"refused": wanted.refused}
            continue
        compared += 1
        found = [[float.fromhex(x).hex() for x in ours[name]] for name in ("mv", "state_next", "info")]
        assert found == [[value.hex() for value in part.tolist()] for part in wanted.step]
    assert compared > 300


def test_a_module_of_another_controller_is_refused(tmp_path: Path) -> None:
    other = kit_of(controller_of("thiosulfate_cstr/inc").path)
    done = played(module_of(PID, tmp_path / "law"), other, tmp_path / "answers.json")
    assert done.returncode == 2
    assert controller_of("thiosulfate_cstr/pid").sha256 in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "answers.json").exists()
