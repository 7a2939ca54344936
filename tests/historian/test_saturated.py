"""A sensor at the end of its range is masked; the largest step of a signal that moves in steps is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import TAGS, clean, screen_of, spoilt

from loopwright.pipeline.historian.files.signal_statistics import clipped
from loopwright.pipeline.historian.screening import Screened

PV, MV, DV = TAGS


def stepped(folder: Path, low: float | None = None, high: float | None = None) -> Screened:
    levels = np.random.default_rng(6).choice([440.0, 460.0, 480.0, 520.0, 560.0], 50).repeat(30)
    return screen_of(spoilt(dv=levels), folder, (PV, MV, replace(DV, low=low, high=high)))


def test_a_disturbance_that_moves_in_steps_keeps_its_lowest_and_highest_rows(tmp_path: Path) -> None:
    found = stepped(tmp_path)
    assert "saturated" not in {f.kind for f in found.report.findings}
    assert len(found.record) == 1500


def test_its_stated_end_is_an_end(tmp_path: Path) -> None:
    found = stepped(tmp_path, 0.0, 560.0)
    (saturated,) = (f for f in found.report.findings if f.kind == "saturated")
    assert saturated.words.startswith("stands at the end of its range: 560 in ")


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_signal_that_moves_on_and_stands_at_its_end_is_saturated(share: float) -> None:
    pv = clean().pv
    cut = np.minimum(pv, np.quantile(pv, 1 - share))
    assert clipped(cut, None, None)[0].mean() == pytest.approx(share, abs=0.01)
