"""A code for a missing value is masked; a closed valve and a feed that stopped are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import TAGS, clean, screen_of, spoilt

from loopwright.pipeline.historian.cleaning.tag_checks import sentinels
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.screening import Screened

PV, MV, DV = TAGS
RANGED = (replace(PV, low=0.0, high=120.0), replace(MV, low=0.0, high=100.0), DV)
ZERO = np.r_[200:260, 500:590, 900:1000, 1200:1280]


def zeroed(values: np.ndarray) -> np.ndarray:
    out = values.copy()
    out[ZERO] = 0.0
    return out


def kinds(found: Screened) -> set[str]:
    return {f.kind for f in found.report.findings}


@pytest.mark.parametrize("tags", [TAGS, RANGED], ids=["no range stated", "range stated"])
@pytest.mark.parametrize("usual", [(35.0, 80.0), (70.0, 72.0), (10.0, 80.0)])
def test_a_closed_valve_is_real(tags: tuple[Tag, ...], usual: tuple[float, float], tmp_path: Path) -> None:
    low, high = usual
    mv = np.round(low + (clean().mv - 20.0) / 60.0 * (high - low), 1)
    found = screen_of(spoilt(mv=zeroed(mv)), tmp_path, tags)
    assert "sentinel" not in kinds(found), found.report.findings
    assert len(found.record) == len(mv)
    assert np.count_nonzero(found.record.mv == 0.0) == len(ZERO)


def test_a_valve_at_its_other_end_is_real(tmp_path: Path) -> None:
    mv = np.round(70.0 + (clean().mv - 20.0) / 30.0, 1)
    mv[ZERO] = 100.0
    assert "sentinel" not in kinds(screen_of(spoilt(mv=mv), tmp_path))


def test_a_feed_that_stopped_is_real_and_named(tmp_path: Path) -> None:
    found = screen_of(spoilt(dv=zeroed(clean().dv)), tmp_path)
    assert "sentinel" not in kinds(found)
    (zero,) = (f for f in found.report.findings if f.kind == "zero")
    assert (zero.tag, zero.drops) == (DV.tag, False)
    assert f"reads 0 in {len(ZERO)} rows, far from all other values: they stay" in zero.words
    assert np.count_nonzero(found.record.dv == 0.0) == len(ZERO)


def test_a_disturbance_that_no_pv_follows_to_zero_has_a_dead_sensor(tmp_path: Path) -> None:
    data = clean()
    found = screen_of(data.with_(dv=zeroed(data.dv)), tmp_path)
    (zero,) = (f for f in found.report.findings if f.kind == "zero")
    assert zero.drops
    assert "a dead sensor" in zero.words
    assert found.report.dropped_rows["sentinel"] == len(ZERO)


@pytest.mark.parametrize("tags", [TAGS, RANGED], ids=["no range stated", "range stated"])
def test_the_zero_of_a_dead_sensor_is_masked(tags: tuple[Tag, ...], tmp_path: Path) -> None:
    data = clean()
    found = screen_of(data.with_(pv=zeroed(data.pv)), tmp_path, tags)
    assert found.report.tags[0].readings["sentinel"] == len(ZERO)


def test_a_flow_that_falls_to_zero_as_fast_as_it_moves_is_real_where_its_range_has_zero() -> None:
    flow = zeroed(clean().mv)
    assert not sentinels(flow, replace(PV, low=0.0, high=100.0))[0].any()
    assert sentinels(flow, replace(PV, low=10.0, high=100.0))[0].sum() == len(ZERO)


@pytest.mark.parametrize("tag", RANGED, ids=lambda t: t.role)
@pytest.mark.parametrize("code", [-9999.0, 999.9, 32767.0])
def test_other_codes_stay_codes(tag: Tag, code: float) -> None:
    values = clean().mv.copy()
    values[ZERO[:9]] = code
    where, found = sentinels(values, tag)
    np.testing.assert_array_equal(np.flatnonzero(where), ZERO[:9])
    assert dict(found) == {f"{code:g}": 9}
