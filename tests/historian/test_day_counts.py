"""Numbers that count days, or ticks, told from seconds since some start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dirty_plant import write

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.file_reader import read_export

START_S = 1_709_532_000.0  # 2024-03-04 06:00 UTC
N = 40
STEP_S = 30.0
TIME_S = START_S + STEP_S * np.arange(N)


def times_of(tmp_path: Path, name: str, stamps: Sequence[str], **options: str) -> np.ndarray:
    path = write(tmp_path / "x.csv", [[s, "1.5"] for s in stamps], (name, "TIC.PV"))
    return read_export([path], **options).series["TIC.PV"].time_s


@pytest.mark.parametrize("step_s", [1.0, 60.0, 900.0, 3600.0, 21_600.0, 86_400.0])
@pytest.mark.parametrize("digits", [6, 10])
def test_dates_of_a_spreadsheet_are_days_whatever_their_step(step_s: float, digits: int, tmp_path: Path) -> None:
    times = 1_709_510_400.0 + step_s * np.arange(N)
    stamps = [f"{25_569 + t / 86_400:.{digits}f}" for t in times]
    for name, form in (("Date", ""), ("Time", "serial" if step_s > 3600 else "")):
        found = times_of(tmp_path, name, stamps, **{"time_format": form} if form else {})
        np.testing.assert_allclose(found, times, atol=86_400 * 10.0**-digits)


@pytest.mark.parametrize("digits", [2, 5])
def test_hours_of_the_day_in_few_digits_are_dates(digits: int, tmp_path: Path) -> None:
    times = 1_709_510_400.0 + 3600 * np.arange(N)
    stamps = [f"{25_569 + t / 86_400:.{digits}f}" for t in times]
    np.testing.assert_allclose(times_of(tmp_path, "Zeit", stamps), times, atol=0.51 * 86_400 * 10.0**-digits)


@pytest.mark.parametrize(("name", "step"), [("Time", 0.125), ("Time", 0.5), ("Zeit", 0.25), ("t", 0.5), ("Zeit", 1)])
def test_numbers_that_may_be_seconds_or_dates_are_asked_for(name: str, step: float, tmp_path: Path) -> None:
    stamps = [f"{45_000 + step * k:g}" for k in range(N)]
    with pytest.raises(RecordError, match=r"such as 45000 may be seconds or dates .* --time-format s or"):
        times_of(tmp_path, name, stamps)
    values = np.array(stamps, float)
    np.testing.assert_allclose(times_of(tmp_path, name, stamps, time_format="s"), values)
    np.testing.assert_allclose(
        times_of(tmp_path, name, stamps, time_format="serial"), 86_400 * (values - 25_569), atol=1e-3
    )


@pytest.mark.parametrize("step", [0.1, 0.04, 1.0001, 1 / 64, 5.0])
def test_seconds_in_the_middle_of_a_record_are_no_dates(step: float, tmp_path: Path) -> None:
    stamps = [f"{45_000 + step * k:.9g}" for k in range(N)]
    np.testing.assert_allclose(times_of(tmp_path, "time", stamps), 45_000 + step * np.arange(N), atol=1e-4)


@pytest.mark.parametrize(("first", "n"), [(30_000, N), (45_000, 23_000)])
def test_numbers_that_no_dates_of_a_record_could_be_are_seconds(first: int, n: int, tmp_path: Path) -> None:
    stamps = [f"{first + 0.5 * k:.1f}" for k in range(n)]
    path = write(tmp_path / "x.csv", [[s, "1.5"] for s in stamps], ("Time", "TIC.PV"))
    np.testing.assert_allclose(read_export([path]).series["TIC.PV"].time_s, first + 0.5 * np.arange(n))


def test_a_column_that_cannot_be_read_beside_dates_of_a_spreadsheet_does_no_harm(tmp_path: Path) -> None:
    stamps = [f"{25_569 + t / 86_400:.8f}" for t in TIME_S]
    own = [[s, str(N - k), "1.5"] for k, s in enumerate(stamps)]
    export = read_export([write(tmp_path / "x.csv", own, ("Time", "Time left [%]", "TIC.PV"))])
    np.testing.assert_allclose(export.series["TIC.PV"].time_s, TIME_S, atol=1e-2)


@pytest.mark.parametrize(
    ("stamp", "atol"),
    [
        (lambda t: f"{719_529 + t / 86_400:.9f}", 1e-3),  # MATLAB
        (lambda t: f"{2_440_587.5 + t / 86_400:.9f}", 1e-3),  # Julian
        (lambda t: f"{int(t + 62_135_596_800) * 10**7}", 1e-3),  # ticks of .NET
        (lambda t: f"{int(t + 11_644_473_600) * 10**7}", 1e-3),  # ticks of Windows
        (lambda t: f"{int(t) * 10**9}", 1e-3),
        (lambda t: pd.Timestamp(t, unit="s").strftime("%Y%m%d%H%M%S"), 1e-3),
    ],
    ids=["MATLAB", "Julian", ".NET", "Windows", "ns", "digits"],
)
def test_counts_that_programs_write(stamp: Callable[[float], str], atol: float, tmp_path: Path) -> None:
    np.testing.assert_allclose(times_of(tmp_path, "timestamp", [stamp(float(t)) for t in TIME_S]), TIME_S, atol=atol)
