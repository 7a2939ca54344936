"""The same readings sent again are no second rate of sampling; stamps that are truly rounded still are spread."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dirty_plant import PERIOD_S, TAGS, cells, clean, write

from loopwright.pipeline.historian.cleaning.tags import named
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.screening import Screened, screen_export

DATA = clean()
N = len(DATA.pv)
ROWS = cells(DATA)
MINUTES = cells(DATA.with_(time_s=np.floor(DATA.time_s / 60) * 60))


def screen(*paths: Path) -> Screened:
    tags = named(TAGS)
    return screen_export("plant", read_export(paths, [t.tag for t in tags]), tags)


SENT: dict[str, tuple[list[list[list[str]]], int]] = {
    "the same file twice": ([ROWS, ROWS], N),
    "three times": ([ROWS, ROWS, ROWS], 2 * N),
    "a file and its later part": ([ROWS, ROWS[99:]], N - 99),
    "the later part first": ([ROWS[99:], ROWS], N - 99),
    "two times in one file": ([[*ROWS, *ROWS]], N),
    "thirty files, each twice": ([p for k in range(0, N, 50) for p in 2 * [ROWS[k : k + 50]]], N),
    "two files in disorder": ([[ROWS[k] for k in np.random.default_rng(s).permutation(N)] for s in (1, 2)], N),
    "each row twice": ([[row for row in ROWS for _ in range(2)]], N),
    "rounded stamps, the same file twice": ([MINUTES, MINUTES], N),
    "rounded stamps, two times in one file": ([[*MINUTES, *MINUTES]], N),
}


@pytest.mark.parametrize("name", SENT)
def test_readings_that_were_sent_again_are_counted_and_dropped(name: str, tmp_path: Path) -> None:
    files, again = SENT[name]
    found = screen(*(write(tmp_path / f"{i}.csv", rows) for i, rows in enumerate(files)))
    assert found.report.period_s == PERIOD_S
    assert [t.readings["duplicate"] for t in found.report.tags] == [again] * 3
    assert any(f"{again} readings came a second time" in f.words for f in found.report.findings)
    assert ("rounded" in {f.kind for f in found.report.findings}) == ("rounded" in name)
    np.testing.assert_allclose(found.record.pv[:, 0], DATA.pv)
    np.testing.assert_allclose(found.record.mv[:, 0], DATA.mv)


def test_a_resting_tag_under_rounded_stamps_is_spread_and_not_dropped(tmp_path: Path) -> None:
    """In a long export each tag has its own stamps: the valve repeats its value within a minute by right."""
    rows = [[f"{np.floor(t / 60) * 60:.0f}", tag.tag, f"{v:.6g}"]
            for tag, values in zip(TAGS, (DATA.pv, DATA.mv, DATA.dv), strict=True)
            for t, v in zip(DATA.time_s, values, strict=True)]  # fmt: skip
    found = screen(write(tmp_path / "x.csv", rows, ("time", "tag", "value")))
    assert all("duplicate" not in t.readings for t in found.report.tags)
    np.testing.assert_allclose(found.record.mv[:, 0], DATA.mv)
    np.testing.assert_allclose(found.record.pv[:, 0], DATA.pv, rtol=1e-5)
