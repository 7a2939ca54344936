"""What is wrong with files and options is said with its cause: modes, a tag that a file lacks, the hold."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import pytest
from dirty_plant import TAGS, cells, clean, screen, screen_of, write

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.tags import Tag, named, write_tags
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.guessing import guesses
from loopwright.pipeline.historian.screening import Screened, screen_export

HEADER = ("timestamp", *(t.tag for t in TAGS))
MODES = (Tag("A.MODE", "mode"), Tag("B.MODE", "mode"))


def with_modes(folder: Path, modes: Sequence[Tag], without: str) -> Screened:
    rows = [[*row, "AUTO" if k < 700 else "MAN", "CAS"] for k, row in enumerate(cells(clean()))]
    path = write(folder / "x.csv", rows, (*HEADER, "A.MODE", "B.MODE"))
    return screen(path, (*TAGS, *modes), without_modes=[without])


def test_a_mode_without_a_tag_of_modes_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="--without-mode AUTO: no tag has the role mode; name the tag"):
        screen_of(clean(), tmp_path, without_modes=["AUTO"])


def test_a_mode_that_no_tag_has_is_an_error_that_names_the_known_ones(tmp_path: Path) -> None:
    known = "--without-mode OFF: A.MODE has the modes AUTO, MAN; B.MODE has the modes CAS"
    with pytest.raises(RecordError, match=known):
        with_modes(tmp_path, MODES, "OFF")
    assert with_modes(tmp_path, MODES, "AUTO").report.dropped_rows == {"mode": 700}


def test_modes_that_leave_nothing_are_the_cause(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="mode that was asked to be left out; leave fewer modes out"):
        with_modes(tmp_path, MODES, "CAS")


def test_a_hold_shorter_than_the_steps_is_the_cause(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"the hold of 0\.001 s is shorter .* readings, 6 s, .* a longer --hold"):
        screen_of(clean(), tmp_path, hold_s=0.001)


def test_a_tag_that_one_file_lacks_is_named_with_the_file(tmp_path: Path) -> None:
    rows = cells(clean())
    paths = [write(tmp_path / "p1.csv", rows[:900], HEADER)]
    paths += [write(tmp_path / "p2.csv", [row[:-1] for row in rows[900:]], HEADER[:-1])]
    found = screen_export("plant", read_export(paths, [t.tag for t in TAGS]), named(TAGS))
    (lacking,) = (f for f in found.report.findings if f.kind == "lacking")
    assert lacking.tag == "FI-7"
    assert lacking.words == f"{tmp_path / 'p2.csv'} has no FI-7: its 600 rows are left out"
    assert lacking.drops


def test_files_of_other_tags_at_the_same_time_lack_nothing(tmp_path: Path) -> None:
    rows = cells(clean())
    paths = [write(tmp_path / f"{i}.csv", [[r[0], r[i]] for r in rows], (HEADER[0], HEADER[i])) for i in (1, 2, 3)]
    found = screen_export("plant", read_export(paths, [t.tag for t in TAGS]), named(TAGS))
    assert found.report.findings == ()


def test_the_table_of_tags_has_the_smallest_difference_and_the_share_of_modes(tmp_path: Path) -> None:
    rows = [[*row, "AUTO" if k < 700 else "MAN"] for k, row in enumerate(cells(clean()))]
    path = write(tmp_path / "x.csv", rows, (*HEADER, "A.MODE"))
    found = {g.tag.tag: g for g in guesses(read_export([path]), {})}
    assert [found[name].step for name in HEADER[1:]] == [0.001, 0.1, 0.01]
    assert (found["A.MODE"].step, found["A.MODE"].good) == (0.0, 1.0)
    write_tags(tmp_path / "tags.csv", found.values())
    table = list(csv.DictReader((tmp_path / "tags.csv").read_text().splitlines()))
    row = {column: value for column, value in table[-1].items() if value and column != "remark"}
    assert row == {"tag": "A.MODE", "role": "mode", "name": "A.MODE", "loop": "A", "good_percent": "100.00"}
