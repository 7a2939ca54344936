"""What ``loopwright st`` writes: all of it is read by blark, the vectors find no fault, and XML holds the same text."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from identified_models import random_model
from kits import SOME, name
from predictive_loops import law_of
from structured_text.machine import Machine

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.errors import ExportError
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.export.structured_text.iec_names import array_of, field_names, lreal, require_st_name, typed

PID = next(f for f in SOME if name(f) == "thiosulfate_cstr-pid")
PARTS = ("types", "step", "guard", "test")
SPACE = "{http://www.plcopen.org/xml/tc6_0200}"


def written(file: Path, folder: Path) -> dict[str, str]:
    assert main(["st", str(file), str(folder), "--name", "tank"]) == 0
    return {f.name: f.read_text() for f in folder.iterdir()}


def verdict(files: dict[str, str]) -> tuple[int, int]:
    """Wrong steps and wrong scans, after the test program has run through."""
    text = "\n".join(files[f"tank_{part}.st"] for part in PARTS)
    program = Machine(text).make("tank_test")
    cycles = 0
    while not program.done:
        program()
        cycles += 1
        assert cycles < 1000
    assert cycles > 20
    return program.steps_wrong, program.scans_wrong


@pytest.fixture(scope="module")
def steered(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The folder of a law that operators steer, with measured disturbances and a course to come."""
    folder = tmp_path_factory.mktemp("law")
    model = random_model(5, n_y=2, n_mv=2, n_dv=1)
    law = law_of(model, horizon=8, operate={"y1.low": -0.5}, preview="course")
    export(law, folder / "law.onnx", case="made", provenance={})
    return written(folder / "law.onnx", folder / "st")


def test_the_vectors_of_a_pid_find_no_fault(tmp_path: Path) -> None:
    assert verdict(written(PID, tmp_path / "st")) == (0, 0)


def test_the_vectors_of_a_law_that_operators_steer_find_no_fault(steered: dict[str, str]) -> None:
    assert verdict(steered) == (0, 0)
    assert (
        "TYPE tank_operate :\nSTRUCT\n    y0_use : LREAL := 1.0; (* y0.use, 0.0 to 1.0 *)\n" in steered["tank_types.st"]
    )
    assert "\n    y1_low : LREAL := -0.5;" in steered["tank_types.st"]


def test_the_vectors_find_a_wrong_digit_and_a_wrong_guard(tmp_path: Path) -> None:
    files = written(PID, tmp_path / "st")
    step = files["tank_step.st"].replace("-1853.140559963534", "-1853.140559963535")
    assert step != files["tank_step.st"]
    steps, scans = verdict(files | {"tank_step.st": step})
    assert steps > 10
    assert scans == 0
    guard = files["tank_guard.st"].replace("age_s <= period_s", "age_s <= (LREAL#9.0 * period_s)")
    assert verdict(files | {"tank_guard.st": guard})[1] > 0


def blocks_of(xml: str) -> dict[str, ElementTree.Element]:
    return {pou.attrib["name"]: pou for pou in ElementTree.fromstring(xml).iter(f"{SPACE}pou")}


def test_xml_holds_the_same_blocks(steered: dict[str, str]) -> None:
    text = "\n".join(steered[f"tank_{part}.st"] for part in PARTS)
    machine, found = Machine(text), blocks_of(steered["tank.xml"])
    assert set(found) == {n for n, unit in machine.units.items() if unit.kind != "TYPE"}
    for unit, pou in found.items():
        variables = [v.attrib["name"] for v in pou.iter(f"{SPACE}variable")]
        assert variables == list(machine.fields[unit])
        for v in pou.iter(f"{SPACE}variable"):
            values = [float(x.attrib["value"]) for x in v.iter(f"{SPACE}simpleValue")
                      if x.attrib["value"] not in ("TRUE", "FALSE")]  # fmt: skip
            held = machine.initial[unit][v.attrib["name"]]
            if values:
                assert values == (held if isinstance(held, list) else [held])
        body = next(pou.iter("{http://www.w3.org/1999/xhtml}xhtml")).text
        assert body is not None
        lines = [line for line in body.splitlines() if line]
        assert lines[-1] in text
    structure = next(ElementTree.fromstring(steered["tank.xml"]).iter(f"{SPACE}struct"))
    assert [v.attrib["name"] for v in structure] == list(machine.fields["tank_operate"])


def test_arrays_of_variables_have_named_types(steered: dict[str, str]) -> None:
    declared = set(re.findall(r"TYPE (tank_\w+) : ARRAY", steered["tank_types.st"]))
    assert {"tank_lreal_2", "tank_bool_2"} <= declared
    for part in ("step", "guard", "test"):
        variables, constant = [], False
        for line in steered[f"tank_{part}.st"].splitlines():
            constant = line == "VAR CONSTANT" or (constant and line != "END_VAR")
            variables += [] if constant else re.findall(r"^    \w+ : (tank_\w+_\d+|ARRAY.*?);", line)
        assert set(variables) <= declared
        assert variables
    project = ElementTree.fromstring(steered["tank.xml"])
    types = {t.attrib["name"]: t for t in project.iter(f"{SPACE}dataType")}
    assert set(types) == {*declared, "tank_operate"}
    assert next(types["tank_lreal_2"].iter(f"{SPACE}dimension")).attrib == {"lower": "0", "upper": "1"}
    used = {d.attrib["name"] for d in project.iter(f"{SPACE}derived")}
    assert used - declared <= {"tank_operate", "tank_step", "tank_guard"}


def test_every_name_is_legal_in_all_three_systems(steered: dict[str, str]) -> None:
    names = {n for pou in ElementTree.fromstring(steered["tank.xml"]).iter() if (n := pou.attrib.get("name"))}
    own = {n for n in names if n not in ("tank",)}
    assert len(own) > 100
    for n in own:
        assert n in ("k", "n", "tank_test") or require_st_name(n) == n


@pytest.mark.parametrize("wrong", ["", "2x", "a__b", "a_", "Tank", "begin", "m1", "x" * 61, "t-1"])
def test_a_name_that_a_system_refuses_is_refused(wrong: str) -> None:
    with pytest.raises(ExportError, match="name"):
        require_st_name(wrong)


def test_names_of_tags_differ() -> None:
    assert field_names(["TIC-1.low", "TIC 1.low", "1PV.use", "step", "µ"]) == [
        "tic_1_low", "tic_1_low_2", "tag_1pv_use", "tag_step", "tag",
    ]  # fmt: skip


def test_numbers_read_back_as_the_same_double() -> None:
    for value in (0.1, 1e-5, 5e-324, 1.7976931348623157e308, -2.5, 1e22, 123456789.0, -0.0):
        text = lreal(value)
        assert float(text).hex() == value.hex()
        assert re.fullmatch(r"-?\d+\.\d+(E[+-]\d{2,3})?", text), text
    assert typed(-1.5) == "(-LREAL#1.5)"
    assert array_of("BOOL", [True, False]) == "ARRAY[0..1] OF BOOL := [TRUE, FALSE]"


@pytest.mark.parametrize(("words", "says"), [([], "is there already"), (["--name", "a__b"], "no name")])
def test_what_cannot_be_written_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    out = tmp_path / ("there" if not words else "new")
    if not words:
        out.mkdir()
    assert main(["st", str(PID), str(out), *words]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1


def test_the_command_says_how_long_a_step_may_take(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = written(PID, tmp_path / "st")
    said = capsys.readouterr().out
    found = re.findall(r"([\w ,.-]+): about ([\d.]+) ms", said)
    assert len(found) == 3
    assert all(0.001 < float(ms) < 10 for _, ms in found)
    assert all(f"{processor.strip()}: about {ms} ms" in files["tank_step.st"] for processor, ms in found)
