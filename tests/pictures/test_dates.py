"""The time axis of an export."""

from __future__ import annotations

from datetime import timedelta, timezone

from matplotlib.figure import Figure

from pipeline.pictures.dates import ExportTimes

START_S = 1_709_532_600.0  # 2024-03-04 06:10 UTC


def test_dates_are_drawn_in_the_zone_in_which_a_time_to_leave_out_counts() -> None:
    zone = timezone(timedelta(hours=1))
    times = ExportTimes(START_S, START_S + 3600.0, str(zone), zone)
    assert times.words == "From 2024-03-04 07:10:00 to 2024-03-04 08:10:00, UTC+01:00."
    axis = Figure().subplots().xaxis
    times.dress(axis)
    assert axis.get_major_locator().tz is zone
    assert ExportTimes(START_S, START_S + 60.0, "UTC").words.startswith("From 2024-03-04 06:10:00")
