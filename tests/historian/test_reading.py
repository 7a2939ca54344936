"""The same readings come out of every way to write them."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dirty_plant import START_S, TAGS, cells, clean, write
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.dialect import sniff
from loopwright.pipeline.historian.files.file_reader import read_export, units_of
from loopwright.pipeline.historian.files.numbers import numbers
from loopwright.pipeline.historian.files.quality import Reason

N = 60
DATA = clean(N)
NAMES = [t.tag for t in TAGS]
HEADER = ("timestamp", *NAMES)


def text(sep: str = ",", decimal: str = ".", stamp: Callable[[float], str] = "{:.0f}".format) -> str:
    rows = [[stamp(float(row[0])), *(c.replace(".", decimal) for c in row[1:])] for row in cells(DATA)]
    return "\n".join(sep.join(row) for row in [HEADER, *rows]) + "\n"


def check(*paths: Path, time_s: np.ndarray = DATA.time_s, **options: str) -> None:
    export = read_export(paths, NAMES, **options)
    for name, values in zip(NAMES, (DATA.pv, DATA.mv, DATA.dv), strict=True):
        series = export.series[name]
        assert series.good.all()
        np.testing.assert_allclose(series.value, values)
        np.testing.assert_allclose(series.time_s, time_s, atol=1e-3)
    assert export.rows == N


def utc(form: str) -> Callable[[float], str]:
    return lambda t: pd.Timestamp(t, unit="s").strftime(form)


STAMPS: dict[str, Callable[[float], str]] = {
    "epoch s": "{:.0f}".format,
    "epoch s with parts": "{:.3f}".format,
    "epoch ms": lambda t: f"{1000 * t:.0f}",
    "epoch us": lambda t: f"{1e6 * t:.0f}",
    "ISO": utc("%Y-%m-%dT%H:%M:%S"),
    "ISO with blanks": utc("%Y-%m-%d %H:%M:%S"),
    "ISO with milliseconds": lambda t: utc("%Y-%m-%d %H:%M:%S")(t) + ".000",
    "ISO with Z": utc("%Y-%m-%dT%H:%M:%SZ"),
    "ISO with a zone": lambda t: utc("%Y-%m-%dT%H:%M:%S+02:00")(t + 7200),
    "ISO with a zone of minutes": lambda t: utc("%Y-%m-%dT%H:%M:%S-03:30")(t - 12600),
    "German": utc("%d.%m.%Y %H:%M:%S"),
    "PI": utc("%d-%b-%y %H:%M:%S"),
    "PI with milliseconds": lambda t: utc("%d-%b-%y %H:%M:%S")(t) + ".000",
}


@pytest.mark.parametrize("name", STAMPS)
def test_times(name: str, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text(stamp=STAMPS[name]))
    check(path)


def test_seconds_since_the_start_and_minutes(tmp_path: Path) -> None:
    for unit, scale in (("time_s", 1.0), ("time [min]", 60.0), ("t_ms", 1e-3)):
        path = tmp_path / "x.csv"
        path.write_text(text(stamp=lambda t, s=scale: f"{(t - START_S) / s:.9g}").replace("timestamp", unit, 1))
        check(path, time_s=DATA.time_s - START_S)


def test_a_date_whose_day_is_unclear_is_refused_and_a_format_helps(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text(stamp=utc("%m/%d/%Y %H:%M:%S")))
    with pytest.raises(RecordError, match=r"may be month/day or day/month; give --time-format"):
        read_export([path], NAMES)
    check(path, time_format="%m/%d/%Y %H:%M:%S")


def test_what_is_no_date_names_no_form(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text(stamp=lambda t: "13/13/2024 10:00"))
    with pytest.raises(RecordError) as refused:
        read_export([path], NAMES)
    assert "%" not in str(refused.value)


@pytest.mark.parametrize("form", ["%m/%d/%Y %I:%M:%S %p", "%d/%m/%y %H:%M:%S", "%m-%d-%Y %H:%M"])
def test_one_of_the_forms_that_a_refusal_names_is_right(form: str, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    minute = {t: START_S + 60.0 * k for k, t in enumerate(DATA.time_s)}
    path.write_text(text(stamp=lambda t: utc(form)(minute[t])))
    with pytest.raises(RecordError) as refused:
        read_export([path], NAMES)
    named = re.findall(r"'(%[^']+)'", str(refused.value))
    assert form in named
    check(path, time_s=np.array([*minute.values()]), time_format=form)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1"])
@pytest.mark.parametrize(("sep", "decimal"), [(",", "."), (";", ","), (";", "."), ("\t", ","), ("|", ".")])
def test_dialects(encoding: str, sep: str, decimal: str, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    content = text(sep, decimal, STAMPS["ISO"]).replace(NAMES[2], "Dämpfe [kg/h]")
    path.write_bytes(content.encode(encoding))
    export = read_export([path], [*NAMES[:2], "Dämpfe"])
    np.testing.assert_allclose(export.series["Dämpfe"].value, DATA.dv)
    np.testing.assert_allclose(export.series[NAMES[0]].value, DATA.pv)
    assert units_of([path]) == {"Dämpfe": "kg/h"}


def test_a_letter_of_another_encoding_far_below(tmp_path: Path) -> None:
    rows = [[f"{START_S + 10 * k:.0f}", "1.5", "ok" * 12] for k in range(8000)] + [["1800000000", "2.5", "Störung"]]
    path = tmp_path / "x.csv"
    path.write_bytes("\n".join(map(",".join, [("time", "a", "Text"), *rows])).encode("cp1252"))
    export = read_export([path])
    assert export.rows == 8001
    assert export.series["Text"].texts["Störung"] == 1
    assert export.series["a"].good.all()


def test_crlf_preamble_units_quotes_and_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    lines = text().splitlines()
    lines = ['"Report of unit 7"', "", "made by hand", lines[0], ",degC,%,kg/h", *lines[1:], "", ""]
    path.write_bytes("\r\n".join(lines).encode())
    check(path)
    assert units_of([path]) == dict(zip(NAMES, ("degC", "%", "kg/h"), strict=True))


def test_gzip_parquet_and_several_files(tmp_path: Path) -> None:
    packed = tmp_path / "x.csv.gz"
    packed.write_bytes(gzip.compress(text().encode()))
    check(packed)
    columns = {NAMES[0]: DATA.pv, NAMES[1]: DATA.mv, NAMES[2]: DATA.dv}
    stamps = pa.array((DATA.time_s * 1e6).astype(np.int64)).cast(pa.timestamp("us", "Europe/Berlin"))
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({"time": stamps, **columns}), path)
    check(path)
    rows = cells(DATA)
    later = write(tmp_path / "b.csv", rows[25:])
    first = write(tmp_path / "a.csv", rows[:25])
    check(later, first)
    one = write(tmp_path / "one.csv", [row[:2] for row in rows], HEADER[:2])
    rest = write(tmp_path / "rest.csv", [[row[0], *row[2:]] for row in rows], (HEADER[0], *HEADER[2:]))
    export = read_export([one, rest], NAMES)
    np.testing.assert_allclose(export.series[NAMES[2]].value, DATA.dv)


@pytest.mark.parametrize("quality", [("Good", "Bad"), ("192", "0"), ("0", "1")])
def test_long_format(quality: tuple[str, str], tmp_path: Path) -> None:
    rows = []
    for k, row in enumerate(cells(DATA)):
        rows += [[name, row[0], value, quality[k == 7]] for name, value in zip(NAMES, row[1:], strict=True)]
    path = write(tmp_path / "x.csv", rows, ("tag", "time", "value", "quality"))
    export = read_export([path], NAMES)
    assert export.layout == "long"
    for name, values in zip(NAMES, (DATA.pv, DATA.mv, DATA.dv), strict=True):
        np.testing.assert_allclose(export.series[name].value, values)
        assert export.series[name].counts() == {"good": N - 1, "quality": 1}
    assert set(read_export([path]).series) == set(NAMES)


def test_thousands(tmp_path: Path) -> None:
    for column, decimal, expected in (
        (["1.234,5", "12,25", "-3"], ",", [1234.5, 12.25, -3]),
        (["1,234.5", "12.25", "+3e1"], ".", [1234.5, 12.25, 30]),
    ):
        values, codes, texts = numbers(pa.array(column), decimal)
        np.testing.assert_allclose(values, expected)
        assert not codes.any()
        assert not texts
    _, codes, _ = numbers(pa.array(["45.2", "1,5"]), ",")  # either 45.2 or 452: neither is guessed
    assert codes.tolist() == [Reason.TEXT, Reason.GOOD]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.one_of(st.floats(allow_nan=False, allow_infinity=False, width=32), st.text(max_size=6)), min_size=1))
def test_every_cell_is_a_number_or_has_a_reason(content: list[float | str]) -> None:
    column = pa.array([repr(float(c)) if isinstance(c, float) else c for c in content])
    values, codes, texts = numbers(column)
    assert np.array_equal(np.isfinite(values), codes == Reason.GOOD)
    assert sum(texts.values()) == np.count_nonzero(codes == Reason.TEXT)
    for cell, value in zip(content, values, strict=True):
        if isinstance(cell, float):
            assert value == cell


def test_a_clock_set_back_is_ambiguous_not_mixed(tmp_path: Path) -> None:
    local = DATA.time_s.copy()
    n = 1200
    data = clean(n)
    local = data.time_s - np.where(np.arange(n) >= 700, 3600.0, 0.0)
    export = read_export([write(tmp_path / "x.csv", cells(data.with_(time_s=local)))], NAMES)
    counts = export.series[NAMES[0]].counts()
    assert counts["clock"] == 1000  # of 500 in the second pass, and of as many in the first
    assert sum(counts.values()) == n


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "the file is empty"),
        (b"\n\n\n", "the file is empty"),
        (b"timestamp\n1\n2\n", "no table was found"),
        (b"1,2,3\n4,5,6\n7,8,9\n", "no table was found"),
        (b"timestamp,TIC-101.PV,TIC-101.OP,FI-7\n", "there is one line and no row below it; export a longer time"),
        (b"a,b,c\nx,1,2\ny,3,4\nz,5,6\n", "no column holds times"),
        (b"timestamp,a,a\n1700000000,1,2\n1700000001,1,2\n", "stands twice in the header"),
        (b"timestamp,TIC-101.PW\n1700000000,1\n1700000001,2\n", "no tag 'TIC-101.PV'; did you mean 'TIC-101.PW'"),
        (bytes(range(256)) * 20, ""),
        (b"PAR1 this is no parquet", ""),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".csv.gz"])
def test_no_table_is_one_line(content: bytes, says: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"x{suffix}"
    path.write_bytes(content)
    with pytest.raises(RecordError) as error:
        read_export([path], NAMES)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    if suffix == ".csv":
        assert says in str(error.value)


def test_lines_of_another_length_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    lines = text().splitlines()
    path.write_text("\n".join([*lines[:20], "1709532114,5", "a,b,c,d,e,f", *lines[20:]]) + "\n")
    export = read_export([path], NAMES)
    assert (export.rows, export.unreadable_rows) == (N + 2, 2)
    assert len(export.series[NAMES[0]]) == N


def test_unreadable_times_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text(stamp=STAMPS["ISO"]).replace("2024-03-04T06:01:00", "yesterday"))
    export = read_export([path], NAMES)
    assert (export.rows, export.timeless_rows) == (N, 1)
    assert len(export.series[NAMES[0]]) == N - 1


def test_the_decimal_sign_is_told_from_the_separator(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text('time;a;b\n0;"1.234,5";2\n1;3,25;4\n2;3,25;4\n')
    assert (sniff(path).separator, sniff(path).decimal) == (";", ",")


@pytest.mark.parametrize(
    ("day", "hour"),
    [
        ("%Y-%m-%d", "%H:%M:%S"), ("%d.%m.%Y", "%H:%M:%S"), ("%d-%b-%y", "%H:%M:%S"), ("%Y-%m-%d", "%H%M%S"),
        ("%Y-%m-%d", "%-H%M%S"), ("%Y%m%d", "%H%M%S"), ("%Y%m%d", "%H:%M:%S"), ("%Y-%m-%d", "%I:%M:%S %p"),
    ],
)  # fmt: skip
def test_day_and_hour_in_two_columns(day: str, hour: str, tmp_path: Path) -> None:
    rows = [[utc(day)(float(r[0])), utc(hour)(float(r[0])), *r[1:]] for r in cells(DATA)]
    check(write(tmp_path / "x.csv", rows, ("Date", "Time", *NAMES)))


def test_a_long_export_may_have_day_and_hour_apart(tmp_path: Path) -> None:
    rows = [
        [name, utc("%d.%m.%Y")(float(r[0])), utc("%H:%M:%S")(float(r[0])), value]
        for r in cells(DATA)
        for name, value in zip(NAMES, r[1:], strict=True)
    ]
    export = read_export([write(tmp_path / "x.csv", rows, ("tag", "Datum", "Uhrzeit", "value"))], NAMES)
    np.testing.assert_allclose(export.series[NAMES[0]].value, DATA.pv)
    np.testing.assert_allclose(export.series[NAMES[0]].time_s, DATA.time_s)
