"""A loop that runs signed controllers only, on a served plant. Loaded by ``pytest_plugins``, not imported."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from plant_servers import Plant, RunningLoop

from loopwright.pipeline.__main__ import main
from loopwright.serving.signing.keys import PrivateKey
from loopwright.serving.signing.sign import sign

ARTIFACTS = Path(__file__).parents[1] / "artifacts" / "thiosulfate_cstr"
SPEED = 2.5  # periods of .2 s
SIGNERS = {"pid": "anna", "inverse_dob": "anna", "incad": "bob", "incadec": None}


@pytest.fixture(scope="module")
def trusting(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The loop.toml of a loop that trusts anna, beside controllers of anna, of bob and of nobody."""
    plant = Plant(tmp_path_factory.mktemp("plant"), "thiosulfate_cstr", SPEED, "--noise")
    plant.start()
    folder = tmp_path_factory.mktemp("loop")
    for law, name in SIGNERS.items():
        for suffix in (".onnx", ".json"):
            shutil.copy(ARTIFACTS / f"{law}{suffix}", folder)
        if name is not None:
            sign(folder / f"{law}.onnx", PrivateKey.read(keys / f"{name}.key", None))
    shutil.copy(keys / "anna.pub", folder)
    path = folder / "loop.toml"
    assert main(["loop", "init", str(folder / "pid.onnx"), "--endpoint", plant.endpoint, "--out", str(path)]) == 0
    text = path.read_text().replace('# trusted = ["maker.pub"]', 'trusted = ["anna.pub"]')
    text = re.sub("sha256 = .*", f"speed = {SPEED}", text).replace('page = "127.0.0.1:8080"', 'page = "127.0.0.1:0"')
    path.write_text(re.sub("max_age_s = .*", "max_age_s = 5", text))  # this machine has other work beside it
    yield path
    plant.end()


@pytest.fixture(scope="module")
def trusting_loop(trusting: Path) -> Iterator[RunningLoop]:
    made = RunningLoop(trusting)
    yield made
    made.end()
