"""``loopwright new``: what a person knows of pairs of PV and input, and which tags are one loop."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
import yaml
from dirty_plant import cells, clean, write
from undrawn import draw_nothing

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.config.known import Known
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.historian.cleaning.tags import Tag, read_tags
from loopwright.pipeline.historian.export_params import exported, signal_tags
from loopwright.pipeline.historian.guessing import controlled_first, loop_in
from loopwright.pipeline.historian.old_loop_fit import _partner
from loopwright.pipeline.stages.fit import Fits

ROLES = ["--pv", "TIC-101.PV[degC]=0..120", "--mv", "TIC-101.OP[%]", "--dv", "FI-7[kg/h]"]
NEW = ["new", "tank", "x.csv", *ROLES]
HEADER = ("timestamp", "TIC-101.PV", "TIC-101.OP", "FI-7")
MV, DV = "TIC-101.PV/TIC-101.OP", "TIC-101.PV/FI-7"


@pytest.fixture(autouse=True)
def _repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw_nothing(monkeypatch)
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text("cases:\n  taken: {}\n")
    write(Path("x.csv"), cells(clean(1500)), HEADER)


def said(*words: str) -> list[str]:
    return [part for text in words for part in ("--known", text)]


def known() -> tuple[Known, ...]:
    return PlantParams.read("tank").known


def test_statements_stand_in_params_yaml_and_reach_the_fit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*NEW, *said(f"{MV}=+", f"{MV}=gain 0.5..1, dead 0..30", f"{DV}=none")]) == 0
    wanted = (
        Known("TIC-101.PV", "TIC-101.OP", "+", (0.5, 1.0), (0.0, 30.0)),
        Known("TIC-101.PV", "FI-7", "none"),
    )
    assert known() == wanted
    case = all_cases()["tank"]
    assert Fits({}, {0: None}, case).source(0).known == case.known == wanted
    out = capsys.readouterr().out
    assert all(one.says in out for one in wanted)
    assert "turned round" not in out


def test_nothing_said_writes_nothing() -> None:
    assert main(NEW) == 0
    assert "known" not in yaml.safe_load(Path("params.yaml").read_text())["plants"]["tank"]


@pytest.mark.parametrize("words", ["-", "gain 2..3", "gain -3..0.1", "dead 600..700"])
def test_a_contradiction_is_asked(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The gain is .8, and the dead time is less than a minute."""
    assert main([*NEW, *said(f"{MV}={words}")]) == 0
    out = capsys.readouterr().out
    assert known()[0].question(0.0, 0.0).partition("' is said")[0] in out
    assert "loopwright run tank" not in out  # the question comes first
    assert f"you know of {known()[0].pair}" in Path("data/tank/screening.html").read_text()


def test_the_table_shows_the_pairs_and_takes_what_is_known_of_them() -> None:
    assert main(["new", "tank", "x.csv"]) == 0
    table = Path("tank-tags.csv")
    lines = list(csv.DictReader(table.read_text().splitlines()))
    assert [line["known"] for line in lines] == ["", "TIC-101.PV=", "TIC-101.PV="]
    assert [line["loop"] for line in lines] == ["TIC-101", "TIC-101", ""]
    assert main(["new", "tank", "x.csv", "--tags", "tank-tags.csv"]) == 0  # as it is, it says nothing
    assert known() == ()
    lines[1]["known"], lines[1]["name"] = "TIC-101.PV=+, gain 0,5..1; TIC-101.PV=dead 0..30", "valve"
    lines[2]["known"] = "none"  # there is one pv alone
    rewritten(table, lines)
    assert main(["new", "tank", "x.csv", "--tags", "tank-tags.csv", "--replace"]) == 0
    assert known() == (
        Known("TIC-101.PV", "valve", "+", (0.5, 1.0), (0.0, 30.0)),
        Known("TIC-101.PV", "FI-7", "none"),
    )
    taken_back = ["--tags", "tank-tags.csv", "--replace", *said(f"{MV}=")]
    assert main(["new", "tank", "x.csv", *taken_back]) == 0  # of the table and of the plant, in one act
    assert known() == (Known("TIC-101.PV", "FI-7", "none"),)


def rewritten(table: Path, lines: list[dict[str, Any]]) -> None:
    with table.open("w") as file:
        rows = csv.DictWriter(file, lines[0], lineterminator="\n")
        rows.writeheader()
        rows.writerows(lines)


def test_every_mistake_of_the_table_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", "tank", "x.csv"]) == 0
    table = Path("tank-tags.csv")
    lines = list(csv.DictReader(table.read_text().splitlines()))
    for line, words in zip(lines, ("FI-7=+", "TIC-101.PV=up", "TIC-1.PV=+"), strict=True):
        line["known"] = words
    rewritten(table, lines)
    capsys.readouterr()
    assert main(["new", "tank", "x.csv", "--tags", "tank-tags.csv"]) == 2
    err = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[1] for line in err] == [f"{tag}, known" for tag in HEADER[1:]]
    assert not Path("data/tank").exists()


@pytest.mark.parametrize(
    "words",
    [f"{MV}=up", f"{MV}=gain 2..1", "TIC-101.PV/TIC-102.OP=+", "TIC-101.OP/TIC-101.PV=+", MV, f"{MV}=none",
     f"{MV}=+|{MV}=-", f"{MV}=+, none"],
)  # fmt: skip
def test_what_cannot_be_is_one_line_and_writes_nothing(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = Path("params.yaml").read_text()
    assert main([*NEW, *said(*words.split("|"))]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert Path("params.yaml").read_text() == before
    assert not Path("data").exists()


def test_a_replacement_keeps_what_is_known_of_pairs_that_are_still_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*NEW, *said(f"{MV}=+, dead 0..30", f"{DV}=none")]) == 0
    capsys.readouterr()
    assert main([*NEW, "--replace", *said(f"{MV}=gain 0.5..1")]) == 0
    both = {one.input: one for one in known()}
    assert both["TIC-101.OP"] == Known("TIC-101.PV", "TIC-101.OP", "", (0.5, 1.0))  # said anew, it prevails
    assert both["FI-7"] == Known("TIC-101.PV", "FI-7", "none")
    assert f"known: {DV}=none" in capsys.readouterr().out
    assert main([*NEW, "--replace", *said(f"{DV}=")]) == 0  # taken back
    assert known() == (both["TIC-101.OP"],)
    assert main(["new", "tank", "x.csv", *ROLES[:-2], "--replace"]) == 0
    assert known() == (both["TIC-101.OP"],)


def test_column_loop_says_which_tags_belong_together(tmp_path: Path) -> None:
    """Names would give TIC-1.SP the PV and the valve of its own name."""
    table = tmp_path / "t.csv"
    table.write_text(
        "tag,role,loop\nTIC-1.PV,pv,\nTIC-2.PV,pv,A\nTIC-1.OP,mv,-\nTIC-2.OP,mv,A\nTIC-1.SP,sp,A\nTIC-2.SP,sp,TIC-2\n"
    )
    for tags in (read_tags(table), signal_tags([exported(tag) for tag in read_tags(table)])):
        own = {t.tag: t for t in tags}
        pvs, mvs = ([t for t in tags if t.role == role] for role in ("pv", "mv"))
        assert _partner(own["TIC-1.SP"], pvs, 0) == own["TIC-2.PV"]
        assert _partner(own["TIC-1.SP"], mvs, -1) == own["TIC-2.OP"]
        assert _partner(own["TIC-2.SP"], mvs, -1) is None
        assert [loop_in(t) for t in controlled_first(tags) if t.role == "pv"] == [
            "A",
            "TIC-1",
        ]  # those with a set point first
    assert exported(Tag("TIC-1.PV", "pv", loop="TIC-1")).loop == ""  # as its name says
