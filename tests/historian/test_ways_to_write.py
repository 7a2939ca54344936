"""Ways in which programs write numbers, qualities, headers and layouts: each is read as what it says, or refused."""

from __future__ import annotations

import csv
import gzip
import io
import zipfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dirty_plant import TAGS, cells, clean, screen, write
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import RecordError
from pipeline.historian.dialect import sniff
from pipeline.historian.numbers import loose_number, numbers
from pipeline.historian.quality import meaning_of
from pipeline.historian.reading import read_export, tags_in, units_of
from pipeline.historian.reason import Reason
from pipeline.historian.tags import parse_tag

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


# ---------------------------------------------------------------------- numbers
MINUSES = ["-", "\u2212", "\u2013", "\u2010", "\u2011", "\ufe63", "\uff0d", "\u2212\u00a0", "- "]
THOUSANDS = ["", "\u00a0", "\u202f", "\u2009", " ", "'", "’"]


@pytest.mark.parametrize("minus", MINUSES)
@pytest.mark.parametrize("between", THOUSANDS)
@pytest.mark.parametrize("decimal", [".", ","])
def test_signs_blanks_and_apostrophes(minus: str, between: str, decimal: str) -> None:
    column = [f"{minus}1{between}234{between}567{decimal}5", f"{minus}12{decimal}25", f"\u00a07{decimal}5\u202f", "3"]
    values, codes, texts = numbers(pa.array(column), decimal)
    np.testing.assert_allclose(values, [-1_234_567.5, -12.25, 7.5, 3])
    assert not codes.any()
    assert not texts


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1e7, 1e7).map(lambda v: round(v, 3)), min_size=1, max_size=20),
    st.sampled_from(MINUSES), st.sampled_from([*THOUSANDS, "the other"]), st.sampled_from([".", ","]),
    st.integers(1, 3),
)  # fmt: skip
def test_every_way_to_write_a_number_gives_it_back(
    values: list[float], minus: str, between: str, decimal: str, digits: int
) -> None:
    group = between if between != "the other" else {".": ",", ",": "."}[decimal]
    plain = [f"{v:,.{digits}f}" for v in values]
    column = [t.replace(",", "#").replace(".", decimal).replace("#", group).replace("-", minus) for t in plain]
    found, codes, _ = numbers(pa.array(column), decimal)
    assert not codes.any(), column
    np.testing.assert_allclose(found, [float(t.replace(",", "")) for t in plain])


@pytest.mark.parametrize(
    ("column", "decimal", "expected"),
    [
        (["1,250", "64,34", "70.1"], ".", [None, None, 70.1]),  # 1,250 may be either beside 64,34
        (["1,250", "1,234.5", "70.1"], ".", [1250, 1234.5, 70.1]),
        (["1.250", "64.34", "70,1"], ",", [None, None, 70.1]),
        (["1.250", "1.234,5", "70,1"], ",", [1250, 1234.5, 70.1]),
        (["5.2-", "\u2014", "–", "1.#QNAN"], ".", [-5.2, None, None, None]),
    ],
)
def test_what_may_be_two_numbers_is_none(column: list[str], decimal: str, expected: list[float | None]) -> None:
    values, _, _ = numbers(pa.array(column), decimal)
    np.testing.assert_allclose(values, [np.nan if v is None else v for v in expected])


@pytest.mark.parametrize(
    ("content", "decimal"),
    [
        ('time,a,b\n0,"1,234","998"\n1,"1,250","999"\n2,"1,260","997"\n', "."),
        ("time;a;b\n0;1,234;5\n1;1,250;5\n2;998;6\n", "."),
        ("time;a;b\n0;1,234;5\n1;1,250;5\n2;1,260;6\n", ","),
        ("time;a;b\n0;0,234;5\n1;1,250;5\n2;998;6\n", ","),
        ('time,a,b\n0,"1,5","2,5"\n1,"2,5","3,25"\n2,"2,5","3,5"\n', ","),
        ("time;a;b\n0;1'234,5;5\n1;1'250,5;5\n2;\u221212,5;6\n", ","),
        ("time;a;b\n0;1.234;5\n1;1.250;5\n2;998;6\n", ","),
        ("time;a;b\n0;1.234;5\n1;1.250;5\n2;1.260;6\n", "."),
        ("time;a;b\n0;45.125;5\n1;99.250;5\n2;100;6\n", "."),
        ("time;a;b\n0;45,125;5\n1;99,250;5\n2;100;6\n", ","),
        ("time;a;b\n0;1.234;5\n1;1.250;5\n2;999;6\n3;0;6\n", "."),
        ("time;a;b\n0;1.234.567;5\n1;998;5\n", ","),
    ],
)
def test_the_sign_between_thousands_is_no_decimal_sign(content: str, decimal: str, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(content, encoding="utf-8")
    assert sniff(path).decimal == decimal


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (["60.3 %", "61.5 %", "", "Bad"], [60.3, 61.5, None, None]),
        (["60.3%", "7%"], [60.3, 7]),
        (["-3.5 °C", "1,234.5 °C"], [-3.5, 1234.5]),
        (["60.3 %", "61.5 kg"], [None, None]),
        (["60.3 %", "61.5"], [None, 61.5]),
        (["5A", "7A"], [None, None]),
        (["1 Running", "2 Running"], [None, None]),
    ],
)
def test_a_unit_behind_every_number(column: list[str], expected: list[float | None]) -> None:
    values, _, _ = numbers(pa.array(column))
    np.testing.assert_allclose(values, [np.nan if v is None else v for v in expected])


@pytest.mark.parametrize("sign", [".", ","])
def test_a_small_number_far_below_tells_thousands(sign: str, tmp_path: Path) -> None:
    values = [1000 + k for k in range(300)] + [998]
    own = [[str(1_709_532_000 + 10 * k), f"{v:,d}".replace(",", sign)] for k, v in enumerate(values)]
    path = write(tmp_path / "x.csv", own, ("time", "a"), sep=";")
    np.testing.assert_allclose(read_export([path]).series["a"].value, values)


def test_three_digits_behind_both_signs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("time;a;b\n0;1,234;1.234\n1;1,250;1.250\n")
    with pytest.raises(RecordError, match=r"1,250 and 1\.250 may be decimals or thousands; export numbers without"):
        read_export([path])


@pytest.mark.parametrize("kind", ["xlsx", "parquet"])
def test_texts_with_a_decimal_comma_in_typed_cells(kind: str, tmp_path: Path) -> None:
    values = [f"{60 + k / 1000:.3f}".replace(".", ",") for k in range(N)]
    path = tmp_path / f"x.{kind}"
    if kind == "xlsx":
        workbook(path, ["Time", "a"], list(zip(map(datetime.fromisoformat, STAMPS), values, strict=True)))
    else:
        pq.write_table(pa.table({"Time": STAMPS, "a": values}), path)
    np.testing.assert_allclose(read_export([path]).series["a"].value, 60 + np.arange(N) / 1000)


@pytest.mark.parametrize(
    ("text", "number"), [("(5.2)", 5.2), ("< 0,5", 0.5), (">100", 100), ("- 7 *", -7), ("bad", None), ("1;2", None)]
)
def test_the_number_that_a_text_shows(text: str, number: float | None) -> None:
    assert loose_number(text) == number


ONE_SIDED: dict[str, Callable[[float], str]] = {
    "in brackets": lambda v: f"({v - 50:.3f})" if v < 50 else f"{v:.3f}",
    "below a limit": lambda v: "<50" if v < 50 else f"{v:.3f}",
    "over a range": lambda v: "Over Range" if v > 60 else f"{v:.3f}",
}


@pytest.mark.parametrize("name", ONE_SIDED)
def test_a_side_that_was_refused_as_text_makes_a_record_doubtful(name: str, tmp_path: Path) -> None:
    data = clean()
    own = [[row[0], ONE_SIDED[name](float(v)), *row[2:]] for v, row in zip(data.pv, cells(data), strict=True)]
    report = screen(write(tmp_path / "x.csv", own)).report
    assert "one_sided" in {f.kind for f in report.findings}
    assert report.verdict.carries != "yes"


@pytest.mark.parametrize("minus", ["\u2212", "–"])
def test_a_side_written_with_another_minus_is_read(minus: str, tmp_path: Path) -> None:
    data = clean()
    own = [[r[0], f"{v - 50:.3f}".replace("-", minus), *r[2:]] for v, r in zip(data.pv, cells(data), strict=True)]
    found = screen(write(tmp_path / "x.csv", own))
    assert found.report.findings == ()
    np.testing.assert_allclose(found.record.pv[:, 0], data.pv - 50, atol=1e-3)
    assert found.report.verdict.carries == "yes"


# ---------------------------------------------------------------------- quality
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


def test_the_state_of_a_pump_is_no_quality_of_readings(tmp_path: Path) -> None:
    own = [[t, r[0], v, str(int(k % 10 == 0))]
           for k, r in enumerate(rows()) for t, v in zip(NAMES, r[1:], strict=True)]  # fmt: skip
    check(write(tmp_path / "x.csv", own, ("Tag", "Time", "Value", "Pump Status")))


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
