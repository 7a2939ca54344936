"""The coolant-held CSTR's tests, its own figures, and the checks of what the paper states of its plant."""

from __future__ import annotations

import numpy as np
import pytest
from henson_seborg_cstr_parts import local_models

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.henson_seborg_cstr.case import HELD_OUT_RANGE, HOLD
from loopwright.pipeline.cases.henson_seborg_cstr.paper import CLAIMS, hopf_point, rekindling_flow, ultimate_gain
from loopwright.pipeline.cases.henson_seborg_cstr.pictures import PICTURES
from loopwright.pipeline.cases.henson_seborg_cstr.plant import HensonSeborgCstr
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.verdicts import close

CASE = CASES["henson_seborg_cstr"]


@pytest.fixture(scope="module")
def plant() -> HensonSeborgCstr:
    return HensonSeborgCstr()


@pytest.fixture(scope="module")
def tests():
    return CASE.scenarios()


def test_up_and_down_are_the_printed_levels(tests):
    up, down = (tests[name][0].sp[::HOLD, 0] for name in ("up", "down"))
    assert up.tolist() == [0.02, 0.02, 0.04, 0.06, 0.08, 0.10, 0.12, 0.13]
    assert down.tolist() == [0.13, 0.13, 0.12, 0.10, 0.08, 0.06, 0.04, 0.02]
    assert {len(tests[name][0].sp) for name in ("up", "down")} == {8 * HOLD}


def test_jumps_are_five_minutes_and_twenty_five(tests):
    for name, ends in (("jump", (0.02, 0.13)), ("jump_down", (0.13, 0.02))):
        sp = tests[name][0].sp[:, 0]
        assert (sp[0], sp[-1]) == ends
        assert np.flatnonzero(np.diff(sp)).tolist() == [249]
        assert len(sp) == 1500


def test_every_test_starts_at_rest_within_the_range(tests, plant):
    for scenario in (s for group in tests.values() for s in group):
        rows = plant.with_parameters({k: float(v[0]) for k, v in scenario.changes.items()})
        rate = np.array(rows.rate(scenario.x0, scenario.mv0, [], rows.parameters()))
        assert np.abs(rate).max() < 1e-7
        assert 20.0 < scenario.mv0[0] < 150.0


def test_held_out_reaches_beyond_the_paper_and_stays_off_the_stability_limit(tests, plant):
    levels = np.concatenate([s.sp[:, 0] for s in tests["held_out"]])
    assert levels.min() < 0.02
    assert levels.max() > 0.13
    assert HELD_OUT_RANGE[1] < hopf_point(plant)[0]


def test_feed_changes_are_told_to_nobody(tests):
    assert [set(tests[n][0].changes) for n in ("feed_temperature", "feed_concentration")] == [{"T_f"}, {"C_f"}]


def test_score_adds_iae_overshoots_and_the_last_error(tests):
    scenario = tests["up"][0]
    cv = scenario.sp[:, 0].copy()
    cv[1000:1050] = 0.02  # one minute late
    cv[3500], cv[3600], cv[-1] = 0.12, 0.131, 0.1301
    found = CASE.score(scenario, np.column_stack([cv, cv]), np.zeros((len(cv), 1)))
    assert found["iae"] == pytest.approx(0.02 * (50 * 0.02 + 0.01 + 0.001 + 0.0001))
    assert found["overshoot_last"] == found["overshoot_max"] == pytest.approx(0.1)
    assert found["last_error"] == pytest.approx(1e-4)
    assert set(found) >= {"mae", "max_asse"}


def test_operating_points_are_held_to_their_last_printed_digit(plant):
    """Table 1 can fail: the coolant flows printed for points 2 to 4 do not follow from their temperatures."""
    (table,) = (t for t in CASE.tables if t.number == 1)
    assert len(table.rows) == 15
    assert all(row.within is not None and row.within <= 5e-3 * row.paper for row in table.rows)
    at = [plant.steady_state_at(cv) for cv in local_models(plant).x[:, 0].tolist()]
    for signal, ours, wrong in (("T", [x[1] for x, _ in at], ()), ("q_c", [mv[0] for _, mv in at], (2, 3, 4))):
        rows = [row for row in table.rows if row.label.startswith(signal)]
        apart = [i for i, (row, v) in enumerate(zip(rows, ours, strict=True), 1) if not close(v, row.paper, row.within)]
        assert apart == list(wrong)


def test_hopf_point_is_not_the_printed_one(plant):
    assert hopf_point(plant) == pytest.approx((0.14028, 111.77), rel=1e-4)


def balance(plant: HensonSeborgCstr, t: float, q_c: float) -> float:
    """dT/dt at the concentration that is steady at this temperature."""
    c = 1.0 / (1.0 + plant.K0 * np.exp(-plant.E_R / t))
    rate = np.array(plant.rate([c, t], [q_c], [], plant.parameters())).ravel()
    assert abs(rate[0]) < 1e-9
    return float(rate[1])


@pytest.mark.parametrize(("q_c", "count"), [(11.0, 1), (11.2, 3), (20.0, 3), (119.6, 3), (119.8, 1)])
def test_three_steady_states_one_of_them_gone_out(plant, q_c, count):
    temperatures = np.linspace(351.0, 560.0, 2_000)
    signs = np.sign([balance(plant, float(t), q_c) for t in temperatures])
    assert len(np.nonzero(np.diff(signs))[0]) == count


def test_less_coolant_than_the_actuator_allows_would_rekindle_it(plant):
    least = rekindling_flow(plant)
    assert least == pytest.approx(11.10, abs=0.01)
    gone_out = np.array([0.9448, 359.2])
    for q_c, burns in ((0.95 * least, True), (1.05 * least, False)):
        x, step = gone_out, plant.stepper()
        for _ in range(4000):
            x = step(x, np.array([q_c]), plant.dv_nominal, plant.parameters())
        assert (x[0] < 0.05) == burns


def test_only_the_sampling_gives_the_local_models_an_ultimate_gain(plant):
    for lin in local_models(plant).linearizations():
        continuous = lin.a - 1e9 * lin.b @ lin.c[:1]
        assert np.linalg.eigvals(continuous).real.max() < 0
        gain = ultimate_gain(lin, plant.period_s)
        assert ultimate_gain(lin, plant.period_s / 2) > 1.5 * gain


def test_every_claim_has_a_check_and_none_breaks_without_evidence():
    nothing = Evidence(CASE, {}, {}, {})
    for check in (*CLAIMS.statements, *CLAIMS.acceptance):
        assert check.statement(nothing).holds in {None, False}
    for picture in PICTURES:
        with pytest.raises(NotMeasuredError):
            picture.draw(nothing)
