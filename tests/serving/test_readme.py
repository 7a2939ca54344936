"""The Python of README.md closes the loop over the plant that it names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import loopwright.serving.loop
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.serving import VirtualClock

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
SCANS = 200


@pytest.mark.parametrize("block", BLOCKS, ids=["step", "loop"])
def test_the_examples_hold_the_set_point(block: str, plant: EquationPlant, monkeypatch: pytest.MonkeyPatch) -> None:
    x, applied = plant.start
    advance, written = plant.stepper(), []

    def write_plant(mv: np.ndarray) -> None:
        nonlocal x, applied
        x, applied = advance(x, mv, plant.dv_nominal, plant.parameters()), mv
        written.append(mv)
        if len(written) == SCANS:
            raise KeyboardInterrupt

    plants: dict[str, Any] = {
        "read_plant": lambda: plant.measure(x).tolist(),
        "read_actuator": lambda: applied.tolist(),
        "write_plant": write_plant,
    }
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(loopwright.serving.loop, "MonotonicClock", VirtualClock)
    with pytest.raises(KeyboardInterrupt):
        exec(block, plants)
    assert plant.measure(x)[0] == pytest.approx(0.6661, abs=1e-3)


def test_the_examples_are_short() -> None:
    assert len(BLOCKS) == 2
    assert max(len([line for line in block.splitlines() if line.strip()]) for block in BLOCKS) <= 20
