"""The forms of a PID are the same law: their transfer functions are equal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.pipeline.tuning.pid_forms import PidForms, whole_span
from loopwright.pipeline.tuning.rules import PidSettings
from loopwright.serving.manifest import Signal

S = 1j * np.geomspace(1e-4, 10, 30)  # [1/s]


@given(st.floats(-5, 5).filter(lambda kc: abs(kc) > 1e-3), st.floats(1, 1e4), st.floats(0, 0.25))
def test_ideal_parallel_and_series_form_have_one_transfer_function(kc: float, ti_s: float, share: float) -> None:
    forms = PidForms.of(PidSettings(kc, ti_s, share * ti_s), 200.0, 100.0)
    ideal = kc * (1 + 1 / (ti_s * S) + share * ti_s * S)
    np.testing.assert_allclose(forms.kc + forms.ki / S + forms.kd * S, ideal, rtol=1e-9)
    assert forms.series is not None
    gain, ti, td = forms.series
    np.testing.assert_allclose(gain * (1 + 1 / (ti * S)) * (1 + td * S), ideal, rtol=1e-9)


def test_a_derivative_time_above_a_quarter_of_the_integral_time_has_no_series_form() -> None:
    forms = PidForms.of(PidSettings(1.0, 100.0, 30.0), 200.0, 100.0)
    assert forms.series is None
    assert "series form: none" in forms.words("degC", "%")


def test_the_proportional_band_is_the_share_of_the_pvs_range_that_moves_the_mv_over_its_own() -> None:
    assert PidForms.of(PidSettings(-0.25, 100.0), 200.0, 100.0).band_percent == pytest.approx(200.0)


def test_without_an_integral_part_there_is_no_time_of_it() -> None:
    forms = PidForms.of(PidSettings(2.0, float("inf"), 10.0), 200.0, 100.0)
    assert forms.ki == 0
    assert forms.series == (2.0, float("inf"), 10.0)
    assert "no integral part" in forms.words("degC", "%")


def test_a_band_counts_by_all_of_a_valve_in_percent_and_by_the_range_of_another_unit() -> None:
    assert whole_span(Signal("OP", "%", 25.0, 58.0)) == 100
    assert whole_span(Signal("OP", "%", -100.0, 100.0)) == 200
    assert whole_span(Signal("FIC.SP", "t/h", 10.0, 60.0)) == 50
