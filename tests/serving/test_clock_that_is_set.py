"""A clock that is set back and forth hides no scan: in the journal, in its export and on the page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from loopwright.serving import Controller
from loopwright.serving.journal import Journal, JournalReader, ScanEntry, columns
from loopwright.serving.page.trend import trend
from loopwright.serving.station.journal_export import export

pytest_plugins = ["small_laws"]

BEGIN, PERIOD_S, N = 1e9, 0.5, 4_000
BACK, FORTH = 1_000, 3_000  # scans before the clock is set back by 300 s, and before it is set forth by 3600 s
HOLD = range(1_200, 1_220)


def clock() -> list[float]:
    """The time of each scan by a clock that is set back, and later forth."""
    k = np.arange(N)
    return list(BEGIN + PERIOD_S * k - 300.0 * (k >= BACK) + 3_600.0 * (k >= FORTH))


@pytest.fixture
def reader(tmp_path: Path, controller: Controller) -> Iterator[JournalReader]:
    width = len(columns(controller.manifest))
    with closing(Journal(tmp_path / "loop.journal")) as journal:
        journal.begin(controller.manifest, controller.sha256, BEGIN)
        for k, time_s in enumerate(clock()):
            journal.scan(ScanEntry(time_s, "HOLD" if k in HOLD else "AUTO", (float(k),) * width))
    with closing(JournalReader(tmp_path / "loop.journal")) as made:
        yield made


@pytest.mark.parametrize(
    ("begin_s", "end_s"), [(400, 500), (190, 210), (450, 550), (0, 100), (4_000, 10_000), (550, 650), (600, 700)]
)
def test_every_scan_within_times_is_found(reader: JournalReader, begin_s: float, end_s: float) -> None:
    expected = [k for k, t in enumerate(clock()) if begin_s <= t - BEGIN <= end_s]
    found = [int(scan.numbers[0]) for _, _, scan in reader.scans(begin_s=BEGIN + begin_s, end_s=BEGIN + end_s)]
    assert found == expected
    tables = [numbers[:, 1] for _, numbers, _ in reader.tables(BEGIN + begin_s, BEGIN + end_s)]
    assert np.concatenate(tables).astype(int).tolist() == expected


@pytest.mark.parametrize("points", [50, 2_000])  # thinned, and whole
def test_the_trend_ascends_and_has_the_scans_from_before_and_after(reader: JournalReader, points: int) -> None:
    drawn = trend(reader, BEGIN, BEGIN + 1_300, points)
    times, values = drawn["time"], drawn["columns"]["pv level"]
    assert times == sorted(times)
    shown = [k for k, t in enumerate(clock()) if t <= BEGIN + 1_300]
    least, greatest = min(shown), max(shown)
    numbers = [v for v in values if v is not None]
    assert (min(numbers), max(numbers)) == (least, greatest)
    assert (len(numbers) == len(shown)) == (points == 2_000)
    changes = drawn["modes"]
    assert all(a[0] <= b[0] for a, b in pairwise(changes))
    assert "HOLD" in {mode for _, mode in changes}
    # The pause that is none: the clock was only set. No gap is drawn within the times that both passes cover.
    assert not [t for t, v in zip(times, values, strict=True) if v is None and t < BEGIN + 1_190]


def test_the_export_has_each_scan_once_and_its_times_ascend(reader: JournalReader, tmp_path: Path) -> None:
    assert export(reader.path, tmp_path / "loop.csv") == N
    table = pd.read_csv(tmp_path / "loop.csv")
    assert table["level.PV"].tolist() == list(range(N))
    steps = pd.to_datetime(table["time"], format="ISO8601").diff().dt.total_seconds().to_numpy()[1:]
    assert np.delete(steps, FORTH - 1) == pytest.approx(PERIOD_S, abs=2e-3)
    assert steps[FORTH - 1] == pytest.approx(3_600 + PERIOD_S, abs=2e-3)  # set forth: as if nothing was scanned
    # A scan before the clock was set back still gets the MV that the next one read back.
    assert table["valve.OP"][BACK - 1] == BACK
