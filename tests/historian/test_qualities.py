"""Qualities of readings: what their texts mean, and which columns hold them."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import TAGS, cells, clean, write

from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.files.quality import Reason, meaning_of

N = 60
NAMES = [t.tag for t in TAGS]


def rows() -> list[list[str]]:
    start = datetime(2024, 3, 4, 6)
    return [[(start + timedelta(seconds=6 * k)).isoformat(" "), *row[1:]] for k, row in enumerate(cells(clean(N)))]


QUALITIES = [
    ("quality", {"0": 90, "2147483648": 5, "1073741824": 5}, {"0"}),
    ("StatusCode", {"0x00000000": 90, "0x80000000": 5, "0x40000000": 5}, {"0x00000000"}),
    ("StatusCode", {"0x80000000": 90, "0x00000000": 10}, {"0x00000000"}),
    ("StatusCode", {"0": 3, "-2147483648": 90}, {"0"}),
    ("StatusCode", {"0": 3, "2150891520": 90, "9830400": 4}, {"0", "9830400"}),
    ("quality", {"192": 10, "0": 90, "216": 1, "64": 3}, {"192", "216"}),
    ("quality", {"0x000000C0": 10, "0x00000000": 90}, {"0x000000C0"}),
    ("quality", {"Good [0x00000000]": 1, "Bad [0x80000000]": 9}, {"Good [0x00000000]"}),
    ("quality", {"100": 9, "0": 1}, {"100"}),
    ("quality", {"true": 5, "false": 9}, {"true"}),
    ("TIC.PV IsGood", {"True": 5, "False": 9}, {"True"}),
    ("TIC.PV IsBad", {"True": 5, "False": 9}, {"False"}),
    ("TIC.PV_IsBad", {"1": 9, "0": 5}, {"0"}),
    ("Questionable", {"False": 3, "True": 90}, {"False"}),
    ("valid", {"1": 5, "0": 9}, {"1"}),
    ("status", {"True": 2, "False": 90}, {"False"}),
    ("quality", {"0": 90, "1": 5}, {"0"}),
    ("quality", {"1": 90, "0": 5}, {"1"}),
    ("quality", {"": 90, "Bad": 5}, {""}),
    ("Qualität", {"Gut": 5, "Schlecht": 9}, {"Gut"}),
    ("quality", {"0": 98, "133": 2}, {"0"}),
    ("quality", {"0": 98, "65": 2}, {"0"}),
    ("quality", {"128": 98, "0": 2}, {"128"}),
    ("quality", {"C0": 8, "00": 2}, {"C0"}),
    ("quality", {"N": 98, "B": 2}, {"N"}),
    ("quality", {"WAHR": 5, "FALSCH": 9}, {"WAHR"}),
    ("quality", {"Oui": 5, "Non": 9}, {"Oui"}),
    ("quality", {"Y": 5, "N": 9}, {"Y"}),
    ("quality", {"-": 98, "*": 2}, {"-"}),
    ("status", {"Run": 98, "Bad Input": 2}, {"Run"}),
    ("TIC.PV.CONF", {"100": 98, "0": 2}, {"100"}),
    ("TIC.PV fault", {"0": 5, "1": 9}, {"0"}),
]  # fmt: skip


@pytest.mark.parametrize(("column", "counts", "good"), QUALITIES)
def test_which_qualities_are_good(column: str, counts: dict[str, int], good: set[str]) -> None:
    assert meaning_of(column, counts).good == good


def test_words_that_say_nothing_of_quality() -> None:
    assert meaning_of("status", {"RUN": 3, "STOP": 4}).good is None
    assert meaning_of("Pump Status", {"0": 3, "1": 4}).good is None  # a state: no value has most rows
    assert meaning_of("Tank Status", {"200": 3, "300": 4}).good is None
    assert meaning_of("quality", {"95": 3, "96": 4, "100": 1}).good is None


@pytest.mark.parametrize(
    ("header", "flags", "bad"),
    [
        ("TIC-101.PV Quality", ("Good", "Bad"), True),
        ("TIC-101.PV.StatusCode", ("0", "2147483648"), True),
        ("TIC-101.PV_IsBad", ("False", "True"), True),
        ("TIC-101.PV IsGood", ("True", "False"), True),
        ("Quality", ("0x00000000", "0x80000000"), True),
        ("TIC-101.PV.Status", ("RUN", "STOP"), False),
        ("TIC-101.PV q", ("17.5", "18.5"), False),
    ],
)
def test_columns_of_quality(header: str, flags: tuple[str, str], bad: bool, tmp_path: Path) -> None:
    own = [[*row[:2], flags[k % 7 == 3], *row[2:]] for k, row in enumerate(rows())]
    export = read_export([write(tmp_path / "x.csv", own, ("time", NAMES[0], header, *NAMES[1:]))], NAMES)
    lost = np.flatnonzero(export.series[NAMES[0]].code == Reason.QUALITY)
    np.testing.assert_array_equal(lost, np.arange(3, N, 7) if bad else [])
    assert export.series[NAMES[1]].good.all() == (header != "Quality")


LONE: list[tuple[str, Callable[[int], object]]] = [
    ("Q", lambda k: 180 + k % 50), ("Q", lambda k: 192 if k < 300 else 200), ("Q", lambda k: 575 + k % 420),
    ("Good", lambda k: 5 + k % 30), ("Bad", lambda k: k % 5), ("Status", lambda k: 200 if k % 2 else 300),
    ("Status", lambda k: 512 + k % 2), ("Quality", lambda k: 90 + k % 10), ("Valid", lambda k: k % 101),
    ("Status", lambda k: ["Run", "Stop", "Error"][k % 3]),
]  # fmt: skip


@pytest.mark.parametrize(("header", "cell"), LONE)
def test_a_tag_with_the_name_of_a_quality_costs_no_row(
    header: str, cell: Callable[[int], object], tmp_path: Path
) -> None:
    data = clean(400)
    own = [[*row, str(cell(k))] for k, row in enumerate(cells(data))]
    series = read_export([write(tmp_path / "x.csv", own, ("timestamp", *NAMES, header))]).series
    assert all(series[n].good.all() for n in NAMES)
    assert header in series


FLAGS = ("Status", ("Good", "Good")), ("Questionable", ("False", "True"))


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("layout", ["wide", "long"])
def test_a_reading_is_good_if_all_its_qualities_say_so(layout: str, way: int, tmp_path: Path) -> None:
    names, flags = zip(*FLAGS[::way], strict=True)
    own = [[*r[:2], *(f[k % 7 == 3] for f in flags), *r[2:]] for k, r in enumerate(rows())]
    header = ("time", NAMES[0], *(f"{NAMES[0]}.{n}" for n in names), *NAMES[1:])
    if layout == "long":
        own = [[tag, row[0], v, *row[2:4]] for row in own for tag, v in zip(NAMES[:2], row[1:], strict=False)]
        header = ("tag", "time", "value", *names)
    export = read_export([write(tmp_path / "x.csv", own, header)], NAMES[:1])
    assert export.layout == layout
    np.testing.assert_array_equal(np.flatnonzero(~export.series[NAMES[0]].good), np.arange(3, N, 7))


def test_a_quality_that_cannot_be_told_and_one_that_calls_all_bad_are_noted(tmp_path: Path) -> None:
    header = ("time", NAMES[0], f"{NAMES[0]}.Status", *NAMES[1:], f"{NAMES[1]} Quality")
    own = [[*r[:2], "RUN" if k % 2 else "STOP", *r[2:], "Bad"] for k, r in enumerate(rows())]
    export = read_export([write(tmp_path / "x.csv", own, header)])
    assert {n.column for n in export.notes} == {header[2], header[-1]}
    assert export.series[header[2]].tag == header[2]
    assert not export.series[NAMES[1]].good.any()


@pytest.mark.parametrize("header", ["TIC-101.PV Status", "TIC-101.PV Quality", "Status", "Quality"])
def test_a_quality_that_is_bad_far_below_only(header: str, tmp_path: Path) -> None:
    data = clean(900)
    own = [[*row, "2147483648" if k > 700 else "0"] for k, row in enumerate(cells(data))]
    series = read_export([write(tmp_path / "x.csv", own, ("timestamp", *NAMES, header))], NAMES).series[NAMES[0]]
    np.testing.assert_array_equal(np.flatnonzero(~series.good), np.arange(701, 900))


@pytest.mark.parametrize("word", ["Status", "Qualité"])
def test_a_quality_beside_every_tag_under_one_name(word: str, tmp_path: Path) -> None:
    own = [[r[0], r[1], "Good", r[2], "Bad" if k == 5 else "Good", r[3], "Good"] for k, r in enumerate(rows())]
    header = ("time", NAMES[0], word, NAMES[1], word, NAMES[2], word)
    export = read_export([write(tmp_path / "x.csv", own, header)], NAMES)
    assert [int((~export.series[n].good).sum()) for n in NAMES] == [0, 1, 0]


def test_the_state_of_a_pump_is_no_quality_of_readings(tmp_path: Path) -> None:
    own = [[t, r[0], v, str(int(k % 10 == 0))]
           for k, r in enumerate(rows()) for t, v in zip(NAMES, r[1:], strict=True)]  # fmt: skip
    series = read_export([write(tmp_path / "x.csv", own, ("Tag", "Time", "Value", "Pump Status"))]).series
    assert all(series[name].good.all() for name in NAMES)
