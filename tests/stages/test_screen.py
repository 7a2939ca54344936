"""Stage screen: the record of an own plant is made again of its files, and a disagreement is one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from dirty_plant import cells, clean, write
from undrawn import draw_nothing

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases.own_entries import entries_of
from loopwright.pipeline.config.exports import ExportParams, screened_record
from loopwright.pipeline.config.params import ModelParams, parse
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.files import sha256
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.models.identified.structure_search import MINUTES, StructureSearch
from loopwright.pipeline.models.part import groundworks
from loopwright.pipeline.records.old_loops import OldController
from loopwright.pipeline.stages.check import mistakes
from loopwright.pipeline.stages.code import listing
from loopwright.pipeline.stages.fit import parts_of
from loopwright.pipeline.stages.screen import screen
from loopwright.pipeline.tracking.stage_results import StageResult, datasets

ROOT = Path(__file__).parents[2]
ROLES = ["--pv", "TIC-101.PV[degC]", "--mv", "TIC-101.OP[%]", "--dv", "FI-7[kg/h]=300..700"]
NEW, RECORD = Path("data/tank"), screened_record("tank")
Edit = Callable[[dict[str, Any]], None]


@pytest.fixture(scope="module")
def added(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plant that `new` added; each test has a copy, so that it is added once."""
    path = tmp_path_factory.mktemp("added")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        draw_nothing(patch)
        for package in ("pipeline", "serving"):  # the list of files looks for them below the root
            Path(package).symlink_to(ROOT / package)
        Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")
        write(Path("x.csv"), cells(clean(1500)))
        assert main(["new", "tank", "x.csv", *ROLES]) == 0
    return path


@pytest.fixture
def drawn() -> None:
    """Asked for by a test that looks at the page's pictures."""


@pytest.fixture(autouse=True)
def _tank(request: pytest.FixtureRequest, added: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(added, tmp_path, symlinks=True, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    if "drawn" not in request.fixturenames:
        draw_nothing(monkeypatch)


def edited(edit: Edit) -> None:
    tree = yaml.safe_load(Path("params.yaml").read_text())
    edit(tree)
    Path("params.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))


def rows() -> int:
    return int(json.loads(RECORD.with_name("metrics.json").read_text())["per_seed"]["0"]["rows"])


def grown() -> None:
    """The file with twice as many rows."""
    write(Path("x.csv"), cells(clean(3000)))


def test_new_says_all_that_the_record_needs_and_no_more() -> None:
    found = yaml.safe_load(Path("params.yaml").read_text())["exports"]["tank"]
    assert found == {
        "case": "tank",
        "files": ["x.csv"],
        "tags": [
            {"tag": "TIC-101.PV", "role": "pv", "unit": "degC"},
            {"tag": "TIC-101.OP", "role": "mv", "unit": "%"},
            {"tag": "FI-7", "role": "dv", "unit": "kg/h", "low": 300.0, "high": 700.0},
        ],
    }
    more = ["--period", "12", "--hold", "60", "--time", "timestamp", "--anyway"]
    more += ["--mode", "TIC-101.MODE", "--without-mode", "MAN"]
    mode = [[*row, "MAN" if k < 100 else "AUTO"] for k, row in enumerate(cells(clean(3000)))]
    write(Path("y.csv"), mode, ("timestamp", "TIC-101.PV", "TIC-101.OP", "FI-7", "TIC-101.MODE"))
    assert main(["new", "kettle", "y.csv", *ROLES, *more]) == 0
    own = ExportParams.read("kettle")
    assert (own.period_s, own.hold_s, own.time, own.anyway, own.without_mode) == (12, 60, "timestamp", True, ("MAN",))
    assert mistakes() == []


def test_the_budget_of_the_search_is_written_and_is_its_default() -> None:
    """Of two controlled variables twice as much: what is fitted is what no number gives."""
    parts = yaml.safe_load(Path("params.yaml").read_text())["models"]["tank-identified"]["parts"]
    assert {part["minutes"] for part in parts.values()} == {MINUTES}
    signal = {"name": "a", "unit": "%", "low": 0.0, "high": 1.0}
    two = entries_of("it", {"pv": [signal] * 3, "mv": [signal] * 2, "data": "x.parquet"})
    assert two["models"]["it-identified"]["parts"]["plant2"]["minutes"] == 2 * MINUTES
    read = parts_of(ModelParams.read("tank-identified"), "models.tank-identified")
    (search,) = groundworks(read.values())  # one for all members
    assert isinstance(search, StructureSearch)
    assert search.minutes == MINUTES


def old(pv: str, mv: str, kc: float, doubt: str = "", same_name: bool = True) -> OldController:
    return OldController(pv, mv, "degC", "%", kc, 100.0, 0.0, 1.0, 0, 500, 20, 0.99, same_name, doubt)


def entries_with(*loops: OldController) -> dict[str, dict[str, Any]]:
    signals = {name: {"name": name, "unit": "", "low": 0.0, "high": 1.0} for name in ("A", "B", "U", "V")}
    plant = {"pv": [signals["A"], signals["B"]], "mv": [signals["U"], signals["V"]], "data": "x.parquet"}
    return entries_of("it", plant, old=loops)["controllers"]


def test_the_old_loop_is_a_controller_where_each_of_its_laws_is_believed() -> None:
    found = entries_with(old("B", "U", 2.0), old("A", "V", -1.23456))
    before = found["it-old_loop"]
    assert before["pairs"] == {"V": "A", "U": "B"} == found["it-pid"]["pairs"]
    assert "&" not in yaml.safe_dump(found)  # params.yaml knows no references
    assert (before["kc"], before["ti_s"], before["tuning"]) == ([-1.235, 2.0], [100.0, 100.0], "manual")
    parse(PID.Params, {k: v for k, v in before.items() if k not in {"case", "model", "name", "law"}}, "it-old_loop")


def test_the_loops_of_the_record_say_the_pairs_where_their_laws_are_not_known() -> None:
    found = entries_with(old("A", "V", 0.0, "by hand"), old("B", "U", 1.0))
    assert "it-old_loop" not in found
    assert found["it-pid"]["pairs"] == {"V": "A", "U": "B"}


def test_no_pairs_are_said_where_a_loop_is_missing_or_two_share_an_mv() -> None:
    for loops in (
        (old("A", "U", 1.0),),
        (old("A", "U", 1.0), old("B", "U", 1.0)),
        (old("A", "U", 1.0), old("B", "V", 1.0, "by hand", same_name=False)),
    ):
        found = entries_with(*loops)
        assert set(found) == {"it-predictive", "it-pid"}
        assert "pairs" not in found["it-pid"]


@pytest.mark.usefixtures("drawn")
def test_the_stage_makes_the_record_that_new_judged(capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    screen("tank")
    assert (
        capsys.readouterr().out == "tank: 1500 rows of 1 file(s) -> 1500 rows of 6 s, 1500 kept (100.0 %) in 1 run(s)\n"
    )
    assert json.loads(RECORD.with_name("screening.json").read_text()) == json.loads(
        Path("data/tank/screening.json").read_text()
    )
    metrics = json.loads(RECORD.with_name("metrics.json").read_text())
    assert metrics["files"] == [{"file": "x.csv", "sha256": sha256(Path("x.csv"))}]
    assert RECORD.with_name("screening.html").read_text().count('src="data:image/png;base64,iVBOR') == 4
    before = RECORD.read_bytes()
    screen("tank")
    assert RECORD.read_bytes() == before


def test_new_rows_reach_the_record_and_the_list_of_files_shows_them() -> None:
    screen("tank")
    before = {stage: listing(Path.cwd(), stage, "tank") for stage in ("screen", "fit", "design")}
    grown()
    after = {stage: listing(Path.cwd(), stage, "tank") for stage in before}
    assert {stage for stage in before if before[stage] != after[stage]} == {"screen"}
    assert after["screen"]["x.csv"] == sha256(Path("x.csv"))
    screen("tank")
    assert rows() == 3000


def test_readings_beyond_the_plant_s_range_are_left_out_and_counted(capsys: pytest.CaptureFixture[str]) -> None:
    """A range that nobody gave stands in params.yaml after `new`, and prevails over what later readings show."""
    edited(lambda tree: tree["plants"]["tank"]["pv"][0].update(high=62.0))
    grown()
    capsys.readouterr()
    screen("tank")
    said = capsys.readouterr().out
    assert said.count("\n") == 1
    report = json.loads(RECORD.with_name("screening.json").read_text())
    left_out = report["dropped_rows"]["range"]
    assert left_out > 100
    assert f"{left_out} dropped: range" in said
    assert "to 62 degC that was given" in str(report["findings"])
    values = pd.read_parquet(RECORD)["TIC-101.PV [degC]"]
    assert len(values) == rows() == 3000 - sum(report["dropped_rows"].values())
    assert values.max() < 72 < clean(3000).pv.max()


def drop_flow(tree: dict[str, Any]) -> None:
    del tree["exports"]["tank"]["tags"][2]


def other_unit(tree: dict[str, Any]) -> None:
    tree["plants"]["tank"]["pv"][0]["unit"] = "K"


def other_range(tree: dict[str, Any]) -> None:
    tree["plants"]["tank"]["dv"][0]["high"] = 800.0


def other_name(tree: dict[str, Any]) -> None:
    tree["exports"]["tank"]["tags"][0]["name"] = "T"


def no_plant(tree: dict[str, Any]) -> None:
    del tree["plants"]


def other_case(tree: dict[str, Any]) -> None:
    tree["exports"]["tank"]["case"] = "kettle"


def unknown_field(tree: dict[str, Any]) -> None:
    tree["exports"]["tank"]["perod_s"] = 6


def unknown_role(tree: dict[str, Any]) -> None:
    tree["exports"]["tank"]["tags"][0]["role"] = "cv"


def two_sources(tree: dict[str, Any]) -> None:
    tree["plants"]["tank"]["data"] = "data/tank/record.parquet"


MISTAKES = {
    "a missing tag": (drop_flow, "plants.tank has a dv 'FI-7', exports.tank has none; make the two agree"),
    "another unit": (other_unit, "TIC-101.PV is in 'degC' in the export, in 'K' in plants.tank"),
    "another range": (other_range, "FI-7: high is 700 in exports.tank, 800 in plants.tank; make the two agree"),
    "another name": (other_name, "exports.tank has a pv 'T', plants.tank has none; plants.tank has a pv 'TIC-101.PV'"),
    "no plant": (no_plant, "'tank'"),
    "another case": (other_case, "exports.tank has `case: kettle`; write `case: tank`"),
    "an unknown field": (unknown_field, "exports.tank: unknown key 'perod_s'; did you mean 'period_s'?"),
    "an unknown role": (unknown_role, "exports.tank.tags[0].role is 'cv'"),
    "two sources": (two_sources, "plants.tank has `data`, and exports.tank has the files of its record"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_disagreement_is_one_line_of_the_stage_and_of_check(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    edit, says = MISTAKES[name]
    edited(edit)
    capsys.readouterr()
    assert run_stage(screen, ["screen", "tank"], "PLANT") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert says in error
    assert any(says in line for line in mistakes())
    assert not RECORD.exists()


def test_a_file_that_is_not_there_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    Path("x.csv").unlink()
    assert listing(Path.cwd(), "screen", "tank")["x.csv"] == "not there"
    assert run_stage(screen, ["screen", "tank"], "PLANT") == 2
    says = "exports.tank.files: x.csv is not there; put it back, or correct the path"
    assert says in capsys.readouterr().err
    assert mistakes() == [says]


def test_another_period_is_refused_until_a_person_chooses(capsys: pytest.CaptureFixture[str]) -> None:
    data = clean(1500)
    write(Path("x.csv"), cells(data.with_(time_s=data.time_s[0] + 2 * (data.time_s - data.time_s[0]))))
    assert run_stage(screen, ["screen", "tank"], "PLANT") == 2
    assert "has a period of 12 s, plants.tank has 6 s; write `period_s: 6` in exports.tank" in capsys.readouterr().err
    edited(lambda tree: tree["exports"]["tank"].update(period_s=6.0))
    assert run_stage(screen, ["screen", "tank"], "PLANT") == 0


def test_a_record_that_carries_no_model_any_more_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    data = clean(1500)
    write(Path("x.csv"), cells(data.with_(mv=np.full(1500, 40.0))))
    assert run_stage(screen, ["screen", "tank"], "PLANT") == 2
    error = capsys.readouterr().err
    assert "TIC-101.OP is 40 % in every row; `loopwright new tank` with --replace writes the step test" in error
    # Anything but an answer to the valve: a person may still say that the record is to be used.
    random = np.random.default_rng(0)
    write(Path("x.csv"), cells(data.with_(pv=np.round(55 + random.normal(0, 1, 1500), 3))))
    assert run_stage(screen, ["screen", "tank"], "PLANT") == 2
    assert "write `anyway: true` in exports.tank" in capsys.readouterr().err
    edited(lambda tree: tree["exports"]["tank"].update(anyway=True))
    assert run_stage(screen, ["screen", "tank"], "PLANT") == 0


def test_a_replaced_plant_has_new_files_and_no_old_results(capsys: pytest.CaptureFixture[str]) -> None:
    screen("tank")
    edited(lambda tree: tree["exports"]["tank"].update(hold_s=30.0))
    write(Path("y.csv"), cells(clean(2500)))
    assert main(["new", "tank", "y.csv", *ROLES, "--replace"]) == 0
    assert "again if you want it: exports.tank: hold_s: 30.0" in capsys.readouterr().out
    assert not Path("work/tank").exists()
    assert ExportParams.read("tank").files == (Path("y.csv"),)
    screen("tank")
    assert rows() == 2500


def test_a_simulator_in_place_of_files_takes_them_out() -> None:
    simulator = ROOT / "examples" / "own_simulator" / "heater.py"
    assert main(["new", "tank", "--simulator", str(simulator), "--rows", "600", "--replace"]) == 0
    tree = yaml.safe_load(Path("params.yaml").read_text())
    assert tree["exports"] == {}
    assert tree["plants"]["tank"]["data"] == tree["models"]["tank-identified"]["data"] == "data/tank/record.parquet"
    assert mistakes() == []


def test_models_of_earlier_signals_do_not_stop_a_run() -> None:
    """Whoever adds a measured disturbance by hand has models in work/ that do not know it."""
    screen("tank")
    from identified_models import scaled_model

    folder = Path("work/tank/models/identified/seed0")
    folder.mkdir(parents=True)
    for name in ("identified", "plant1", "plant2"):
        scaled_model(1, 1, 1, 2, a=0.9 * np.eye(1), b=np.full((1, 2), 0.1), rest=np.eye(1, 4)).save(
            folder / f"{name}.npz"
        )
    assert case().ready
    edited(lambda tree: (drop_flow(tree), tree["plants"]["tank"].update(dv=[])))
    assert not case().ready
    assert mistakes() == []


def case() -> Case:
    from loopwright.pipeline.cases import all_cases

    return all_cases()["tank"]


def test_how_fast_an_mv_may_move_makes_the_laws_anew_and_not_the_models() -> None:
    before = {stage: listing(Path.cwd(), stage, "tank") for stage in ("screen", "fit", "design", "validate", "report")}
    edited(lambda tree: tree["plants"]["tank"]["mv"][0].update(max_move_per_min=6.0))
    changed = {stage for stage in before if listing(Path.cwd(), stage, "tank") != before[stage]}
    assert changed == {"design", "validate", "report"}


def test_what_is_known_of_a_pair_makes_the_models_anew_and_not_the_record() -> None:
    stages = ("screen", "fit", "design", "report")
    before = {stage: listing(Path.cwd(), stage, "tank") for stage in stages}
    plant = yaml.safe_load(Path("params.yaml").read_text())["plants"]["tank"]
    pair = {"pv": plant["pv"][0]["name"], "input": plant["mv"][0]["name"]}
    edited(lambda tree: tree["plants"]["tank"].update(known=[{**pair, "sign": "+"}]))
    assert {stage for stage in stages if listing(Path.cwd(), stage, "tank") != before[stage]} == {*stages[1:]}


def test_what_was_learnt_from_a_screened_record_descends_from_it() -> None:
    folder = RECORD.parent.as_posix()
    made = StageResult("screen@tank", "", {"work/code/screen-tank.json": "0"}, {}, {folder: "1.dir"})
    fit = StageResult("fit@tank-identified", "", {RECORD.as_posix(): "2"}, {}, {"work/tank/models/identified": "3.dir"})
    assert datasets(fit, [made, fit]) == datasets(made, [made, fit]) == {folder: "1.dir"}


LATE: dict[str, tuple[Edit, str]] = {
    "another period than the record's": (
        lambda tree: tree["plants"]["tank"].update(period_s=12.0),
        "the record of exports.tank has a period of 6 s, plants.tank has 12 s",
    ),
    "a horizon that nobody waits for": (
        lambda tree: tree["controllers"]["tank-predictive"].update(horizon=100_000),
        "horizon is 100000; give 8 to 500 samples",
    ),
    "no models to test on": (
        lambda tree: [tree["models"]["tank-identified"]["parts"].pop(name) for name in ("plant1", "plant2")],
        "models.tank-identified.parts lacks plant1, plant2, ..., the models that controllers are tested on",
    ),
    "no model to design on": (
        lambda tree: tree["models"]["tank-identified"]["parts"].pop("identified"),
        "models.tank-identified.parts lacks identified, the model that laws are designed on",
    ),
}


@pytest.mark.parametrize("screened", [False, True])
@pytest.mark.parametrize("name", LATE)
def test_the_check_finds_what_a_stage_would_meet_after_hours(name: str, screened: bool) -> None:
    if screened:
        screen("tank")
    assert mistakes() == []
    edit, said = LATE[name]
    edited(edit)
    found = mistakes()
    assert any(said in line for line in found), found


def test_a_period_that_both_sections_state_is_no_mistake() -> None:
    edited(lambda tree: (tree["plants"]["tank"].update(period_s=12.0), tree["exports"]["tank"].update(period_s=12.0)))
    assert mistakes() == []
