"""The events of a journal, read without the page."""

from __future__ import annotations

import csv
import io
import shutil
from pathlib import Path

import pytest

from loopwright.pipeline.__main__ import main
from loopwright.serving.journal import EventEntry, Journal

BEGIN = 1_772_323_200.0  # 2026-03-01 00:00 UTC
EVENTS = [
    EventEntry(BEGIN, "change", "loop", "loop.toml: started in SHADOW"),
    EventEntry(BEGIN + 3600, "change", "anna", "mode SHADOW -> AUTO", "handed over"),
    EventEntry(BEGIN + 3661, "fault", "loop", "PV T: bad,\nand more", "", "fault", True),
    EventEntry(BEGIN + 3700, "acknowledged", "anna", "PV T: bad", "cleaned", about=3),
]


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    path = tmp_path / "plant.journal"
    made = Journal(path)
    for event in EVENTS:
        made.event(event)
    made.close()
    return path


def said(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    assert main(["loop", "events", *words]) == 0
    return capsys.readouterr().out.splitlines()


def test_a_line_says_when_who_what_and_why(journal: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, str(journal)) == [
        "2026-03-01 00:00:00 UTC  change        loop  loop.toml: started in SHADOW",
        "2026-03-01 01:00:00 UTC  change        anna  mode SHADOW -> AUTO (handed over)",
        "2026-03-01 01:01:01 UTC  fault         loop  PV T: bad, and more",
        "2026-03-01 01:01:40 UTC  acknowledged  anna  acknowledged: PV T: bad (cleaned)",
    ]


def test_a_part_is_chosen_by_time_and_by_number(journal: Path, capsys: pytest.CaptureFixture[str]) -> None:
    every = [event.what for event in EVENTS]
    for words, first in ((["--last", "1"], 3), (["--last", "9"], 0), (["--since", "2026-03-01T01:00"], 1)):
        rows = list(csv.DictReader(io.StringIO("\n".join(said(capsys, str(journal), *words, "--csv")))))
        assert len(rows) == len(every) - first
    assert len(said(capsys, str(journal), "--since", "2026-03-01T02:01:10+01:00")) == 1
    assert said(capsys, str(journal), "--since", "2026-03-02") == ["nothing has happened there"]


def test_other_tools_get_columns(journal: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = list(csv.DictReader(io.StringIO("\n".join(said(capsys, str(journal), "--csv")))))
    assert list(rows[1].values()) == ["2026-03-01 01:00:00 UTC", "change", "anna", "mode SHADOW -> AUTO", "handed over"]
    assert rows[2]["what"] == "PV T: bad, and more"


def test_loop_toml_names_its_journal(
    journal: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(journal.parent)
    shutil.copy(Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr" / "pid.onnx", journal.parent)
    assert main(["loop", "init", "pid.onnx", "--out", "plant.toml"]) == 0
    capsys.readouterr()
    assert said(capsys, "plant.toml", "--last", "1") == said(capsys, "plant.journal", "--last", "1")


def test_a_mistake_is_one_line(journal: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, line in (
        (["--since", "yesterday"], "--since is 'yesterday'; write a date or a time, as 2026-03-01"),
        (["--last", "0"], "--last is 0; it must be 1 or more"),
    ):
        assert main(["loop", "events", str(journal), *words]) == 2
        assert line in capsys.readouterr().err
    assert main(["loop", "events", "nowhere.journal"]) == 2
    assert "nowhere.journal is not here" in capsys.readouterr().err
