"""An MV of two or three values: an on-off valve is refused, a test between two values is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import TAGS, clean, screen_of, spoilt

from loopwright.pipeline.historian.cleaning.tags import Tag, named
from loopwright.pipeline.historian.notices import on_off
from loopwright.pipeline.historian.screening import Screened, refusal
from loopwright.pipeline.records.record import levels_of, only_between

PV, MV, DV = TAGS
PERCENT = (PV, replace(MV, low=0.0, high=100.0), DV)
SPEED = (PV, replace(MV, unit="1/min", low=20.0, high=80.0), DV)


def between(low: float, high: float, folder: Path, tags: tuple[Tag, ...] = TAGS) -> Screened:
    return screen_of(spoilt(mv=np.where(clean().mv > 50, high, low)), folder, tags)


@pytest.mark.parametrize(
    ("ends", "tags"),
    [((0, 100), TAGS), ((0, 100), PERCENT), ((0, 1), PERCENT), ((0, 1), TAGS), ((20, 80), SPEED)],
    ids=["0 and 100", "0 and 100 of a stated range", "0 and 1 %", "0 and 1", "the ends of another range"],
)
def test_an_on_off_valve_is_refused_in_words(ends: tuple[float, float], tags: tuple[Tag, ...], tmp_path: Path) -> None:
    found = between(*ends, tmp_path, tags)
    assert found.report.verdict.carries == "no"
    refused = refusal(found, named(tags), anyway=False)
    assert refused is not None
    assert refused.anyway
    assert "looks like an on-off valve" in refused.why
    assert refusal(found, named(tags), anyway=True) is None


def test_a_test_between_two_values_is_used_and_told(tmp_path: Path) -> None:
    binary = np.random.default_rng(4).choice([20.0, 80.0], 100).repeat(15)
    found = screen_of(spoilt(mv=binary), tmp_path)
    words = "TIC-101.OP moves between 2 values only (20 and 80 %): a curve between them cannot be seen"
    assert words in found.report.verdict.reasons
    assert found.report.verdict.carries == "yes"
    assert refusal(found, named(TAGS), anyway=False) is None


def test_an_mv_of_many_values_needs_no_words(tmp_path: Path) -> None:
    found = screen_of(clean(), tmp_path)
    assert on_off(found.record, TAGS) == ()
    assert found.report.verdict.reasons == ()


def test_levels() -> None:
    steps = np.repeat([20.0, 50.0, 80.0, 20.0], 100)
    assert levels_of(steps) == pytest.approx((20.0, 50.0, 80.0))
    assert levels_of(np.r_[steps, 35.0]) == pytest.approx((20.0, 50.0, 80.0))  # a mean over a move
    assert levels_of(np.repeat([1.0, 2.0, 3.0, 4.0], 50)) == ()
    assert levels_of(np.ones(50)) == ()
    assert "3 values only (20, 50 and 80)" in only_between("U", (20.0, 50.0, 80.0), "-")
