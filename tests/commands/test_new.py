"""``loopwright new``: from an export to a record and a section of params.yaml, or one line and nothing written."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from closed_loop_records import OperatedLoop
from dirty_plant import START_S, TAGS, Clean, cells, clean, write
from undrawn import draw_nothing

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.config.exports import screened_record
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.files import sha256
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.stages.screen import screen
from loopwright.serving.manifest import Signal

ROOT = Path(__file__).parents[2]
ROLES = ["--pv", "TIC-101.PV[degC]=0..120", "--mv", "TIC-101.OP[%]", "--dv", "FI-7[kg/h]"]
Tell = Callable[[], pytest.CaptureFixture[str]]


@pytest.fixture
def drawn() -> None:
    """Asked for by a test that looks at the page's pictures, or gives them data that are hard to draw."""


@pytest.fixture(autouse=True)
def _repository(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if "drawn" not in request.fixturenames:
        draw_nothing(monkeypatch)
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text("cases:\n  taken: {}\n")


def files() -> set[str]:
    return {p.as_posix() for p in Path().rglob("*") if p.is_file()}


def read_back(name: str) -> tuple[PlantParams, Record]:
    """What params.yaml has of the plant, and the record that its stage makes of the files, without its page."""
    with pytest.MonkeyPatch.context() as undrawn:
        draw_nothing(undrawn)
        screen(name)
    params = PlantParams.read(name)
    pv, dv, mv = (tuple(Signal(s.name, s.unit, s.low, s.high) for s in g) for g in (params.pv, params.dv, params.mv))
    return params, Record.read(params.data, Signals(params.period_s, pv, pv, dv, mv))


@pytest.mark.usefixtures("drawn")
def test_an_export_becomes_a_plant(capsys: pytest.CaptureFixture[str]) -> None:
    data = clean()
    path = write(Path("x.csv"), cells(data))
    assert main(["new", "tank", "x.csv", *ROLES]) == 0
    assert files() == {
        "params.yaml", "x.csv", "data/tank/screening.json", "data/tank/screening.html",
    }  # fmt: skip
    assert "can these data carry a model: yes" in capsys.readouterr().out
    params, record = read_back("tank")
    assert (params.period_s, params.pv[0].low, params.pv[0].high) == (6.0, 0.0, 120.0)
    np.testing.assert_allclose(record.pv[:, 0], data.pv)
    report = json.loads(Path("data/tank/screening.json").read_text())
    assert report["kept_rows"] == len(record)
    assert report["files"] == [{"file": "x.csv", "sha256": sha256(path)}]
    page = Path("data/tank/screening.html").read_text()
    assert 'src="data:image/png' in page
    assert re.search(r"From 20\d\d-\d\d-\d\d \d\d:\d\d:\d\d to 20\d\d-\d\d-\d\d \d\d:\d\d:\d\d, UTC\.", page)
    assert "http://" not in page
    assert "https://" not in page


@pytest.mark.usefixtures("drawn")
def test_the_same_export_gives_the_same_bytes() -> None:
    write(Path("x.csv"), cells(clean()))
    for name in ("plant_a", "plant_b"):
        assert main(["new", name, "x.csv", *ROLES]) == 0
        read_back(name)
    assert sha256(screened_record("plant_a")) == sha256(screened_record("plant_b"))
    pages = [Path(f"data/{n}/screening.html").read_text().replace(n, "") for n in ("plant_a", "plant_b")]
    assert pages[0] == pages[1]


def test_times_left_out_stand_in_params_yaml_and_the_record_is_made_again_without_them() -> None:
    write(Path("x.csv"), cells(clean()))
    times = ["600..1200", "2024-03-04T07:00..2024-03-04T07:10"]
    assert main(["new", "tank", "x.csv", *ROLES, *(w for t in times for w in ("--leave-out", t))]) == 0
    assert yaml.safe_load(Path("params.yaml").read_text())["exports"]["tank"]["leave_out"] == times
    _, record = read_back("tank")
    assert len(record) == 1300
    assert record.run[-1] == 2


def test_without_roles_a_table_is_written_corrected_and_read(capsys: pytest.CaptureFixture[str]) -> None:
    header = ("timestamp", "TIC-101.PV [degC]", "TIC-101.OP [%]", "FI-7 [kg/h]")
    write(Path("x.csv"), cells(clean()), header)
    assert main(["new", "tank", "x.csv"]) == 0
    assert files() == {"params.yaml", "x.csv", "tank-tags.csv"}
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("pv (", "mv (", "dv (", "sp (", "mode (", "name:", "step, good_percent"))
    assert "command_low, command_high of an mv: the range that the controller may command" in printed
    table = Path("tank-tags.csv")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [(r["tag"], r["role"], r["unit"]) for r in rows] == [
        ("TIC-101.PV", "pv", "degC"), ("TIC-101.OP", "mv", "%"), ("FI-7", "dv", "kg/h"),
    ]  # fmt: skip
    assert main(["new", "tank", "x.csv"]) == 2  # a corrected table is not lost
    assert "is there already" in capsys.readouterr().err
    table.write_text(table.read_text().replace("FI-7,dv,FI-7,", "FI-7,dv,Flow,"))
    assert main(["new", "tank", "x.csv", "--tags", "tank-tags.csv"]) == 0
    params, _ = read_back("tank")
    assert [s.name for s in (*params.pv, *params.mv, *params.dv)] == ["TIC-101.PV", "TIC-101.OP", "Flow"]
    assert params.mv[0].high == 100.0


def test_a_pv_that_never_moves_is_guessed_to_be_none() -> None:
    rows = [[*row, "25.0", "55"] for row in cells(clean(1500))]
    write(Path("x.csv"), rows, ("timestamp", "TIC-101.PV", "TIC-101.OP", "FI-7", "TI-8.PV", "TIC-101.SP"))
    assert main(["new", "tank", "x.csv"]) == 0
    found = {r["tag"]: (r["role"], r["remark"]) for r in csv.DictReader(Path("tank-tags.csv").read_text().splitlines())}
    assert found["TI-8.PV"] == ("", "constant")
    assert found["TIC-101.SP"] == ("sp", "constant")


LIMITS = ["--command", "TIC-101.OP=30..60", "--max-move", "TIC-101.OP=12"]


def test_what_the_controller_may_command_is_written_and_every_row_is_kept(capsys: pytest.CaptureFixture[str]) -> None:
    """By options and by the table alike; the valve went from 20 to 80 %."""
    write(Path("x.csv"), cells(clean()))
    assert main(["new", "tank", "x.csv", *ROLES, *LIMITS]) == 0
    params, record = read_back("tank")
    valve = params.mv[0]
    assert (valve.low, valve.high, valve.command, valve.max_move_per_min) == (0.0, 100.0, (30.0, 60.0), 12.0)
    assert record.mv.min() < 25 < 75 < record.mv.max()
    case = all_cases()["tank"]
    assert [(s.low, s.high, s.max_move) for s in case.plant.mv_signals] == [(30.0, 60.0, pytest.approx(1.2))]  # in 6 s
    assert [(s.low, s.high) for s in case.record_signals.mv] == [(0.0, 100.0)]
    assert main(["new", "kettle", "x.csv"]) == 0
    table = Path("kettle-tags.csv")
    lines = list(csv.DictReader(table.read_text().splitlines()))
    assert list(lines[0])[5:10] == ["low", "high", "command_low", "command_high", "max_move_per_min"]
    valve_line = {**lines[1], "command_low": "30", "command_high": "60", "max_move_per_min": "12"}
    with table.open("w") as file:
        rows = csv.DictWriter(file, lines[0], lineterminator="\n")
        rows.writeheader()
        rows.writerows([lines[0], valve_line, lines[2]])
    assert main(["new", "kettle", "x.csv", "--tags", "kettle-tags.csv"]) == 0
    assert read_back("kettle")[0].mv[0].command == (30.0, 60.0)
    assert read_back("kettle")[0].mv[0].max_move_per_min == 12.0


def test_every_mistake_of_the_table_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean()))
    Path("t.csv").write_text(
        "tag,role,low,high,command_low,command_high,max_move_per_min\n"
        "TIC-101.PV,pv,0,120,5,,\n"
        "TIC-101.OP,mv,0,100,-5,fast,0\n"
        "FI-7,dw,,,,,\n"
    )
    before = files()
    assert main(["new", "tank", "x.csv", "--tags", "t.csv"]) == 2
    lines = capsys.readouterr().err.splitlines()
    wanted = (
        ("line 2 (TIC-101.PV)", "command_low belongs to an mv"),
        ("line 3 (TIC-101.OP), command_high", "'fast' is no finite number"),
        ("line 3 (TIC-101.OP)", "command_low is -5, outside low to high, 0 to 100"),
        ("line 3 (TIC-101.OP)", "max_move_per_min is 0; give a change above 0"),
        ("line 4 (FI-7)", "role 'dw'"),
    )
    assert len(lines) == len(wanted)
    for line, (where, says) in zip(lines, wanted, strict=True):
        assert line.startswith(f"loopwright new: t.csv, {where}")
        assert says in line
    assert files() == before


def test_a_range_that_the_record_never_visited_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean()))
    assert main(["new", "tank", "x.csv", *ROLES, "--command", "TIC-101.OP=85..100"]) == 2
    assert "may be commanded from 85 to 100 %, but moved only from 20" in capsys.readouterr().err
    assert "plants" not in yaml.safe_load(Path("params.yaml").read_text())


def test_a_step_test_stays_where_the_controller_may_command() -> None:
    write(Path("x.csv"), cells(clean(300)))
    assert main(["new", "tank", "x.csv", *ROLES, *LIMITS, "--anyway"]) == 0
    rows = csv.DictReader(Path("data/tank/step_test.csv").read_text().splitlines())
    values = [float(r["TIC-101.OP [%]"]) for r in rows]
    assert 30 <= min(values) < max(values) <= 60


def test_a_step_test_is_no_faster_than_the_valve_may_move(capsys: pytest.CaptureFixture[str]) -> None:
    """Steps of 5 % at 2 % in a minute are ramps of 2.5 minutes; the hold begins when a ramp has ended."""
    write(Path("x.csv"), cells(clean(300)))
    tables = []
    for name, more in (("tank", []), ("kettle", ["--max-move", "TIC-101.OP=2"])):
        assert main(["new", name, "x.csv", *ROLES, *more, "--anyway"]) == 0
        tables.append(list(csv.DictReader(Path(f"data/{name}/step_test.csv").read_text().splitlines())))
    free, slow = tables
    assert "move evenly over [min]" not in free[0]
    assert [r["TIC-101.OP [%]"] for r in free] == [r["TIC-101.OP [%]"] for r in slow]
    assert [r["hold [min]"] for r in free] == [r["hold [min]"] for r in slow]
    ramp, at, value = (
        np.array([float(r[c]) for r in slow]) for c in ("move evenly over [min]", "at [s]", "TIC-101.OP [%]")
    )
    moves = np.abs(np.diff(value))
    assert np.all(moves <= 2 * ramp[1:] + 0.2 + 1e-6)  # 0.2 % is what a period of 6 s allows
    assert np.all(ramp[1:] <= moves / 2 + 0.1 + 1e-6)
    assert ramp[1] == pytest.approx(moves[0] / 2, abs=0.1)
    hold = np.array([float(r["hold [min]"]) for r in slow])
    np.testing.assert_allclose(np.diff(at), 60 * (ramp + hold)[:-1], rtol=1e-3)


@pytest.mark.usefixtures("drawn")
def test_few_rows_are_said_where_the_plant_is_added_and_too_few_refused(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean(300)))
    assert main(["new", "tank", "x.csv", *ROLES]) == 0
    said = capsys.readouterr().out
    assert "300 rows for 18 parameters of a linear model are few; record 360 or more" in said
    assert "tank was added in spite of this, and its models may be poor" in said
    write(Path("y.csv"), cells(quick(60)))
    assert main(["new", "kettle", "y.csv", *ROLES]) == 2
    assert "60 rows for 18 parameters of a linear model: too few; record 360 or more" in capsys.readouterr().err


def test_fewer_rows_than_parameters_are_refused_whatever_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    more = [[*row, f"{k % 5}", f"{k % 7}"] for k, row in enumerate(cells(quick(24)))]
    write(Path("x.csv"), more, ("timestamp", *(t.tag for t in TAGS), "FI-8", "FI-9"))
    assert main(["new", "tank", "x.csv", *ROLES, "--dv", "FI-8", "--dv", "FI-9", "--anyway"]) == 2
    assert "--anyway does not help" in capsys.readouterr().err


def quick(n: int) -> Clean:
    """So few rows that the valve must be moved often to be seen moving."""
    data = clean(n)
    return data.with_(mv=30.0 + 30.0 * (np.arange(n) // 4 % 2))


@pytest.mark.usefixtures("drawn")
def test_a_constant_mv_gets_a_step_test_and_no_section(capsys: pytest.CaptureFixture[str]) -> None:
    data = clean()
    write(Path("x.csv"), cells(data.with_(mv=np.full(len(data.mv), 40.0))))
    before = Path("params.yaml").read_bytes()
    assert main(["new", "tank", "x.csv", *ROLES]) == 2
    assert "was not added to params.yaml: TIC-101.OP is 40 % in every row" in capsys.readouterr().err
    assert Path("params.yaml").read_bytes() == before
    rows = list(csv.DictReader(Path("data/tank/step_test.csv").read_text().splitlines()))
    values = np.array([float(r["TIC-101.OP [%]"]) for r in rows])
    assert len(rows) > 20
    assert np.all((values >= 0) & (values <= 100))
    assert np.ptp(values) > 10
    at, hold = (np.array([float(r[c]) for r in rows]) for c in ("at [s]", "hold [min]"))
    np.testing.assert_allclose(np.diff(at), 60 * hold[:-1], rtol=1e-3)


def test_data_that_carry_no_model_are_refused_unless_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    """Swapped tags: refused with the report and the step test; a second try needs no cleaning; --anyway adds it."""
    write(Path("x.csv"), cells(clean(2500)))
    swapped = ["--pv", "TIC-101.OP[%]", "--mv", "TIC-101.PV[degC]", "--dv", "FI-7[kg/h]"]
    before = Path("params.yaml").read_bytes()
    for _ in range(2):
        assert main(["new", "tank", "x.csv", *swapped]) == 2
        error = capsys.readouterr().err
        assert "are the two swapped" in error
        assert "step_test.csv, or give --anyway" in error
        assert Path("params.yaml").read_bytes() == before
        assert {p.name for p in Path("data/tank").iterdir()} == {"screening.json", "screening.html", "step_test.csv"}
    assert main(["new", "tank", "x.csv", *swapped, "--anyway"]) == 0
    screen("tank")
    assert screened_record("tank").exists()
    assert main(["new", "tank", "x.csv", *swapped, "--anyway"]) == 2  # a plant that was added is not overwritten
    assert "already" in capsys.readouterr().err


@pytest.mark.usefixtures("drawn")
def test_the_verdict_is_on_the_page_and_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean(2500)))
    assert main(["new", "tank", "x.csv", *ROLES]) == 0
    (valve, flow) = json.loads(Path("data/tank/screening.json").read_text())["verdict"]["inputs"]
    assert valve["gain"]["TIC-101.PV"] == pytest.approx(0.8, rel=0.1)
    assert flow["gain"]["TIC-101.PV"] == pytest.approx(-0.02, rel=0.3)
    assert 0.5 < valve["band_share"] <= 1
    assert Path("data/tank/screening.html").read_text().count('src="data:image/png') == 4  # no detail without a fault
    said = capsys.readouterr().out
    assert re.search(r"TIC-101\.OP -> TIC-101\.PV: gain 0\.\d+ \[°C/%\] by one linear model, first answer", said)


def test_guesses_tell_disturbances_from_the_rest_and_controlled_variables_come_first() -> None:
    """A flow that the PV answers to is a disturbance, noise is none, nor a PV; one with a set point is the first."""
    data = clean(2500)
    random = np.random.default_rng(1)
    rows = [
        [r[0], f"{random.normal(80, 1):.2f}", r[1], r[2], r[3], "55", f"{random.normal(3, 0.1):.3f}"]
        for r in cells(data)
    ]
    header = ("timestamp", "TI-9.PV", "TIC-101.PV", "TIC-101.OP", "FI-7", "TIC-101.SP", "PI-3")
    write(Path("x.csv"), rows, header)
    assert main(["new", "tank", "x.csv"]) == 0
    table = Path("tank-tags.csv")
    rows = {r["tag"]: r for r in csv.DictReader(table.read_text().splitlines())}
    assert [rows[tag]["role"] for tag in ("FI-7", "PI-3", "TIC-101.SP", "TI-9.PV")] == ["dv", "", "sp", ""]
    assert "answers to no MV" in rows["TI-9.PV"]["remark"]
    table.write_text(table.read_text().replace("TI-9.PV,,", "TI-9.PV,pv,"))
    assert main(["new", "tank", "x.csv", "--tags", "tank-tags.csv"]) == 0
    assert [s.name for s in read_back("tank")[0].pv] == ["TIC-101.PV", "TI-9.PV"]


def test_a_set_point_without_its_loop_is_an_mv_and_units_stand_in_round_brackets_too() -> None:
    rows = [[r[0], r[1], r[2], r[3]] for r in cells(clean(1500))]
    write(Path("x.csv"), rows, ("timestamp", "TIC-101.PV (°C)", "PIC-7.SP (bar)", "FI-7 (kg/h)"))
    assert main(["new", "tank", "x.csv"]) == 0
    table = {r["tag"]: r for r in csv.DictReader(Path("tank-tags.csv").read_text().splitlines())}
    assert {tag: (r["role"], r["unit"]) for tag, r in table.items()} == {
        "TIC-101.PV": ("pv", "°C"),
        "PIC-7.SP": ("mv", "bar"),
        "FI-7": ("dv", "kg/h"),
    }


def test_all_tags_that_are_not_there_are_named_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean(600)))
    assert main(["new", "tank", "x.csv", "--pv", "TIC-102.PV[degC]", "--mv", "TIC-102.OP[%]"]) == 2
    said = capsys.readouterr().err
    assert "no tag 'TIC-102.PV'; did you mean 'TIC-101.PV'?" in said
    assert "no tag 'TIC-102.OP'" in said


@pytest.mark.parametrize("edited", [False, True])
def test_the_old_loop_of_the_record_before_is_nobody_s_wish(edited: bool, capsys: pytest.CaptureFixture[str]) -> None:
    roles = ["--pv", "TIC.PV[degC]=0..100", "--mv", "TIC.OP[%]=0..100", "--sp", "TIC.SP"]
    for file, kc in (("x.csv", 0.5), ("y.csv", 0.8)):
        y, u, sp = OperatedLoop(2.0, dead=3, kc=kc, ti=10.0, hold=120).rows(2_400, 0)
        rows = [[f"{START_S + k:.0f}", *(f"{v:.4f}" for v in row)] for k, row in enumerate(zip(y, u, sp, strict=True))]
        write(Path(file), rows, ("timestamp", "TIC.PV", "TIC.OP", "TIC.SP"))
    assert main(["new", "tank", "x.csv", *roles]) == 0
    text = Path("params.yaml").read_text()
    found = yaml.safe_load(text)["controllers"]["tank-old_loop"]
    if edited:
        assert text.count(f"kc: {found['kc']}") == 1
        Path("params.yaml").write_text(text.replace(f"kc: {found['kc']}", "kc: 0.25"))
    capsys.readouterr()
    assert main(["new", "tank", "y.csv", *roles, "--replace"]) == 0
    out = capsys.readouterr().out
    assert ("again if you want it: controllers.tank-old_loop: kc: 0.25" in out) is edited
    assert out.count("again if you want it") == edited


def test_a_plant_is_replaced_on_request_and_kept_where_the_new_data_fail(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean(2500)))
    assert main(["new", "tank", "x.csv", *ROLES]) == 0
    with Path("params.yaml").open("a") as file:
        file.write("  # Another plant.\n  kettle: {period_s: 1} # kept\n")
    text = Path("params.yaml").read_text()
    Path("params.yaml").write_text(text.replace("name: predictive,", "name: predictive, mv_rate: 5,"))
    first = {p: p.read_bytes() for p in (Path("params.yaml"), *Path("data/tank").iterdir())}
    capsys.readouterr()
    assert main(["new", "tank", "x.csv", *ROLES]) == 2
    assert "--replace" in capsys.readouterr().err
    swapped = ["--pv", "TIC-101.OP[%]", "--mv", "TIC-101.PV[degC]"]
    assert main(["new", "tank", "x.csv", *swapped, "--replace"]) == 2
    assert Path("data/tank-refused/step_test.csv").exists()
    assert {p: p.read_bytes() for p in first} == first
    assert main(["new", "tank", "x.csv", *ROLES[:-2], "--replace"]) == 0
    assert "again if you want it: controllers.tank-predictive: mv_rate: 5" in capsys.readouterr().out
    params, record = read_back("tank")
    assert params.dv == ()
    assert record.dv.shape[1] == 0
    assert "  # Another plant.\n  kettle: {period_s: 1} # kept\n" in Path("params.yaml").read_text()
    assert {p.name for p in Path("data").iterdir()} == {"tank", "tank-refused"}


def test_a_replacement_keeps_the_limits_of_the_controller(capsys: pytest.CaptureFixture[str]) -> None:
    """A new export must not free what the controller may not command; a limit that is given anew prevails."""
    write(Path("x.csv"), cells(clean(2500)))
    new = ["new", "tank", "x.csv", *ROLES]
    assert main([*new, "--command", "TIC-101.OP=20..70", "--max-move", "TIC-101.OP=6"]) == 0
    said = capsys.readouterr().out
    assert "TIC-101.OP: the controller may command 20 to 70 %, at most 6 % in a minute" in said
    assert main([*new, "--replace", "--max-move", "TIC-101.OP=9"]) == 0
    (mv,) = yaml.safe_load(Path("params.yaml").read_text())["plants"]["tank"]["mv"]
    assert (mv["command_low"], mv["command_high"], mv["max_move_per_min"]) == (20.0, 70.0, 9.0)
    said = capsys.readouterr().out
    assert "kept of the plant that was replaced: TIC-101.OP: command_low: 20; give another" in said
    assert "max_move_per_min" not in said
    assert "20 to 70 %, at most 9 % in a minute" in said


def test_a_replacement_that_params_yaml_does_not_take_leaves_the_plant() -> None:
    write(Path("x.csv"), cells(clean(1500)))
    assert main(["new", "tank", "x.csv", *ROLES]) == 0
    params = Path("params.yaml")
    params.write_text(params.read_text().replace("  tank:\n    period_s", "  ? tank\n  : period_s"))
    first = {p: p.read_bytes() for p in (params, *Path("data/tank").iterdir())}
    assert main(["new", "tank", "x.csv", *ROLES[:-2], "--replace"]) == 2
    assert {p: p.read_bytes() for p in (params, *Path("data/tank").iterdir())} == first


def test_only_what_new_wrote_is_replaced(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean(200)))
    assert main(["new", "batch_reactor", "x.csv", *ROLES, "--replace"]) == 2
    assert "is a case of this project" in capsys.readouterr().err
    assert main(["new", "taken", "x.csv", *ROLES, "--replace"]) == 2
    assert "cases has 'taken' already" in capsys.readouterr().err
    Path("data/tank").mkdir(parents=True)
    Path("data/tank/raw.csv").write_text("mine")
    assert main(["new", "tank", "x.csv", *ROLES, "--replace"]) == 2
    assert "raw.csv, which `new` did not write" in capsys.readouterr().err
    assert Path("data/tank/raw.csv").read_text() == "mine"


BAD: dict[str, tuple[list[str], str]] = {
    "commands backwards": (["tank", "x.csv", *ROLES, "--command", "TIC-101.OP=60..30"], "command_low must be below"),
    "commands of a PV": (["tank", "x.csv", *ROLES, "--command", "TIC-101.PV=30..60"], "'TIC-101.PV' is no mv"),
    "commands without roles": (["tank", "x.csv", "--command", "TIC-101.OP=30..60"], "name it with --mv"),
    "no range of commands": (["tank", "x.csv", *ROLES, "--command", "TIC-101.OP=30"], "write TAG=LOW..HIGH"),
    "no change": (["tank", "x.csv", *ROLES, "--max-move", "TIC-101.OP=0"], "give a change above 0"),
    "no number": (["tank", "x.csv", *ROLES, "--max-move", "TIC-101.OP=slow"], "'slow' is no finite number"),
    "no file": (["tank", "none.csv", *ROLES], "none.csv: no such file"),
    "two tags of one option": (["--pv", "PV", "op", "tank", "x.csv"], "tank: no such file; NAME is 'op': --pv"),
    "a folder": (["tank", ".", *ROLES], "is a folder"),
    "a name that a case has": (["taken", "x.csv", *ROLES], "cases has 'taken' already"),
    "no name": (["Tank 1", "x.csv", *ROLES], "cannot be a plant's"),
    "no MV": (["tank", "x.csv", "--pv", "TIC-101.PV"], "no manipulated variable is named"),
    "no PV": (["tank", "x.csv", "--mv", "TIC-101.OP"], "no process variable is named"),
    "an unknown tag": (["tank", "x.csv", "--pv", "TIC-101.PW", "--mv", "TIC-101.OP"], "did you mean 'TIC-101.PV'?"),
    "one tag twice": (["tank", "x.csv", "--pv", "FI-7", "--mv", "FI-7"], "'FI-7' is named twice"),
    "a bad form": (["tank", "x.csv", "--pv", "T[degC", "--mv", "TIC-101.OP"], "no tag 'T[degC'"),
    "a bad range": (["tank", "x.csv", "--pv", "FI-7=5..2", "--mv", "TIC-101.OP"], "low must be below high"),
    "a range of texts": (["tank", "x.csv", "--pv", "FI-7=a..b", "--mv", "TIC-101.OP"], "no finite number"),
    "a wrong range": (["tank", "x.csv", "--pv", "FI-7=0..1", "--mv", "TIC-101.OP"], "correct the range or the unit"),
    "tags and roles": (["tank", "x.csv", "--tags", "t.csv", *ROLES], "give one of them"),
    "no tags": (["tank", "x.csv", "--tags", "t.csv"], "t.csv: no such file"),
    "no time to leave out": (["tank", "x.csv", *ROLES, "--leave-out", "5..2"], "ends before it begins"),
    "no dates": (["tank", "x.csv", *ROLES, "--leave-out", "Monday..Friday"], "neither a date nor seconds"),
    "another time": (["tank", "x.csv", *ROLES, "--time", "when"], "no column 'when'"),
    "too fine": (["tank", "x.csv", *ROLES, "--period", "0.0001"], "longer --period"),
    "too coarse": (["tank", "x.csv", *ROLES, "--period", "1e9"], "shorter --period"),
    "a text column": (["tank", "x.csv", "--pv", "note", "--mv", "TIC-101.OP"], "has no good reading"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_is_one_line_and_writes_nothing(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments, says = BAD[name]
    header = ("timestamp", *(t.tag for t in TAGS), "note")
    write(Path("x.csv"), [[*row, "fine"] for row in cells(clean(200))], header)
    before = files(), Path("params.yaml").read_bytes()
    assert main(["new", *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert (files(), Path("params.yaml").read_bytes()) == before


def test_a_folder_that_is_there_is_kept(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean(200)))
    Path("data/tank").mkdir(parents=True)
    assert main(["new", "tank", "x.csv", *ROLES]) == 2
    assert "data/tank is there already" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--period", "--hold"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "x"])
def test_times_are_positive(option: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["new", "tank", "x.csv", f"{option}={value}"])
    assert end.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.usefixtures("drawn")
def test_the_example_of_the_repository(capsys: pytest.CaptureFixture[str]) -> None:
    """The simulated export with its dirt: every fault is named, the record is good."""
    script = ROOT / "examples" / "own_plant" / "make_export.py"
    subprocess.run([sys.executable, str(script), "export.csv"], check=True, timeout=60)
    arguments = ["--pv", "TIC-101.PV", "--mv", "TIC-101.OP", "--dv", "FI-7", "--sp", "TIC-101.SP"]
    assert main(["new", "tank", "export.csv", *arguments, "--mode", "TIC-101.MODE"]) == 0
    report = json.loads(Path("data/tank/screening.json").read_text())
    kinds = {f["kind"] for f in report["findings"]}
    assert {"text", "sentinel", "outlier", "stuck", "unit_slip", "duplicate", "quantization"} <= kinds
    assert report["verdict"]["carries"] == "yes"
    assert report["kept_rows"] / report["grid_rows"] > 0.95
    params, record = read_back("tank")
    assert [s.unit for s in (*params.pv, *params.mv, *params.dv)] == ["degC", "%", "kg/h"]
    assert 25 < record.pv.min() < record.pv.max() < 90


def corrected(table: Path, tag: str, **cells_of: str) -> None:
    """Write other cells of a tag into a table."""
    lines = list(csv.DictReader(table.read_text().splitlines()))
    with table.open("w") as file:
        rows = csv.DictWriter(file, lines[0], lineterminator="\n")
        rows.writeheader()
        rows.writerows({**line, **(cells_of if line["tag"] == tag else {})} for line in lines)


def test_a_command_widens_a_range_that_was_only_guessed(capsys: pytest.CaptureFixture[str]) -> None:
    """The file states no units, so that the range of the valve is what it did, 20 to 80."""
    write(Path("x.csv"), cells(clean()))
    assert main(["new", "tank", "x.csv"]) == 0
    table = Path("tank-tags.csv")
    line = next(r for r in csv.DictReader(table.read_text().splitlines()) if r["tag"] == "TIC-101.OP")
    low, high = float(line["low"]), float(line["high"])
    assert 15 < low < high < 85
    corrected(table, "TIC-101.OP", command_low="10", command_high="70")
    capsys.readouterr()
    assert main(["new", "tank", "x.csv", "--tags", "tank-tags.csv"]) == 0
    said = capsys.readouterr().out
    assert f"guessed from the readings, {line['low']} to {line['high']}; it is widened to 10 to {line['high']}" in said
    valve = read_back("tank")[0].mv[0]
    assert (valve.low, valve.high, valve.command) == (10.0, pytest.approx(high), (10.0, 70.0))
    corrected(table, "TIC-101.OP", command_low="", command_high="")
    again = ["new", "tank", "x.csv", "--tags", "tank-tags.csv", "--replace", "--command", "TIC-101.OP=12..95"]
    assert main(again) == 0
    assert (read_back("tank")[0].mv[0].low, read_back("tank")[0].mv[0].high) == (12.0, 95.0)


def test_a_command_does_not_widen_a_range_that_a_person_stated(capsys: pytest.CaptureFixture[str]) -> None:
    write(Path("x.csv"), cells(clean()))
    assert main(["new", "tank", "x.csv"]) == 0
    corrected(Path("tank-tags.csv"), "TIC-101.OP", low="15", command_low="10")
    assert main(["new", "tank", "x.csv", "--tags", "tank-tags.csv"]) == 2
    assert "command_low is 10, outside low to high, 15 to" in capsys.readouterr().err
    assert not Path("data/tank").exists()
