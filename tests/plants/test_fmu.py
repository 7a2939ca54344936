"""An FMU is a plant like the others, however it keeps its states, and each mistake in it is one line."""

from __future__ import annotations

import pickle
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import fmu_parts
import numpy as np
import pytest
from fmu_parts import EXAMPLE, FMI_2, FMI_3, KEEPS_2, KEEPS_3, TABLE, WRITES_2, WRITES_3, fmu, plant

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.fmu.description import FmuRow, FmuTable
from loopwright.pipeline.plants.fmu.instance import INSTANCES, KEPT_STATES, Instance
from loopwright.pipeline.plants.fmu.program import PREFIX
from loopwright.pipeline.plants.simulator_file import FileSimulator
from loopwright.pipeline.simulation.simulate import simulate_open
from loopwright.serving.manifest import Signal

Array = np.ndarray
DESCRIPTIONS = {
    "FMI 2, states as bytes": FMI_2,
    "FMI 2, states in memory": FMI_2.replace(WRITES_2, ""),
    "FMI 2, replayed": FMI_2.replace(WRITES_2, "").replace(KEEPS_2, ""),
    "FMI 2, replayed by one instance": FMI_2.replace(WRITES_2, "").replace(
        KEEPS_2, 'canBeInstantiatedOnlyOncePerProcess="true"'
    ),
    "FMI 3, states as bytes": FMI_3,
    "FMI 3, states in memory": FMI_3.replace(WRITES_3, ""),
    "FMI 3, replayed": FMI_3.replace(WRITES_3, "").replace(KEEPS_3, ""),
}
FIXED = FMI_2.replace('canHandleVariableCommunicationStepSize="true"', "")


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of temporary files of this test's own."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture(params=DESCRIPTIONS)
def aeration(request: pytest.FixtureRequest, tmp_path: Path) -> FileSimulator:
    return plant(fmu(tmp_path, DESCRIPTIONS[request.param]))


def unpacked(folder: Path) -> list[Path]:
    return list(folder.glob(f"{PREFIX}*"))


def course(mv: Array, uptake: float) -> Array:
    """The probe (n,) by the equations of aeration.c, from its rest, before each move."""
    c, b = 0.0, 40.0
    low, high = 0.0, 9.0
    for _ in range(60):
        c = (low + high) / 2
        low, high = (c, high) if 16 * b / (b + 60) * (9 - c) > 32 * c / (c + 0.4) else (low, c)
    c, p, rows = low, low, []
    for air in mv:
        rows.append(p)
        for _ in range(6):
            flow = 16 * b / (b + 60) * (9 - c) - uptake * c / (c + 0.4)
            c, b, p = c + 5 / 3600 * flow, b + 5 / 40 * (air - b), p + 5 / 60 * (c - p)
    return np.array(rows)


def moves(n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(0, 100, n).repeat(7)[:n].reshape(-1, 1)


def test_an_fmu_follows_its_equations_from_a_rest(aeration: FileSimulator) -> None:
    (x, mv), dv, p = aeration.start, aeration.dv_nominal, aeration.parameters()
    assert (aeration.period_s, mv.tolist(), dv.tolist()) == (30.0, [40.0], [32.0])
    assert aeration.measure(aeration.step(x, mv, dv, p)) == pytest.approx(aeration.measure(x), abs=1e-9)
    found = aeration.measured(simulate_open(aeration, x, moves(60)))[:-1, 0]
    np.testing.assert_allclose(found, course(moves(60)[:, 0], 32.0), atol=1e-9)
    assert np.ptp(found) > 1.0


def test_many_tests_go_on_side_by_side_from_any_state(aeration: FileSimulator) -> None:
    dv, p, rng = aeration.dv_nominal, aeration.parameters(), np.random.default_rng(1)
    asked = [[] for _ in range(3 * INSTANCES)]
    states = [aeration.start[0] for _ in asked]
    for _ in range(4 * KEPT_STATES):  # in any order, so that every test leaves the instance to others
        k = int(rng.integers(len(asked)))
        mv = rng.uniform(0, 100, 1)
        asked[k].append(mv)
        states[k] = aeration.step(states[k], mv, dv, p)
    again = plant(aeration.path)
    for state, mvs in zip(states, asked, strict=True):
        alone = simulate_open(again, again.start[0], np.array(mvs).reshape(-1, 1))[-1]
        np.testing.assert_array_equal(aeration.measure(state), again.measure(alone))
        np.testing.assert_array_equal(
            aeration.measure(aeration.step(state, mv, dv, p)), again.measure(again.step(alone, mv, dv, p))
        )


def test_a_copy_in_another_place_is_the_same_plant(aeration: FileSimulator) -> None:
    copy = pickle.loads(pickle.dumps(aeration))
    assert (copy.name, copy.period_s, copy.table) == (aeration.name, aeration.period_s, TABLE)
    runs = [simulate_open(one, one.start[0], moves(20)) for one in (aeration, copy)]
    np.testing.assert_array_equal(*(one.measured(run) for one, run in zip((aeration, copy), runs, strict=True)))


def test_a_period_of_several_steps_is_one_step_where_the_fmu_takes_any(tmp_path: Path) -> None:
    free, fixed = (plant(fmu(tmp_path, text, name=f"{k}.fmu"), 3) for k, text in enumerate((FMI_2, FIXED)))
    assert (free.period_s, free.strides, fixed.strides) == (90.0, True, False)
    ends = [one.measured(simulate_open(one, one.start[0], moves(10)))[-1] for one in (free, fixed)]
    np.testing.assert_allclose(*ends, atol=1e-9)  # its own steps are 5 s in both


def test_a_load_and_a_disturbance_act_on_the_inputs(tmp_path: Path) -> None:
    one = plant(fmu(tmp_path))
    x, dv = one.start[0], one.dv_nominal
    loaded = one.step(x, np.array([60.0]), dv, one.parameters({"load_air": 20.0}))
    np.testing.assert_array_equal(loaded, one.step(x, np.array([80.0]), dv, one.parameters()))
    calm, busy = (np.array([40.0]), dv), (np.array([40.0]), dv + 5)
    after = {}
    for name, (mv, disturbed) in {"calm": calm, "busy": busy}.items():
        state = x
        for _ in range(10):
            state = one.step(state, mv, disturbed, one.parameters())
        after[name] = float(one.measure(state)[0])
    assert after["busy"] < after["calm"] - 0.1


# ---------------------------------------------------------------------- folders and processes
def test_no_unpacked_folder_stays(tmp_path: Path, temporary: Path) -> None:
    assert plant(fmu(tmp_path)).n_x
    assert unpacked(temporary) == []
    path = fmu(tmp_path)
    with zipfile.ZipFile(path, "a") as content:  # an FMU that may read this file at any time
        content.writestr("resources/steam.txt", "1 2 3")
    one = plant(path)
    (folder,) = unpacked(temporary)
    assert (folder / "resources" / "steam.txt").read_text() == "1 2 3"
    another = plant(path)
    assert len(unpacked(temporary)) == 2  # what is in use stays
    with pytest.raises(PlantError, match="cannot be loaded"):
        plant(fmu(tmp_path, library=b"none", name="broken.fmu"))
    assert len(unpacked(temporary)) == 2
    del one, another
    assert unpacked(temporary) == []


def test_what_a_killed_process_leaves_is_removed_by_the_next(tmp_path: Path, temporary: Path) -> None:
    path = fmu(tmp_path)
    with zipfile.ZipFile(path, "a") as content:
        content.writestr("resources/steam.txt", "1 2 3")
    here = plant(path)
    work = (
        "import os, pickle, sys, tempfile; tempfile.tempdir = sys.argv[1]; plant = pickle.load(sys.stdin.buffer); "
        "x = plant.step(plant.start[0], plant.start[1] + 9, plant.dv_nominal, plant.parameters()); "
        "print(plant.measure(x)[0].hex(), flush=True); os._exit(0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", work, str(temporary)], input=pickle.dumps(here), stdout=subprocess.PIPE, check=True
    )
    x = here.step(here.start[0], here.start[1] + 9, here.dv_nominal, here.parameters())
    assert done.stdout.decode().strip() == float(here.measure(x)[0]).hex()
    assert len(unpacked(temporary)) == 2
    third = plant(path)
    assert len(unpacked(temporary)) == 2, "the dead process's folder is gone, those in use are not"
    assert third.n_x == here.n_x


# ---------------------------------------------------------------------- mistakes
def table(*changed: FmuRow) -> FmuTable:
    """TABLE with rows in place of those with the same role."""
    roles = {r.role for r in changed}
    return replace(TABLE, rows=(*changed, *(r for r in TABLE.rows if r.role not in roles)))


MISTAKES = {
    "FMI 1.0": (FMI_2.replace('fmiVersion="2.0"', 'fmiVersion="1.0" numberOfContinuousStates="0"'), TABLE, "FMI 1.0"),
    "no co-simulation": (
        FMI_2.replace("<CoSimulation", "<ModelExchange").replace('canHandleVariableCommunicationStepSize="true"', ""),
        TABLE,
        "for model exchange only",
    ),
    "half a description": (FMI_2[:900], TABLE, "no FMU that can be read"),
    "needs its tool": (FMI_2.replace("<CoSimulation ", '<CoSimulation needsExecutionTool="true" '), TABLE, "the tool"),
    "a name misspelt": (
        FMI_2, table(FmuRow("oxigen", "pv", Signal("o", "mg/l", 0, 9))), "no variable 'oxigen'; did you mean 'oxygen'?",
    ),
    "an integer": (FMI_3, table(FmuRow("blowers", "mv", Signal("n", "", 0, 3))), "'blowers' is of type Int32"),
    "an output as MV": (
        FMI_2, table(FmuRow("oxygen", "mv", Signal("o", "mg/l", 0, 9))), "'oxygen' is no input but output",
    ),
    "a start outside": (FMI_2, table(FmuRow("air", "mv", Signal("air", "%", 50, 100))), "air = 40, outside its range"),
    "no PV": (FMI_2, FmuTable(30.0, TABLE.rows[1:]), "pv is empty"),
    "no step": (FMI_2, replace(TABLE, step_s=0.0), "period_s is 0.0"),
    "a step that fails": (
        FMI_2,
        table(FmuRow("air", "mv", Signal("air", "%", -10, 100))),
        "doStep from 30 s on for 30 s: fmi2DoStep failed with status 3 (error).; it says: the air is below zero",
    ),
    "a step that fails, FMI 3": (
        FMI_3, table(FmuRow("air", "mv", Signal("air", "%", -10, 100))), "it says: the air is below zero",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_of_an_fmu_is_one_line_with_its_place(name: str, tmp_path: Path) -> None:
    text, given, says = MISTAKES[name]
    path = fmu(tmp_path, text)
    with pytest.raises(PlantError) as error:
        plant(path, table=given)
    assert says in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_files_that_are_no_fmu_for_this_machine(tmp_path: Path) -> None:
    path, here = tmp_path / "plant.fmu", Path.cwd()
    for content, says in ((None, "no such file"), (b"PK none", "no zip file")):
        if content:
            path.write_bytes(content)
        with pytest.raises(PlantError, match=says):
            plant(path)
    fmu_parts.made().pack(path, FMI_2, {"win64/aeration.dll": b""})
    with pytest.raises(PlantError, match=r"no library for this machine, .*; it has win64; export it for "):
        plant(path)
    with pytest.raises(PlantError, match="it cannot be loaded: Failed to load shared library"):
        plant(fmu(tmp_path, library=b"no library"))
    assert Path.cwd() == here
    with pytest.raises(PlantError, match=r"plant.json is not there; `loopwright new"):
        FileSimulator(fmu(tmp_path))


def test_without_fmpy_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(PlantError, match=r"^an FMU needs the package fmpy: pip install 'loopwright\[fmu\]'$"):
        plant(EXAMPLE)


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_after_a_step_that_failed_it_goes_on_from_any_state(name: str, tmp_path: Path) -> None:
    one = plant(fmu(tmp_path, DESCRIPTIONS[name]))
    dv, p = one.dv_nominal, one.parameters()
    x = one.step(one.start[0], np.array([70.0]), dv, p)
    expected = one.measure(one.step(x, np.array([20.0]), dv, p))
    one._low -= 10.0  # beyond what the table allows, and the FMU too
    with pytest.raises(PlantError, match="below zero"):
        one.step(x, np.array([-5.0]), dv, p)
    np.testing.assert_array_equal(one.measure(one.step(x, np.array([20.0]), dv, p)), expected)


def test_an_fmu_that_does_not_go_back_to_its_state_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Instance, "restore", lambda *of: None)
    with pytest.raises(PlantError, match="a step from the same state gives another result when it is done again"):
        plant(fmu(tmp_path))


def test_a_state_of_another_process_is_refused_where_it_cannot_be_known(tmp_path: Path) -> None:
    path = fmu(tmp_path, DESCRIPTIONS["FMI 2, replayed"])
    one, another = plant(path), plant(path)
    x = one.step(one.start[0], np.array([70.0]), one.dv_nominal, one.parameters())
    with pytest.raises(PlantError, match="cannot save its states, so a test can go on only where it began"):
        another.step(x, np.array([70.0]), one.dv_nominal, one.parameters())


def test_the_table_beside_an_fmu_is_read_and_its_mistakes_are_one_line(tmp_path: Path) -> None:
    path = fmu(tmp_path)
    beside = TABLE.write_beside(path)
    assert FileSimulator(path).table == TABLE
    text = beside.read_text()
    for wrong, says in (
        (text.replace('"mv"', '"op"'), "role 'op'; pv, mv, dv are known"),
        ("{}", "KeyError: 'variables'"),
    ):
        beside.write_text(wrong)
        with pytest.raises(PlantError) as error:
            FileSimulator(path)
        assert says in str(error.value)
        assert str(error.value).startswith(str(beside))


def test_the_example_is_packed_as_its_script_says() -> None:
    with zipfile.ZipFile(EXAMPLE) as content:
        assert content.read("modelDescription.xml").decode() == FMI_2
        assert content.namelist() == ["modelDescription.xml", "binaries/linux64/aeration.so"]
