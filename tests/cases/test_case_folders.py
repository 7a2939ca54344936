"""A case is one folder: it says there how its numbers were chosen, and nothing outside names it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from loopwright.pipeline.cases import CASES, PLANTS
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX

ROOT = Path(__file__).parents[2]
FOLDERS = {case.name: ROOT.joinpath(*type(case).__module__.split(".")[1:-1]) for case in CASES.values()}
SOURCES = [
    path
    for package in ("pipeline", "serving")
    for path in sorted((ROOT / package).rglob("*"))
    # `loopwright --help` shows commands that run as they stand.
    if path.suffix in {".py", ".j2"} and path != ROOT / "pipeline" / "__main__.py"
]
GENERIC = [path for path in SOURCES if ROOT / "pipeline" / "cases" not in path.parents]


def words_of(case: Case) -> set[str]:
    """What only this case is called by: its name, folder, plants, and its tests whose names no sentence would hold."""
    tests = {f"{name}{NOISE_SUFFIX}" for name in case.scenarios()} | {n for n in case.scenarios() if "_" in n}
    plants = {plant.name for plant in (case.plant_class, *case.further_plants)}
    return {case.name, FOLDERS[case.name].name, *plants, *tests} - {"held_out", f"held_out{NOISE_SUFFIX}"}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_nothing_outside_a_case_names_it(case: Case) -> None:
    pattern = re.compile(rf"(?<![\w.])({'|'.join(map(re.escape, sorted(words_of(case))))})(?!\w)")
    found = {
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in GENERIC
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if pattern.search(line)
    }
    assert not found


def test_every_plant_is_a_case_s() -> None:
    assert set(PLANTS) == {p.name for case in CASES.values() for p in (case.plant_class, *case.further_plants)}
    assert len(GENERIC) > 100


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_case_s_readme_names_each_of_its_tests_and_how_its_numbers_were_chosen(case: Case) -> None:
    text = (FOLDERS[case.name] / "README.md").read_text(encoding="utf-8")
    assert "## How the numbers were chosen" in text
    assert not [name for name in case.scenarios() if f"`{name}`" not in text]
