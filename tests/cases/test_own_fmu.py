"""A plant with an FMU: from the door to its tests, which run on the FMU itself."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from fmu_parts import EXAMPLE, FMI_2, fmu

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.cases.own_simulator import SimulatedCase
from loopwright.pipeline.commands.own_plant.from_simulator import (
    MISSING,
    SLOW_SETTLING,
    WANTED_SETTLING,
    proposals,
    simulated,
    table_from,
)
from loopwright.pipeline.excitation.planned import first_test
from loopwright.pipeline.files import sha256
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.plants.fmu.description import described
from loopwright.pipeline.plants.fmu.instance import Instance
from loopwright.pipeline.plants.simulator_file import FileSimulator
from loopwright.pipeline.stages.check import mistakes
from loopwright.serving.manifest import Signal

ROLES = ["--pv", "oxygen", "--mv", "air[%]", "--dv", "uptake=24..40"]
ROWS = ["--rows", "600"]
INPUT = 'valueReference="1" causality="input"'
CLEAR = FMI_2.replace(INPUT, 'valueReference="1" causality="local"')  # one input, and all ranges


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")
    return tmp_path


@pytest.fixture
def without_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws no pictures, which take most of the time of a small record."""
    monkeypatch.setattr("loopwright.pipeline.commands.new.write_page", lambda path, *of: path.write_text(""))


def new(*arguments: object) -> int:
    return main(["new", "basin", "--simulator", *map(str, arguments)])


def section() -> dict[str, object]:
    plant: dict[str, object] = yaml.safe_load(Path("params.yaml").read_text())["plants"]["basin"]
    return plant


def test_options_name_the_variables_and_the_case_runs_on_the_fmu(here: Path) -> None:
    assert new(EXAMPLE, *ROLES, *ROWS) == 0
    assert {p.name for p in Path("data/basin").iterdir()} >= {
        "record.parquet", "screening.json", "first_test.json", "simulator.fmu", "simulator.json",
    }  # fmt: skip
    assert mistakes() == []
    case = all_cases()["basin"]
    assert isinstance(case, SimulatedCase)
    assert case.reads == (Path("data/basin/simulator.fmu"), Path("data/basin/simulator.json"))
    report = json.loads(Path("data/basin/screening.json").read_text())
    assert report["files"] == [{"file": str(EXAMPLE), "sha256": sha256(EXAMPLE)}]
    assert sha256(case.reads[0]) == sha256(EXAMPLE)
    plant = case.simulator
    assert (plant.period_s, plant.dv_nominal.tolist()) == (case.signals.period_s, [32.0])
    assert [(s.name, s.unit, s.low, s.high) for s in (*plant.pv_signals, *plant.mv_signals, *plant.dv_signals)] == [
        ("oxygen", "mg/l", 0.0, 9.0), ("air", "%", 0.0, 100.0), ("uptake", "mg/(l h)", 24.0, 40.0),
    ]  # fmt: skip


@pytest.mark.usefixtures("without_page")
def test_the_table_is_written_corrected_and_read(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert new(EXAMPLE) == 0
    said = capsys.readouterr().out
    assert f"loopwright new basin --simulator {EXAMPLE} --tags basin-tags.csv" in said
    assert not Path("data").exists()
    rows = list(csv.DictReader(Path("basin-tags.csv").read_text().splitlines()))
    assert [(r["tag"], r["role"], r["unit"], r["low"], r["high"]) for r in rows] == [
        ("air", "mv", "%", "0", "100"), ("uptake", "mv", "mg/(l h)", "", ""), ("oxygen", "pv", "mg/l", "0", "9"),
    ]  # fmt: skip
    assert MISSING in rows[1]["remark"]
    assert new(EXAMPLE, "--tags", "basin-tags.csv") == 2  # as it is
    assert "uptake: neither the FMU nor you state a range" in capsys.readouterr().err
    rows[1] |= {"role": "dv", "low": "24", "high": "40", "name": "sludge"}
    with Path("basin-tags.csv").open("w") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    assert new(EXAMPLE, "--tags", "basin-tags.csv", *ROWS) == 0
    assert section()["dv"] == [{"name": "sludge", "unit": "mg/(l h)", "low": 24.0, "high": 40.0}]
    assert FileSimulator(Path("data/basin/simulator.fmu")).dv_signals[0].name == "sludge"


@pytest.mark.usefixtures("without_page")
def test_nothing_is_asked_where_the_fmu_says_all(here: Path) -> None:
    assert new(fmu(here, CLEAR), *ROWS) == 0
    assert [s["name"] for s in section()["mv"]] == ["air"]  # type: ignore[attr-defined]
    assert section()["dv"] == []


def test_a_short_step_for_a_fast_solver_becomes_a_period_that_suits_the_plant(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("loopwright.pipeline.excitation.planned.LONGEST_RUN", 640)
    path = fmu(here, CLEAR.replace('stepSize="30"', 'stepSize="1.5"'))  # it settles in 1060 of them
    table = table_from(path, (), "", None)
    assert table is not None
    assert table.step_s == 1.5
    made = simulated(FileSimulator(path, "basin", table=table), 500, None)
    assert made.test.settles
    assert WANTED_SETTLING / 1.2 < made.test.settling_periods <= SLOW_SETTLING
    assert made.test.settling_periods * made.plant.period_s == pytest.approx(1590, rel=0.05)


def test_an_fmu_that_begins_with_a_transient_is_given_time_to_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = Instance.begin

    def blown(self: Instance) -> None:
        """The start after ten minutes of too much air."""
        begin(self)
        self.step([0], np.array([95.0]), 0.0, 600.0)
        self._call("set", [0], [40.0])

    monkeypatch.setattr(Instance, "begin", blown)
    path = fmu(tmp_path, CLEAR)
    table = table_from(path, (), "", None)
    assert not first_test(FileSimulator(path, table=table)).at_rest
    made = simulated(FileSimulator(path, "basin", table=table), 500, None)
    assert made.test.at_rest
    assert made.plant.table is not None
    assert made.plant.table.rest_periods >= 2 * 50
    assert any("begin after" in f.words for f in made.found.report.findings)
    x, mv = made.plant.start
    assert mv.tolist() == [40.0]
    beside = made.plant.table.write_beside(path)
    again = FileSimulator(path)
    np.testing.assert_array_equal(again.measure(again.start[0]), made.plant.measure(x))
    assert beside.is_file()


def test_the_period_is_the_step_where_the_fmu_takes_any(tmp_path: Path) -> None:
    fixed = CLEAR.replace('canHandleVariableCommunicationStepSize="true"', "")
    for description, period_s, step_s in ((CLEAR, 25.0, 25.0), (fixed, 60.0, 30.0), (CLEAR, None, 30.0)):
        table = table_from(fmu(tmp_path, description), (), "", period_s)
        assert table is not None
        assert table.step_s == step_s


@pytest.mark.parametrize(
    ("description", "arguments", "says"),
    [
        (FMI_2, [*ROLES, "--sp", "x"], "the options: x has the role sp; of an FMU only pv, mv and dv count"),
        (FMI_2, [*ROLES, "--tags", "t.csv"], "--tags and options of roles are both given"),
        (FMI_2, ["--mv", "air"], "the options: no process variable is named"),
        (FMI_2, ["--mv", "airflow", "--pv", "oxygen"], "it has no variable 'airflow'"),
        (
            FMI_2,
            [*ROLES, *ROWS, "--command", "air=0..5000"],
            "air may be commanded from 0 to 5000 %, outside its",
        ),
        (CLEAR.replace(' stepSize="30"', ""), [], "proposes no step size; give the sampling period"),
        (
            CLEAR.replace('canHandleVariableCommunicationStepSize="true"', ""),
            ["--period", "45"],
            "--period 45: give a multiple of the simulator's period, 30 s",
        ),
    ],
)
def test_what_an_fmu_cannot_be_told_is_one_line_and_writes_nothing(
    description: str, arguments: list[str], says: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert new(fmu(here, description), *arguments) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not Path("data").exists()


def test_a_name_with_brackets_becomes_one_that_a_controller_can_have(tmp_path: Path) -> None:
    path = fmu(tmp_path, CLEAR.replace('"oxygen"', '"basin[2].oxygen"'))
    tags = [Tag("basin[2].oxygen", "pv"), Tag("air", "mv", "percent", 10.0)]
    table = table_from(path, tags, "t.csv", None)
    assert table is not None
    assert [(r.variable, r.signal) for r in table.rows] == [
        ("basin[2].oxygen", Signal("basin-2-.oxygen", "mg/l", 0.0, 9.0)),
        ("air", Signal("air", "percent", 10.0, 100.0)),  # a person's word counts before the FMU's
    ]
    assert FileSimulator(path, table=table).measure(FileSimulator(path, table=table).start[0]) > 4


def test_proposals_are_inputs_and_outputs_alone(tmp_path: Path) -> None:
    found = proposals(described(fmu(tmp_path, CLEAR)))
    assert [(g.tag.tag, g.tag.role) for g in found] == [("air", "mv"), ("oxygen", "pv")]
