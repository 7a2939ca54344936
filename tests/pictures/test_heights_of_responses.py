"""The axis of a step response: its band may run away, and the response stays readable."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.pictures.identified_pictures import _heights

MIDDLE = np.array([0.0, 1.0, 2.0])


def test_a_band_that_runs_away_leaves_the_response_a_third_of_the_axis() -> None:
    bottom, top = _heights(MIDDLE, np.array([0.0, -5.0, -1e25]), np.array([0.0, 5.0, 1e25]))
    assert (bottom, top) == pytest.approx((-2.1, 4.1))


def test_a_narrow_band_is_seen_whole() -> None:
    bottom, top = _heights(MIDDLE, MIDDLE - 0.2, MIDDLE + 0.3)
    assert bottom == pytest.approx(-0.2 - 0.1)
    assert top == pytest.approx(2.3 + 0.1)


def test_a_response_of_nothing_has_an_axis() -> None:
    bottom, top = _heights(np.zeros(3), np.zeros(3), np.zeros(3))
    assert bottom < 0 < top
