"""The report's words, numbers, axes and colours."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.pictures.drawing import BASELINE_COLOUR, PALETTE, colour_of, ratio_unit, time_axis
from loopwright.pipeline.pictures.loop_pictures import finite, moves, over_orders
from loopwright.pipeline.pictures.numbers import number, ratio
from loopwright.pipeline.pictures.words import law_label, law_name, scenario_name, setting_text


def test_a_settings_words_say_what_it_is():
    setting = {"r": 10.0, "correction": "back_calculation", "adaptive": True, "wc": 2.5}
    assert setting_text(setting) == "r=10, correction=back_calculation, adaptive, wc=2.5"
    assert law_label("incad", setting_text({"r": 10})) == "INCAD (r=10)"
    assert law_label("incad", "") == "INCAD"


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(13_301.4, 4, "13,301"), (13_320.0, 6, "13,320"), (0.07094, 4, "0.07094"), (43.4, 3, "43.4"), (998.0, 3, "998")],
)
def test_numbers_are_written_as_people_do(value, digits, text):
    assert number(value, digits) == text


def test_names_are_written_as_people_do():
    assert [law_name(law) for law in ("inc", "pid", "linearized_pid", "minimum_variance", "inverse_dob")] == [
        "INC",
        "PID",
        "linearized PID",
        "minimum variance",
        "inverse DOB",
    ]
    assert [ratio(v) for v in (1.0012, 1.16, 0.999, 2.345)] == ["1.001", "1.16", "0.999", "2.35"]
    assert [scenario_name(s, False, {"sp_a": "SP-A"}) for s in ("sp_a", "up_b", "set_point_noise", "held_out")] == [
        "SP-A",
        "up b",
        "set point with noise",
        "held-out set points",
    ]
    assert scenario_name("held_out", True) == "held-out recipes"
    assert [ratio_unit(*pair) for pair in (("ml/min", "-"), ("-", "degC"), ("K", "mol/l"))] == [
        "ml/min",
        "1/degC",
        "K/(mol/l)",
    ]


@pytest.mark.parametrize(
    ("end_s", "last", "words"),
    [(560.0, 560.0, "time [s]"), (9000.0, 150.0, "time [min]"), (72_000.0, 20.0, "time [h]")],
)
def test_the_time_axis_stays_readable(end_s, last, words):
    shown, label = time_axis(np.linspace(0, end_s, 5))
    assert (shown[-1], label) == (last, words)


def test_scales_and_marks_follow_the_data():
    assert over_orders(np.array([0.0, 1.0, 10.0, 1e4]))
    assert not over_orders(np.array([1.0, 2.0, 50.0]))
    assert not over_orders(np.array([0.0, 0.0, 0.0, 1e-9, 1.0]))
    times = finite(np.array([1e-9, 30.0, 6e5]), "tau_i_s", 60.0)
    assert times[:2].tolist() == [0.0, 30.0]
    assert np.isnan(times[2])
    assert finite(np.array([1e-9, 6e5]), "kc", 60.0).tolist() == [1e-9, 6e5]
    time_s = np.arange(40.0)
    held = np.repeat([7.0, 9.0], 20)[:, None]
    assert moves({"time_s": time_s, "sp": held}).tolist() == [20.0]
    assert not moves({"time_s": time_s, "sp": np.exp(-time_s)[:, None]}).size


def test_each_law_of_a_case_has_its_colour():
    laws = ("linearized_pid", "pid", *(f"law_{i}" for i in range(len(PALETTE) - 1)))
    for baseline in ("pid", "linearized_pid"):
        assert len({colour_of(law, laws, baseline) for law in laws}) == len(laws)
        assert colour_of(baseline, laws, baseline) == BASELINE_COLOUR
