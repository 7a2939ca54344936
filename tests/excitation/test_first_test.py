"""A simulator that gives no number, or runs away, is refused in words; one that integrates is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.excitation.planned import first_test
from loopwright.pipeline.plants.simulator_file import FileSimulator

FILE = """
class Plant:
    period_s = 5.0
    pv = {{"T": ("degC", 0.0, 100.0)}}
    mv = {{"valve": ("%", 0.0, 100.0)}}

    def start(self):
        return [50.0], [50.0]

    def step(self, x, mv, dv):
        return [{next}]

    def measure(self, x):
        return [x[0]]
"""


def plant(folder: Path, following: str) -> FileSimulator:
    path = folder / "plant.py"
    path.write_text(FILE.format(next=following))
    return FileSimulator(path)


@pytest.mark.parametrize("following", ["float('nan')", "x[0] if mv[0] < 100 else float('inf')"])
def test_a_step_without_a_number_is_said_as_that(following: str, tmp_path: Path) -> None:
    with pytest.raises(PlantError, match="no finite number; check divisions") as caught:
        plant(tmp_path, following)
    assert "random" not in str(caught.value)


@pytest.mark.parametrize(
    ("following", "when"),
    [
        ("50 + 1.05 * (x[0] - 50) + 0.1 * (mv[0] - 50)", "after a step of valve to 55"),
        ("1.05 * x[0] + 0.1 * (mv[0] - 50)", "without a step"),
    ],
)
def test_an_unstable_plant_is_refused(following: str, when: str, tmp_path: Path) -> None:
    with pytest.raises(PlantError, match=f"{when} T goes to .* far from its range 0 to 100: the plant is unstable"):
        first_test(plant(tmp_path, following))


def test_an_integrator_is_no_unstable_plant(tmp_path: Path) -> None:
    found = first_test(plant(tmp_path, "x[0] + 0.1 * (mv[0] - 50)"))
    assert not found.settles
    assert found.gain[0][0] == pytest.approx(0.1, rel=1e-2)
