"""The time axis of a screening: dates with their zone, or the time from the first row."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta, timezone

import numpy as np
import pytest
from matplotlib.figure import Figure

from loopwright.pipeline.historian.files.time_stamps import UNSTATED, TimeForm, clock_of, zone_of
from loopwright.pipeline.pictures.screening_pictures import ExportTimes

START_S = datetime(2024, 3, 4, 6, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(
    ("name", "cells", "zone"),
    [
        ("time", ["2024-03-04T06:00:00.172Z"], "UTC"),
        ("time", ["2024-03-04 06:00:00+01:00"], "UTC"),
        ("time", ["2024-03-04 06:00:00"], UNSTATED),
        ("time", ["", "13.03.2024 06:00:00"], UNSTATED),
        ("time", ["1709532000.5"], "UTC"),
        ("time", [1709532000500], "UTC"),
        ("time", ["45355.25", "45355.251"], UNSTATED),
        ("time_s", ["0.0", "6.0"], ""),
        ("time [h]", ["0.0", "0.1"], ""),
    ],
)
def test_the_zone_is_what_the_stamps_say(name: str, cells: list[str], zone: str) -> None:
    clock = clock_of(name, cells, "x.csv")
    assert clock is not None
    assert zone_of(clock, cells) == zone


def test_stamps_of_a_typed_file_may_have_a_zone() -> None:
    stamp = datetime(2024, 3, 4, 6)
    assert zone_of(TimeForm("iso"), [None, stamp]) == zone_of(TimeForm("iso"), [date(2024, 3, 4)]) == UNSTATED
    assert zone_of(TimeForm("iso"), [stamp.replace(tzinfo=UTC)]) == "UTC"
    assert zone_of(TimeForm("iso"), []) == ""


def test_an_export_with_dates_has_them_at_its_axis() -> None:
    times = ExportTimes(START_S, START_S + 8 * 3600, "UTC")
    axes = Figure().subplots()
    axes.plot(times.at(START_S + 3600 * np.arange(9.0)), np.arange(9.0))
    times.dress(axes.xaxis)
    assert axes.xaxis.get_major_formatter().format_ticks(times.at(START_S + np.array([0.0, 3600.0]))) == [
        "06:00",
        "07:00",
    ]
    assert times.label == "time (UTC)"
    assert times.words == "From 2024-03-04 06:00:00 to 2024-03-04 14:00:00, UTC."
    assert ExportTimes(START_S, START_S, UNSTATED).words.endswith(", the export states no zone.")


def test_an_export_without_dates_counts_from_its_first_row() -> None:
    times = ExportTimes(100.0, 100.0 + 50 * 3600, "")
    assert times.at(np.array([100.0, 7300.0])) == pytest.approx([0.0, 2.0])
    assert times.label == "time [h]"
    assert times.words == "The export has no dates: the time counts from its first row."
    assert ExportTimes(5.0, 5.0, "").at(np.array([5.0])) == pytest.approx([0.0])


def test_dates_are_drawn_in_the_zone_in_which_a_time_to_leave_out_counts() -> None:
    zone = timezone(timedelta(hours=1))
    times = ExportTimes(START_S, START_S + 3600.0, str(zone), zone)
    assert times.words == "From 2024-03-04 07:00:00 to 2024-03-04 08:00:00, UTC+01:00."
    axis = Figure().subplots().xaxis
    times.dress(axis)
    assert axis.get_major_locator().tz is zone
    assert ExportTimes(START_S, START_S + 60.0, "UTC").words.startswith("From 2024-03-04 06:00:00")
