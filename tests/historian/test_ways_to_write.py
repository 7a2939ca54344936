"""Ways in which programs write headers, layouts and files: each is read as what it says, or refused."""

from __future__ import annotations

import csv
import gzip
import io
import zipfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dirty_plant import TAGS, cells, clean, write

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.tags import parse_tag
from loopwright.pipeline.historian.files.file_reader import read_export, tags_in, units_of

N = 60
DATA = clean(N)
NAMES = [t.tag for t in TAGS]
START = datetime(2024, 3, 4, 6)
STAMPS = [(START + timedelta(seconds=6 * k)).isoformat(" ") for k in range(N)]


def check(path: Path, names: Sequence[str] = NAMES, **options: str) -> None:
    """The file holds the three tags of the clean plant."""
    export = read_export([path], names, **options)
    for name, values in zip(names, (DATA.pv, DATA.mv, DATA.dv), strict=True):
        assert export.series[name].counts() == {"good": N}, export.series[name].texts
        np.testing.assert_allclose(export.series[name].value, values)
        np.testing.assert_allclose(export.series[name].time_s, DATA.time_s, atol=1e-3)


def rows() -> list[list[str]]:
    return [[stamp, *row[1:]] for stamp, row in zip(STAMPS, cells(DATA), strict=True)]


# ---------------------------------------------------------------------- headers and layouts
def text(header: Sequence[str], sep: str = ";", end: str = "", above: Sequence[str] = (), below: str = "") -> str:
    out = io.StringIO()
    table = csv.writer(out, delimiter=sep, lineterminator=end + "\n")
    table.writerow(header)
    if below:
        out.write(below + "\n")
    table.writerows(rows())
    return "".join(f"{line}\n" for line in above) + out.getvalue()


HEADER = ("Time", *NAMES)
NUMBERED = ("Time", "101", "102", "103")
HEADS = {
    "titles filled up with separators": (text(HEADER, above=["Report of unit 7;;;", ";;;", "Made by;hand;;"]), NAMES),
    "titles with dates": (text(HEADER, above=["From;2024-03-04 06:00;To;2024-03-05 06:00"]), NAMES),
    "a title that is dated": (text(HEADER, above=["Report of unit 7;;;", "Exported 12.03.2025;;;"]), NAMES),
    "a dated title alone": (text(HEADER, above=["Exported 12.03.2025;;;"]), NAMES),
    "titles and units": (text(HEADER, above=["Report;;;"], below=";degC;%;kg/h"), NAMES),
    "descriptions and units": (
        text(HEADER, below="Description;reactor temperature;fuel;feed\nUnit;degC;%;kg/h"),
        NAMES,
    ),
    "rows end with a separator": (text(HEADER, end=";"), NAMES),
    "rows alone end with a separator": (text(HEADER, end=";").replace("FI-7;\n", "FI-7\n", 1), NAMES),
    "the header alone ends with a separator": (text(HEADER).replace("FI-7\n", "FI-7;\n", 1), NAMES),
    "a line of Excel": (text(HEADER, above=["sep=;"]), NAMES),
    "tags are numbers": (text(NUMBERED), NUMBERED[1:]),
    "tags are numbers below a title": (text(NUMBERED, above=["Report;;;"]), NUMBERED[1:]),
    "line break in a quoted name": (text(("Time", "TIC-101\n.PV", *NAMES[1:])), ["TIC-101 .PV", *NAMES[1:]]),
    "an inch in a title": (text(HEADER, above=['valve of 5" size;;;']), NAMES),
    "inches in a title and in the header": (
        text(("Time", *NAMES), above=['valve of 5" size;;;']).replace("FI-7", '3" FI-7'),
        [*NAMES[:2], '3" FI-7'],
    ),
    "comma separated": (text(HEADER, ",", end=",", above=["Report,,,,"]), NAMES),
    "tabs": (text(HEADER, "\t", above=["Report\t\t\t"]), NAMES),
    "no-break blanks in names": (text(("Time", "TIC-101.PV\u00a0[degC]", *NAMES[1:])), NAMES),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("name", HEADS)
def test_heads_of_tables(name: str, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(HEADS[name][0].encode(encoding))
    check(path, HEADS[name][1])
    if "units" in name:
        assert units_of([path]) == dict(zip(NAMES, ("degC", "%", "kg/h"), strict=True))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("Time;a;b\n0;1;2;3\n1;2;3;4\n2;2;3;4\n", "names 3 columns and the rows have 4"),
        ("Time,a\n0,1,5\n1,2,5\n2,3,5\n", "names 2 columns and the rows have 3"),
        ("0;1;2\n1;2;3\n2;3;4\n", "names the 3 columns; write a header there"),
    ],
)
def test_a_header_that_does_not_fit_is_named(content: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(content)
    with pytest.raises(RecordError, match=says):
        read_export([path])


LONG = [
    ("TagName", "Timestamp", "Value", "Quality"), ("Point", "Date", "Reading", "Status"),
    ("variable", "datetime", "val", "qual"), ("Messstelle", "Zeitstempel", "Wert", "Qualität"),
    ("NodeId", "SourceTimestamp", "Value", "StatusCode"), ("Bezeichnung", "Zeit", "Messwert", "Status"),
    ("what", "when", "how much", "Status"), ("Sensor ID", "Logged at", "Value (SI)", "IsGood"),
    ("VarName", "TimeString", "VarValue", "Validity"), ("tagpath", "t_stamp", "floatvalue", "dataintegrity"),
]  # fmt: skip


@pytest.mark.parametrize("names", LONG)
def test_a_row_a_reading_under_many_names(names: tuple[str, ...], tmp_path: Path) -> None:
    good = {"StatusCode": "0x00000000", "IsGood": "True", "Validity": "1", "dataintegrity": "192"}.get(names[3], "Good")
    own = [[tag, row[0], value, good] for row in rows() for tag, value in zip(NAMES, row[1:], strict=True)]
    path = write(tmp_path / "x.csv", own, names)
    check(path)
    assert read_export([path]).layout == "long"
    assert set(NAMES) <= tags_in([path])


@pytest.mark.parametrize("header", [("Loop", "Time", "X", "RowNo"), ("Messpunkt", "Zeit", "Wert", "Unit")])
def test_a_number_of_the_row_and_a_unit_beside_a_reading(header: tuple[str, ...], tmp_path: Path) -> None:
    units = dict(zip(NAMES, ("degC", "%", "kg/h"), strict=True))
    own = [[t, r[0], v, units[t] if header[3] == "Unit" else str(k)]
           for k, r in enumerate(rows()) for t, v in zip(NAMES, r[1:], strict=True)]  # fmt: skip
    path = write(tmp_path / "x.csv", own, header)
    check(path)
    assert units_of([path]) == (units if header[3] == "Unit" else {})


@pytest.mark.parametrize("header", [("Loop", "Time", "X"), ("Path", "Time", "Reading")])
def test_a_file_sorted_by_tag(header: tuple[str, ...], tmp_path: Path) -> None:
    data = clean(700)
    table = cells(data)
    own = [[t, r[0], r[j]] for j, t in enumerate(NAMES, 1) for r in table]
    export = read_export([write(tmp_path / "x.csv", own, header)])
    for name, values in zip(NAMES, (data.pv, data.mv, data.dv), strict=True):
        np.testing.assert_allclose(export.series[name].value, values)


def test_tags_that_are_numbers_in_rows_of_readings(tmp_path: Path) -> None:
    own = [[t, row[0], v] for row in rows() for t, v in zip(("101", "102", "103"), row[1:], strict=True)]
    check(write(tmp_path / "x.csv", own, ("TagID", "Time", "Value")), ["101", "102", "103"])


def test_a_label_beside_an_mv_that_rests_is_not_taken_for_a_tag(tmp_path: Path) -> None:
    own = [[r[0], r[1], "50", f"batch {k // 20}"] for k, r in enumerate(rows())]
    export = read_export([write(tmp_path / "x.csv", own, ("time", "PV", "OP", "name"))])
    assert (export.layout, {*export.series}) == ("wide", {"PV", "OP", "name"})


@pytest.mark.parametrize("extra", ["MODE", "name", "id"])
def test_a_column_a_tag_is_not_taken_for_rows_of_readings(extra: str, tmp_path: Path) -> None:
    cell = {"MODE": lambda k: "AUTO" if k < 30 else "MAN", "name": lambda _: "unit 7", "id": str}[extra]
    own = [[*row, cell(k)] for k, row in enumerate(rows())]
    check(write(tmp_path / "x.csv", own, ("time", *NAMES, extra)))


BRACKETED = ["Unit/TIC[1].PV", "Unit/TIC[1]", "Unit/TIC[2]"]


@pytest.mark.parametrize(
    ("option", "tag", "unit", "low"),
    [
        ("Unit/TIC[1].PV[degC]=0..120", BRACKETED[0], "degC", 0.0),
        ("Unit/TIC[1].PV", BRACKETED[0], "", None),
        ("Unit/TIC[1]", BRACKETED[1], "", None),
        ("Unit/TIC[2][%]=-5..100", BRACKETED[2], "%", -5.0),
        ("Unit/TIC[2]=0..1", BRACKETED[2], "", 0.0),
        ("TIC.PV[degC]=0..120", "TIC.PV", "degC", 0.0),
        ("ns=2;s=TIC.PV[degC]=0..120", "ns=2;s=TIC.PV", "degC", 0.0),
        ("FI=3..4", "FI=3..4", "", None),
    ],
)
def test_tags_with_brackets_and_slashes(option: str, tag: str, unit: str, low: float | None, tmp_path: Path) -> None:
    own = [[*row, "1"] for row in rows()]
    path = write(tmp_path / "x.csv", own, ("time", "Unit/TIC[1].PV [degC]", *BRACKETED[1:], "FI=3..4"))
    found = parse_tag(option, "pv", lambda: tags_in([path]))
    assert (found.tag, found.unit, found.low) == (tag, unit, low)
    check(path, BRACKETED)


def test_columns_that_differ_in_their_brackets_alone_stay_apart(tmp_path: Path) -> None:
    names = ["TIC [degC]", "TIC [%]", "FI-7"]
    path = write(tmp_path / "x.csv", rows(), ("time", *names))
    check(path, names)
    assert parse_tag("TIC [%]", "mv", lambda: tags_in([path])).tag == "TIC [%]"


# ---------------------------------------------------------------------- files
def workbook(path: Path, header: Sequence[object], content: Sequence[Sequence[object]], above: int = 0) -> Path:
    book = openpyxl.Workbook()
    notes = book.active
    notes.title = "Notes"
    notes.append(["Report of unit 7"])
    sheet = book.create_sheet("Data")
    for _ in range(above):
        sheet.append(["Report"])
    sheet.append(list(header))
    for row in content:
        sheet.append(list(row))
    book.save(path)
    return path


@pytest.mark.parametrize("kind", ["dates", "texts", "serial", "day and hour", "minutes", "titles"])
def test_workbooks(kind: str, tmp_path: Path) -> None:
    times = [START + timedelta(seconds=6 * k) for k in range(N)]
    stamps: dict[str, list[list[object]]] = {
        "texts": [[s] for s in STAMPS],
        "serial": [[25_569 + t.replace(tzinfo=UTC).timestamp() / 86_400] for t in times],
        "day and hour": [[datetime(t.year, t.month, t.day), t.time()] for t in times],
        "minutes": [[0.1 * k] for k in range(N)],
    }
    own = [
        [*stamp, *map(float, row)]
        for stamp, row in zip(stamps.get(kind, [[t] for t in times]), zip(DATA.pv, DATA.mv, DATA.dv, strict=True),
                              strict=True)
    ]  # fmt: skip
    first = {"day and hour": ["Date", "Time"], "minutes": ["Time (min)"]}.get(kind, ["Time"])
    path = workbook(tmp_path / "x.xlsx", [*first, *NAMES], own, above=3 if kind == "titles" else 0)
    if kind == "minutes":
        found = read_export([path], NAMES).series[NAMES[0]]
        np.testing.assert_allclose(found.time_s, 6.0 * np.arange(N))
        np.testing.assert_allclose(found.value, DATA.pv)
    else:
        check(path)


@pytest.mark.parametrize("kind", ["xlsx", "parquet"])
def test_texts_with_a_decimal_comma_in_typed_cells(kind: str, tmp_path: Path) -> None:
    values = [f"{60 + k / 1000:.3f}".replace(".", ",") for k in range(N)]
    path = tmp_path / f"x.{kind}"
    if kind == "xlsx":
        workbook(path, ["Time", "a"], list(zip(map(datetime.fromisoformat, STAMPS), values, strict=True)))
    else:
        pq.write_table(pa.table({"Time": STAMPS, "a": values}), path)
    np.testing.assert_allclose(read_export([path]).series["a"].value, 60 + np.arange(N) / 1000)


def test_texts_in_a_workbook_are_counted(tmp_path: Path) -> None:
    own = [[START + timedelta(seconds=6 * k), "Bad" if k == 9 else k / 4, None if k == 4 else k] for k in range(N)]
    export = read_export([workbook(tmp_path / "x.xlsx", ["Time", "a [degC]", "b"], own)])
    assert export.series["a"].counts() == {"good": N - 1, "text": 1}
    assert export.series["b"].counts() == {"good": N - 1, "empty": 1}
    assert units_of([tmp_path / "x.xlsx"]) == {"a": "degC"}


def zipped(names: Sequence[str], content: bytes = b"x") -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name in names:
            archive.writestr(name, content)
    return out.getvalue()


KINDS = [
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600), "an old Excel workbook"),
    (b"%PDF-1.7\n" + bytes(600), "a PDF"),
    (zipped(["mimetype"], b"application/vnd.oasis.opendocument.spreadsheet"), "an OpenDocument file"),
    (zipped(["a.csv", "b.csv"]), r"a zip archive of 2 files \(a.csv, b.csv\)"),
    (zipped(["xl/workbook.bin"]), "a binary Excel workbook"),
    (zipped(["xl/workbook.xml"]), "cannot be read as a workbook"),
    (zipped(["xl/workbook.xml"])[:60], "cut off"),
    (b"<!DOCTYPE html><html><body><table>", "a web page"),
    (b"\xef\xbb\xbf<?xml version='1.0'?>", "an XML file"),
    (b'[{"time": 1, "a": 2}]', "a JSON file"),
    (b"SQLite format 3\x00" + bytes(600), "an SQLite database"),
    (b"\x89HDF\r\n\x1a\n" + bytes(600), "an HDF5 file"),
    (b"MATLAB 5.0 MAT-file, Platform" + bytes(600), "a MATLAB file"),
    (gzip.compress(b"PAR1" + bytes(600)), "a Parquet file, gzipped; unpack it"),
    (gzip.compress(zipped(["xl/workbook.xml"])), "gzipped; unpack it"),
]


@pytest.mark.parametrize(("content", "says"), KINDS, ids=[says for _, says in KINDS])
@pytest.mark.parametrize("suffix", [".csv", ".xlsx"])
def test_other_files_are_named_for_what_they_are(content: bytes, says: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"x{suffix}"
    path.write_bytes(content)
    with pytest.raises(RecordError, match=says) as error:
        read_export([path])
    assert "\n" not in str(error.value)


def test_files_under_a_wrong_suffix_are_read(tmp_path: Path) -> None:
    table = pa.table({"time": DATA.time_s, **dict(zip(NAMES, (DATA.pv, DATA.mv, DATA.dv), strict=True))})
    pq.write_table(table, tmp_path / "parquet.csv")
    check(tmp_path / "parquet.csv")
    (tmp_path / "gzip.txt").write_bytes(gzip.compress(text(HEADER).encode()))
    check(tmp_path / "gzip.txt")
    (tmp_path / "text.xlsx").write_text(text(HEADER))
    check(tmp_path / "text.xlsx")
