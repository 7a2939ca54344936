"""Courses in CSV files: times in seconds or as dates, empty cells, and what is wrong where."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from loopwright.serving import LoopError
from loopwright.serving.preview.course_file import read_courses

NOW = datetime(2026, 3, 1, 14, 0, tzinfo=UTC).timestamp()


def written(folder: Path, text: str) -> Path:
    path = folder / "course.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_column_is_a_signal_and_an_empty_cell_no_point(tmp_path: Path) -> None:
    found = read_courses(written(tmp_path, "time,TIC-1,FI-7\n0,50,\n600,60,10\n\n900,,12.5\n"), NOW)
    assert found == {"TIC-1": [(0.0, 50.0), (600.0, 60.0)], "FI-7": [(600.0, 10.0), (900.0, 12.5)]}


def test_dates_count_from_now(tmp_path: Path) -> None:
    text = "\ufefftime_s, TIC-1\n2026-03-01T14:30, 50\n2026-03-01 16:00+01:00, 60\n"
    assert read_courses(written(tmp_path, text), NOW) == {"TIC-1": [(1800.0, 50.0), (3600.0, 60.0)]}


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "first line"),
        ("TIC-1,time\n1,2\n", "first line"),
        ("time\n1\n", "first line"),
        ("time,a,a\n1,2,3\n", "twice"),
        ("time,a\nsoon,2\n", "line 2"),
        ("time,a\nnan,2\n", "line 2"),
        ("time,a\n1,2\n2,high\n", "line 3: a"),
        ("time,a\n1,inf\n", "line 2: a"),
        ("time,a\n1,2,3\n", "3 cells"),
        ("time,a,b\n1,2,\n", "no value of b"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, text: str, word: str) -> None:
    with pytest.raises(LoopError, match=word) as error:
        read_courses(written(tmp_path, text), NOW)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(LoopError, match="cannot be read"):
        read_courses(tmp_path / "none.csv", NOW)
    (tmp_path / "picture.csv").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(LoopError, match="CSV"):
        read_courses(tmp_path / "picture.csv", NOW)
