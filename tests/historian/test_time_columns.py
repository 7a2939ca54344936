"""Which column is the time, in which unit it counts, how it writes dates, and in which zone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dirty_plant import write

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.export import Export
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.files.headers import time_header
from loopwright.pipeline.historian.files.time_stamps import clock_of

START_S = 1_709_532_000.0  # 2024-03-04 06:00 UTC
N = 40
STEP_S = 30.0
TIME_S = START_S + STEP_S * np.arange(N)
VALUES = [f"{50 + 5 * np.sin(k):.3f}" for k in range(N)]


def read(tmp_path: Path, header: Sequence[str], *columns: Sequence[str], **options: str) -> Export:
    path = write(tmp_path / "x.csv", list(zip(*columns, strict=True)), header)
    return read_export([path], ["TIC.PV"], **options)


def times_of(tmp_path: Path, name: str, stamps: Sequence[str], **options: str) -> np.ndarray:
    return read(tmp_path, (name, "TIC.PV"), stamps, VALUES[: len(stamps)], **options).series["TIC.PV"].time_s


def stamped(form: str, times: np.ndarray = TIME_S) -> list[str]:
    return [pd.Timestamp(t, unit="s").strftime(form) for t in times]


UNITS = {
    1e-9: ["ns", "nsec", "nanoseconds"], 1e-6: ["us", "µs", "μs", "usec", "microseconds"],
    1e-3: ["ms", "msec", "millis", "milliseconds", "Millisekunden"],
    1.0: ["s", "S", "sec", "secs", "seconds", "Sekunden"],
    60.0: ["min", "MIN", "mins", "minute", "minutes", "Minuten"], 3600.0: ["h", "hr", "hrs", "hours", "Stunden"],
    86_400.0: ["d", "day", "days", "Tage"],
}  # fmt: skip
FORMS = ["Time [{}]", "time ({})", "Zeit({})", "elapsed {{{}}}", "time_{}", "Time {}", "t/{}", "Time in {}", "TIME, {}"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("factor", UNITS)
def test_every_spelling_of_a_unit_of_time(factor: float, form: str) -> None:
    for unit in UNITS[factor]:
        clock = clock_of(form.format(unit), ["0", "1", "2"], "x.csv")
        assert clock is not None, unit
        assert (clock.kind, clock.scale, clock.says) == ("number", factor, ""), unit


@pytest.mark.parametrize(("header", "factor"), [("Time (min)", 60), ("t [hr]", 3600), ("t_ms", 1e-3), ("TimeMin", 60),
                                                ("minutes", 60), ("Elapsed Time, h", 3600), ("Zeit Std", 3600),
                                                ("Zeit [Tag]", 86_400), ("Time (Std.)", 3600),
                                                ("Time (min) since start", 60), ("t [min] rel", 60),
                                                ("Time min since start", 60), ("Minutes elapsed", 60),
                                                ("Time <min>", 60), ("Time (decimal hours)", 3600)])  # fmt: skip
def test_times_in_a_unit_are_read_as_seconds(header: str, factor: float, tmp_path: Path) -> None:
    stamps = [f"{t / factor:.9g}" for t in STEP_S * np.arange(N)]
    np.testing.assert_allclose(times_of(tmp_path, header, stamps), STEP_S * np.arange(N), atol=1e-6)


@pytest.mark.parametrize("header", ["TimeTag", "Time Tag", "Time_Tag", "Time Std", "TS_STD", "Timestamp W",
                                    "Fecha hora", "Time D1", "Time US Central"])  # fmt: skip
def test_a_word_that_is_no_unit_of_time(header: str, tmp_path: Path) -> None:
    assert time_header(header).factor is None
    np.testing.assert_allclose(times_of(tmp_path, header, [f"{t:.0f}" for t in TIME_S]), TIME_S)


def test_what_is_written_beside_the_unit(tmp_path: Path) -> None:
    for header, factor in (("Timestamp (ms since start)", 1e-3), ("Time (UTC)", 1.0), ("t [min elapsed]", 60.0)):
        stamps = [str(10 * k) for k in range(N)]
        np.testing.assert_allclose(times_of(tmp_path, header, stamps), 10 * factor * np.arange(N))
    path = write(tmp_path / "x.csv", [["-", "degC"], *([str(k), v] for k, v in enumerate(VALUES))], ("time", "TIC.PV"))
    np.testing.assert_allclose(read_export([path], ["TIC.PV"]).series["TIC.PV"].time_s, np.arange(N))


def test_the_zone_may_stand_behind_a_date(tmp_path: Path) -> None:
    for zone, hours in (("CET", 1), ("MESZ", 2), ("+05:30", 5.5)):
        stamps = [f"{s} {zone}" for s in stamped("%d.%m.%Y %H:%M:%S", TIME_S + 3600 * hours)]
        np.testing.assert_allclose(times_of(tmp_path, "x", stamps), TIME_S)


def test_a_unit_below_the_header_counts(tmp_path: Path) -> None:
    path = write(
        tmp_path / "x.csv", [["min", "degC"], *([str(k), v] for k, v in enumerate(VALUES))], ("time", "TIC.PV")
    )
    np.testing.assert_allclose(read_export([path], ["TIC.PV"]).series["TIC.PV"].time_s, 60.0 * np.arange(N))


@pytest.mark.parametrize("header", ["Time (m)", "time [foo]", "Zeit [Takte]"])
def test_an_unknown_unit_is_refused_and_a_person_may_name_it(header: str, tmp_path: Path) -> None:
    stamps = [str(k) for k in range(N)]
    with pytest.raises(RecordError, match="is no unit of time that is known; write one of ns, us, ms, s, min, h, d"):
        times_of(tmp_path, header, stamps)
    np.testing.assert_allclose(times_of(tmp_path, header, stamps, time_format="min"), 60.0 * np.arange(N))


@pytest.mark.parametrize("header", ["FI-7 [min]", "TIC.PV (h)", "Level s", "T (°C)", "Run hours"])
def test_a_tag_is_no_time(header: str) -> None:
    assert not time_header(header).named or time_header(header).rank == 2


def test_numbers_without_a_unit_are_seconds_and_said(tmp_path: Path) -> None:
    export = read(tmp_path, ("time", "TIC.PV"), [str(k) for k in range(N)], VALUES)
    assert [n.column for n in export.notes] == ["time"]
    assert not read(tmp_path, ("time_s", "TIC.PV"), [str(k) for k in range(N)], VALUES).notes


@pytest.mark.parametrize("names", [("LocalTime", "UTCTime"), ("Start", "End")])
def test_other_columns_of_dates_are_named(names: tuple[str, str], tmp_path: Path) -> None:
    later = stamped("%Y-%m-%d %H:%M:%S", TIME_S + 3600)
    export = read(tmp_path, (*names, "TIC.PV"), DATES, later, VALUES)
    assert [n.column for n in export.notes] == [names[0]]
    assert names[1] in export.notes[0].words


FORMS_OF_DATES = [
    "%Y/%m/%d %H:%M:%S", "%Y.%m.%d %H:%M:%S", "%d.%m.%Y %H.%M.%S", "%d.%m.%y %H:%M:%S", "%d-%b-%Y %I:%M:%S %p",
    "%b %d, %Y %I:%M:%S %p", "%Y%m%dT%H%M%SZ", "%Y%m%d %H:%M:%S", "%Y-%m-%d %H:%M:%S UTC", "%a %d.%m.%Y %H:%M:%S",
    "%d.%m.%Y %H:%M:%S UTC",
    "%d.%m.%Y %H:%M:%S:000", "%d.%m.%Y %H:%M:%S,000000", "%Y-%m-%dT%H:%M:%S.000000000Z", "%d %B %Y %H:%M:%S",
]  # fmt: skip


@pytest.mark.parametrize("form", FORMS_OF_DATES)
def test_forms_of_dates(form: str, tmp_path: Path) -> None:
    np.testing.assert_allclose(times_of(tmp_path, "x", stamped(form)), TIME_S, atol=1e-3)


@pytest.mark.parametrize(
    ("form", "hours"),
    [("%Y-%m-%d %H:%M:%S EST", -5), ("%d.%m.%Y %H:%M:%S CDT", -5), ("%a %b %d %H:%M:%S CET %Y", 1),
     ("%a %b %d %H:%M:%S GMT+02:00 %Y", 2), ("%Y-%m-%d %H:%M:%S GMT+02", 2), ("%d.%m.%Y %H:%M:%S UTC-3", -3),
     ("%a %b %d %H:%M:%S %Y", 0)],
)  # fmt: skip
def test_zones_in_words_and_dates_of_java(form: str, hours: int, tmp_path: Path) -> None:
    found = times_of(tmp_path, "x", stamped(form, TIME_S + 3600 * hours))
    np.testing.assert_allclose(found, TIME_S)


@pytest.mark.parametrize("form", ["%d.%m.%Y %H:%M:%S", "%Y-%m-%d %H:%M:%S", "%d.%m.%Y %H:%M", "%Y-%m-%dT%H:%M:%SZ"])
def test_24_hours_are_the_end_of_a_day(form: str, tmp_path: Path) -> None:
    times = pd.Timestamp("2024-01-30 18:00").timestamp() + 3600.0 * np.arange(N)
    stamps = [
        stamped(form, [t - 86_400])[0].replace("00:00", "24:00", 1) if t % 86_400 == 0 else stamped(form, [t])[0]
        for t in times
    ]
    np.testing.assert_allclose(times_of(tmp_path, "x", stamps), times)


def test_hours_of_half_a_day_without_a_date(tmp_path: Path) -> None:
    times = 11 * 3600 + 3000 + STEP_S * np.arange(N)
    np.testing.assert_allclose(times_of(tmp_path, "Time", stamped("%I:%M:%S %p", times)), times)


@pytest.mark.parametrize(("month", "number"), [("fev", 2), ("mrt", 3), ("mei", 5), ("out", 10), ("dez", 12)])
def test_months_of_more_languages(month: str, number: int, tmp_path: Path) -> None:
    times = pd.Timestamp(f"2024-{number:02d}-04 06:00").timestamp() + STEP_S * np.arange(N)
    stamps = [s.replace("#", month) for s in stamped("%d-#-%Y %H:%M:%S", times)]
    np.testing.assert_allclose(times_of(tmp_path, "x", stamps), times)


def test_german_months_midnight_and_whole_minutes(tmp_path: Path) -> None:
    for month, number in (("Mrz", 3), ("Mai", 5), ("Okt", 10), ("Dez", 12)):
        times = pd.Timestamp(f"2024-{number:02d}-04 06:00").timestamp() + STEP_S * np.arange(N)
        stamps = [s.replace("#", month) for s in stamped("%d-#-%Y %H:%M:%S", times)]
        np.testing.assert_allclose(times_of(tmp_path, "x", stamps), times)
    times = pd.Timestamp("2024-03-04").timestamp() + STEP_S * np.arange(N)
    short = [s.removesuffix(" 00:00:00") for s in stamped("%d.%m.%Y %H:%M:%S", times)]
    assert short[0] == "04.03.2024"
    np.testing.assert_allclose(times_of(tmp_path, "x", short), times)


@pytest.mark.parametrize(("form", "days"), [("%y-%m-%d", 3), ("%d-%m-%y", 3), ("%m/%d/%Y", 20), ("%d/%m/%Y", 20)])
def test_day_month_and_year_are_told_by_how_they_go_on(form: str, days: int, tmp_path: Path) -> None:
    times = pd.Timestamp("2024-03-04 06:00").timestamp() + days * 86_400 / N * np.arange(N)
    found = times_of(tmp_path, "x", stamped(f"{form} %H:%M:%S", times))
    np.testing.assert_allclose(found, times, atol=1)


@pytest.mark.parametrize("form", ["%y-%m-%d %H:%M:%S", "%d/%m/%Y %H:%M:%S", "%m/%d/%y %H:%M:%S"])
def test_what_cannot_be_told_is_refused(form: str, tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"may be .* give --time-format"):
        times_of(tmp_path, "x", stamped(form))


def test_hours_of_the_day_count_over_midnight(tmp_path: Path) -> None:
    times = 23 * 3600 + 3000 + STEP_S * np.arange(N)
    found = times_of(tmp_path, "Time", stamped("%H:%M:%S", times))
    np.testing.assert_allclose(found, times)


@pytest.mark.parametrize("names", ["Year Month Day Hour Minute Second", "Jahr Monat Tag Stunde Minute"])
def test_year_to_second_in_columns_of_their_own(names: str, tmp_path: Path) -> None:
    times = TIME_S if "Second" in names else START_S + 60.0 * np.arange(N)
    parts = list(zip(*(s.split() for s in stamped("%Y %m %d %H %M %S", times)), strict=True))
    header = names.split()
    export = read(tmp_path, (*header, "TIC.PV"), *([str(int(c)) for c in p] for p in parts[: len(header)]), VALUES)
    np.testing.assert_allclose(export.series["TIC.PV"].time_s, times)
    assert {*export.series} == {"TIC.PV"}


@pytest.mark.parametrize("named", ["Day", "Hour"])
def test_a_person_may_name_the_day_or_the_hour_of_two_columns(named: str, tmp_path: Path) -> None:
    days, hours = zip(*(s.split() for s in stamped("%Y-%m-%d %H:%M:%S")), strict=True)
    found = read(tmp_path, ("Day", "Hour", "TIC.PV"), days, hours, VALUES, time_column=named)
    np.testing.assert_allclose(found.series["TIC.PV"].time_s, TIME_S)
    found = read(tmp_path, ("Day", "Hour", "TIC.PV"), days, hours, VALUES, time_column=named,
                 time_format="%Y-%m-%d %H:%M:%S")  # fmt: skip
    np.testing.assert_allclose(found.series["TIC.PV"].time_s, TIME_S)


DATES = stamped("%Y-%m-%d %H:%M:%S")


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("index", [str(k) for k in range(N)]),
        ("T", VALUES),
        ("t", VALUES),
        ("time", [str(k) for k in range(N)]),
        ("Date of calibration", ["2020-05-17"] * N),
        ("epoch", [f"{t:.0f}" for t in TIME_S + 7200]),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_dates_that_rise_are_the_time(name: str, other: list[str], first: bool, tmp_path: Path) -> None:
    columns = {name: other, "Recorded at": DATES}
    order = list(columns) if first else list(columns)[::-1]
    export = read(tmp_path, (*order, "TIC.PV"), *(columns[c] for c in order), VALUES)
    np.testing.assert_allclose(export.series["TIC.PV"].time_s, TIME_S)
    named = read(tmp_path, (*order, "TIC.PV"), *(columns[c] for c in order), VALUES, time_column="Recorded at")
    np.testing.assert_allclose(named.series["TIC.PV"].time_s, TIME_S)
    said = [n for n in export.notes if n.column == "Recorded at"]
    assert bool(said) == (name in {"index", "time", "epoch"})


def test_dates_that_stand_in_the_first_rows_only_are_the_time(tmp_path: Path) -> None:
    n = 1500
    stamps = stamped("%Y-%m-%d %H:%M", START_S + 0.1 * np.arange(n))
    path = write(
        tmp_path / "x.csv", [[s, str(k), "1.5"] for k, s in enumerate(stamps)], ("Timestamp", "Index", "TIC.PV")
    )
    export = read_export([path])
    np.testing.assert_allclose(export.series["TIC.PV"].time_s, START_S + 0.1 * np.arange(n), atol=1e-3)
    assert [n.column for n in export.notes] == ["Timestamp"]


def test_a_day_beside_minutes_since_the_start_is_not_the_time(tmp_path: Path) -> None:
    rows = [[f"2024-03-{4 + k // 1000:02d}", str(k), "1.5"] for k in range(1500)]
    export = read_export([write(tmp_path / "x.csv", rows, ("Date", "Minute", "TIC.PV"))])
    np.testing.assert_allclose(export.series["TIC.PV"].time_s, 60.0 * np.arange(1500))


def test_a_temperature_alone_is_no_time(tmp_path: Path) -> None:
    for name in ("T", "T_s", "T (°C)"):
        with pytest.raises(RecordError, match="no column holds times"):
            read(tmp_path, (name, "TIC.PV"), VALUES, VALUES)


def test_newest_rows_first(tmp_path: Path) -> None:
    export = read(tmp_path, ("T", "Datum", "TIC.PV"), VALUES, DATES[::-1], VALUES[::-1])
    np.testing.assert_allclose(export.series["TIC.PV"].time_s, TIME_S)
    np.testing.assert_allclose(export.series["TIC.PV"].value, [float(v) for v in VALUES])


@pytest.mark.parametrize(
    "header", [("Time PV", "TIC.PV", "Time OP", "TIC.OP"), ("TIC.PV", "Time", "TIC.OP", "Time OP")]
)
def test_each_tag_has_the_times_beside_it(header: tuple[str, ...], tmp_path: Path) -> None:
    later = stamped("%Y-%m-%d %H:%M:%S", TIME_S + 3600)
    later[-1], values = "", [*VALUES[:-1], ""]
    columns = [DATES, VALUES, later, values] if header[0] == "Time PV" else [VALUES, DATES, values, later]
    path = write(tmp_path / "x.csv", list(zip(*columns, strict=True)), header)
    export = read_export([path])
    assert {*export.series} == {"TIC.PV", "TIC.OP"}
    np.testing.assert_allclose(export.series["TIC.PV"].time_s, TIME_S)
    np.testing.assert_allclose(export.series["TIC.OP"].time_s, TIME_S[:-1] + 3600)
    assert (export.rows, export.timeless_rows) == (N, 0)


# ---------------------------------------------------------------------- zones
@pytest.mark.parametrize("newest_first", [False, True])
@pytest.mark.parametrize("day", ["2024-10-26 18:00", "2024-03-30 18:00", "2024-07-01"])
def test_local_times_of_a_zone_become_utc(day: str, newest_first: bool, tmp_path: Path) -> None:
    utc = pd.date_range(day, periods=100, freq="10min", tz="UTC")
    stamps = [t.strftime("%d.%m.%Y %H:%M:%S") for t in utc.tz_convert("Europe/Berlin")]
    values = [str(k) for k in range(100)]
    way = slice(None, None, -1 if newest_first else 1)
    export = read(tmp_path, ("Zeit", "TIC.PV"), stamps[way], values[way], time_zone="Europe/Berlin")
    np.testing.assert_allclose(export.series["TIC.PV"].time_s, utc.as_unit("s").asi8)
    np.testing.assert_allclose(export.series["TIC.PV"].value, np.arange(100))
    assert export.series["TIC.PV"].counts() == {"good": 100}
    assert export.zone == "UTC"


@pytest.mark.parametrize("hours", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("first", ["2024-10-26 18:00", "2024-10-27 00:00", "2024-10-27 01:00"])
def test_an_hour_that_comes_twice_in_few_rows_and_at_the_start(first: str, hours: float, tmp_path: Path) -> None:
    utc = pd.date_range(first, periods=60, freq=pd.Timedelta(hours=hours), tz="UTC")
    stamps = [t.strftime("%d.%m.%Y %H:%M:%S") for t in utc.tz_convert("Europe/Berlin")]
    series = read(tmp_path, ("Zeit", "TIC.PV"), stamps, [str(k) for k in range(60)], time_zone="Europe/Berlin").series
    np.testing.assert_allclose(series["TIC.PV"].time_s, utc.as_unit("s").asi8)
    assert series["TIC.PV"].good.all()


def test_an_offset_is_a_zone(tmp_path: Path) -> None:
    found = times_of(tmp_path, "Zeit", stamped("%d.%m.%Y %H:%M:%S", TIME_S + 5400), time_zone="+01:30")
    np.testing.assert_allclose(found, TIME_S)


@pytest.mark.parametrize(
    ("stamps", "zone", "says"),
    [
        (stamped("%Y-%m-%d %H:%M:%S"), "Europe/Berlon", "no such zone"),
        (stamped("%Y-%m-%dT%H:%M:%SZ"), "Europe/Berlin", "no file has dates without a zone"),
        (["2024-03-31 01:59:30", "2024-03-31 02:00:00", "2024-03-31 02:00:30"], "Europe/Berlin", "do not exist"),
    ],
)
def test_a_zone_that_cannot_be_is_refused(stamps: list[str], zone: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=says):
        times_of(tmp_path, "x", stamps, time_zone=zone)


def test_dates_are_told_by_rows_far_below(tmp_path: Path) -> None:
    times = pd.Timestamp("2024-03-04 06:00").timestamp() + 7200.0 * np.arange(600)
    for form in ("%d/%m/%Y", "%m/%d/%Y", "%y-%m-%d"):
        rows = [[s, "1.5"] for s in stamped(f"{form} %H:%M:%S", times)]
        export = read_export([write(tmp_path / "x.csv", rows, ("time", "TIC.PV"))])
        np.testing.assert_allclose(export.series["TIC.PV"].time_s, times)
        apart = [[*s.split(), v] for s, v in rows]
        export = read_export([write(tmp_path / "y.csv", apart, ("Day", "Hour", "TIC.PV"))])
        np.testing.assert_allclose(export.series["TIC.PV"].time_s, times)
