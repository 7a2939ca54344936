"""Good rows stay: motions made again, limits of the plant, a plant at rest; compressed tags are drawn as they were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import PERIOD_S, START_S, TAGS, Clean, answer, clean, screen_of, steps

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.row_grid import resampled
from loopwright.pipeline.historian.cleaning.sampling import sampling
from loopwright.pipeline.historian.cleaning.tags import Tag, named, read_tags
from loopwright.pipeline.historian.export_params import exported, signal_tags
from loopwright.pipeline.historian.files.export import Export, Series
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.screening import Screened, screen_export

PV, MV, DV = TAGS
LEVEL = Tag("TIC-101.PV", "pv", "m")


def without_load(mv: np.ndarray, step: float) -> Clean:
    """The plant's answer without noise, by a converter with steps; no step is a plain float."""
    n = len(mv)
    y = answer(mv, np.full(n, 500.0))
    y = np.round(y / step) * step if step else y
    return Clean(START_S + PERIOD_S * np.arange(n), y, mv, np.full(n, 500.0))


@pytest.mark.parametrize("step", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("seed", range(2))
def test_a_motion_made_again_stays_where_no_noise_tells_the_two_apart(step: float, seed: int, tmp_path: Path) -> None:
    once = steps(np.random.default_rng(seed), 300, 20, 80)
    found = screen_of(without_load(np.tile(once, 6), step), tmp_path, (PV, MV))
    assert found.report.kept_rows == 1800, found.report.findings


def test_a_copied_block_of_a_coarse_pv_is_known_by_a_noisy_column(tmp_path: Path) -> None:
    data = clean()
    coarse = data.with_(pv=np.round(data.pv))
    again = Clean(*(np.insert(c, 1200, c[300:500]) for c in (coarse.time_s, coarse.pv, coarse.mv, coarse.dv)))
    again = again.with_(time_s=START_S + PERIOD_S * np.arange(len(again.pv)))
    found = screen_of(again, tmp_path)
    assert found.report.dropped_rows.get("copy", 0) == pytest.approx(200, abs=30)
    assert (found.code[1225:1375] == Reason.COPY).all()


@pytest.mark.parametrize("rest", [40, 200])
@pytest.mark.parametrize("step", [0.0, 0.05])
def test_a_plant_at_rest_at_the_start_is_no_stuck_sensor(rest: int, step: float, tmp_path: Path) -> None:
    mv = np.r_[np.full(rest, 43.75), steps(np.random.default_rng(1), 1200, 20, 80)]
    found = screen_of(without_load(mv, step), tmp_path, (PV, MV))
    assert "stuck" not in found.report.dropped_rows, found.report.findings


def overflowing(folder: Path, tag: Tag) -> Screened:
    """A tank of 10 m that overflows in a third of the rows."""
    mv = steps(np.random.default_rng(3), 1500, 20, 80)
    level = np.empty(len(mv))
    x = 4.0
    for k, u in enumerate(mv):
        level[k] = x
        x = min(max(x + 0.02 * (u / 10 - 1.6 * np.sqrt(max(x, 0.0))), 0.0), 10.0)
    percent = 10.0 if tag.unit == "%" else 1.0
    return screen_of(
        Clean(START_S + PERIOD_S * np.arange(len(mv)), np.round(percent * level, 3), mv, mv), folder, (tag, MV)
    )


@pytest.mark.parametrize(
    ("tag", "kind", "stay"),
    [
        (LEVEL, "saturated", False),
        (replace(LEVEL, low=0.0, high=10.0), "saturated", False),
        (replace(LEVEL, low=0.0, high=14.0), "limit", True),
        (replace(LEVEL, low=0.0, high=14.0, ends="drop"), "saturated", False),
        (replace(LEVEL, ends="keep"), "limit", True),
        (replace(LEVEL, unit="%", low=0.0, high=100.0), "saturated", False),
        (replace(LEVEL, unit="%", low=0.0, high=100.0, ends="keep"), "limit", True),
    ],
)
def test_rows_at_a_limit_of_the_plant_stay_where_a_person_says_so(
    tag: Tag, kind: str, stay: bool, tmp_path: Path
) -> None:
    found = overflowing(tmp_path, tag)
    assert [f.kind for f in found.report.findings if f.kind in {"saturated", "limit"}] == [kind]
    assert (found.report.kept_rows == 1500) is stay, found.report.findings


def test_the_table_says_how_a_tag_goes_between_readings_and_what_becomes_of_its_ends(tmp_path: Path) -> None:
    table = tmp_path / "tags.csv"
    table.write_text("tag,role,unit,between,ends\nT,pv,degC,line,keep\nu,mv,%,step,\nF,dv,t/h,,drop\n")
    tags = signal_tags([exported(tag) for tag in named(read_tags(table))])
    assert [(t.between, t.ends) for t in tags] == [("line", "keep"), ("step", ""), ("", "drop")]
    table.write_text("tag,role,unit,between,ends\nT,pv,degC,curve,\nu,mv,%,,stay\n")
    with pytest.raises(RecordError) as error:
        read_tags(table)
    assert len(error.value.mistakes) == 2  # type: ignore[attr-defined]


def swinging_door(v: np.ndarray, band: float) -> np.ndarray:
    """Readings (m,) that compression with a corridor of ``band`` to each side keeps."""
    kept, k, high, low, j = [0], 0, np.inf, -np.inf, 1
    while j < len(v):
        high, low = min(high, (v[j] + band - v[k]) / (j - k)), max(low, (v[j] - band - v[k]) / (j - k))
        if low > high:
            k, high, low = max(j - 1, k + 1), np.inf, -np.inf
            kept.append(k)
            j = k
        j += 1
    return np.unique([*kept, len(v) - 1])


def dead_band(v: np.ndarray, band: float) -> np.ndarray:
    """Readings (m,) that exception reporting keeps."""
    kept = [0]
    for k, value in enumerate(v):
        if abs(value - v[kept[-1]]) > band:
            kept.append(k)
    return np.array(kept)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("archive", "held"), [(swinging_door, False), (dead_band, True)])
def test_an_archive_is_read_as_it_stored_whatever_the_noise(archive, held: bool, seed: int, noise: float) -> None:
    random = np.random.default_rng(seed)
    y = answer(steps(random, 4000, 20, 80), np.full(4000, 500.0))
    v = np.round(y + random.normal(0, noise, 4000), 3)
    kept = archive(v, max(1.5 * noise, 0.3))
    t = 5.0 * np.arange(4000)
    series = Series("y", t[kept], v[kept], np.zeros(len(kept), np.uint8))
    rate = sampling(series)
    assert rate.irregular
    assert rate.dead_band is held
    clock = Series("x", t, v, np.zeros(len(t), np.uint8))
    grid, _ = resampled([clock, series], [], 5.0, hold_s=1e4)
    error = np.nanstd(grid.value["y"] - y)
    assert error < max(1.5 * noise, 0.3)


@pytest.mark.parametrize("share", [0.005, 0.017, 0.03])
@pytest.mark.parametrize("seed", range(2))
def test_a_compressed_pv_gets_rows_that_show_the_plant(share: float, seed: int) -> None:
    """Its readings stand as far apart as the plant settles, and the lines between them tell what it does."""
    random = np.random.default_rng(seed)
    u = steps(random, 12_000, 20, 80)[::2].repeat(2)
    y = np.full(len(u), 55.0)
    for k in range(len(u) - 1):
        y[k + 1] = y[k] + 0.03 * (20 + 0.8 * u[max(k - 2, 0)] - y[k])
    t, v = 10.0 * np.arange(len(u)), np.round(y + random.normal(0, 0.05, len(u)), 3)
    kept = swinging_door(v, share * float(np.ptp(v)))
    series = {
        "y": Series("y", t[kept], v[kept], np.zeros(len(kept), np.uint8)),
        "u": Series("u", t, u, np.zeros(len(t), np.uint8)),
    }
    found = screen_export("x", Export(series, (), "wide", len(t), 0, 0), named((Tag("y", "pv"), Tag("u", "mv"))))
    assert not found.report.tags[0].sampling.dead_band
    assert found.report.period_s % 10.0 == 0
    assert found.report.period_s <= found.report.tags[0].sampling.step_s / 3
    assert found.report.verdict.inputs[0].gain["y"] == pytest.approx(0.8, rel=0.1)


def test_cells_that_stay_empty_until_the_value_changes_are_held() -> None:
    t, u = 10.0 * np.arange(1200), steps(np.random.default_rng(0), 1200, 20, 80)
    y = np.round(answer(u, np.full(1200, 500.0)) + np.random.default_rng(1).normal(0, 0.1, 1200), 3)
    same = np.r_[False, np.diff(u) == 0]
    code = np.where(same, np.uint8(Reason.EMPTY), np.uint8(0)).astype(np.uint8)
    series = {"y": Series("y", t, y, np.zeros(1200, np.uint8)), "u": Series("u", t, np.where(same, np.nan, u), code)}
    found = screen_export("x", Export(series, (), "wide", 1200, 0, 0), named((Tag("y", "pv"), Tag("u", "mv"))))
    assert found.report.kept_rows > 1150
    np.testing.assert_array_equal(found.record.mv[:1000, 0], u[:1000])


def test_what_was_said_of_a_tag_goes_before_the_guess() -> None:
    t = np.arange(0, 200.0)
    at = np.array([0.0, 40.0, 50.0, 90.0, 199.0])
    for between, value in (("line", 5.0), ("step", 0.0)):
        one = Series("y", at, at, np.zeros(5, np.uint8), between=between)
        grid, _ = resampled([Series("x", t, t, np.zeros(200, np.uint8)), one], [replace(one, tag="u")], 1.0, 200.0)
        assert grid.value["y"][5] == value
        assert grid.value["u"][5] == (5.5 if between == "line" else 0.0)  # the middle of its period
