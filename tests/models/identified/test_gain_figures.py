"""The table of gains: members that settle and members that do not have figures of two units, which do not mix."""

from __future__ import annotations

import numpy as np
import pytest
from made_plants import second_order, signals_of

from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.models.identified.verdict import gain_figures


def lag(pole: float, gain: float) -> Dynamics:
    return Dynamics.linear(np.array([[pole]]), np.array([[(1 - pole) * gain]]))


@pytest.mark.parametrize("ramps", [0, 1, 2, 5])
def test_the_gain_is_of_the_members_that_are_the_more(ramps: int) -> None:
    record, signals = second_order(400), signals_of(1, 1)
    scales = Scales.of(record, 1)
    data = ScaledRecord.of(record, scales)
    unit = float(scales.y_scale[0] / scales.v_scale[0])
    ramp = Dynamics.linear(np.array([[1.0]]), np.array([[0.02]]))
    members = [lag(0.9, g) for g in (1.0, 1.1, 0.9)] + [ramp] * ramps
    found = gain_figures(members, data, scales, signals.pv, signals.mv)["y0"]["u0"]
    settles = ramps < 4
    assert found["rate"] is not settles
    assert found["gain"] == pytest.approx((1.0 if settles else 0.02) * unit, rel=1e-3)
    assert found["spread"] == pytest.approx((0.1 if settles else 0.0) * unit, rel=0.01, abs=1e-6)
    assert found["sign"] == "+"
