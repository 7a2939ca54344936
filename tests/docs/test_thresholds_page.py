"""Every tuned number stands in the reference with its unit and reason."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "_ext"))

from manual.thresholds import Threshold, thresholds_of  # noqa: E402

MODULES = [
    file
    for room in ("pipeline", "serving")
    for file in (ROOT / room).rglob("*.py")
    if file.parent.parent.name != "cases"
]


def test_no_number_is_without_its_reason() -> None:
    found = [(file, number) for file in MODULES for number in thresholds_of(file.read_text(encoding="utf-8"))]
    assert len(found) > 500
    assert [f"{file.relative_to(ROOT)}: {number.name}" for file, number in found if not number.why] == []


@pytest.mark.parametrize(
    ("source", "numbers"),
    [
        ("NEAR = 0.1  # of the range", [("NEAR", "0.1", "of the range")]),
        ("# of the range,\n# as printed\nNEAR = -0.1", [("NEAR", "-0.1", "of the range, as printed")]),
        ('NEAR: Final = 2 * 60\n"""[s] of a visit."""', [("NEAR", "2 * 60", "[s] of a visit.")]),
        ("NEAR = (\n    0.1  # of the range\n)", [("NEAR", "0.1", "of the range")]),
        ("ENDS = (0, 1)", [("ENDS", "(0, 1)", "")]),
        ("LOW, NAME, HIGH = 0.1, 'a', 2  # of it", [("LOW", "0.1", "of it"), ("HIGH", "2", "of it")]),
        ("NAME = 'a'\nNONE = ()\nON = True\nnear = 0.1\nSUM = NEAR + 1", []),
    ],
)
def test_numbers_of_a_module(source: str, numbers: list[tuple[str, str, str]]) -> None:
    assert list(thresholds_of(source)) == [Threshold(*number) for number in numbers]
