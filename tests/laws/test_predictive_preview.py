"""The predictive law on a known recipe: the slope of the set points goes on over the horizon."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from identified_models import TOP, first_order, random_model
from predictive_loops import closed, law_of, row

from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.laws.predictive.set_point_course import SetPointCourse

SMALL = {"horizon": 12, "moves": 5}
changes = st.floats(-1, 1)


@given(now=changes, change=changes, before=changes)
@settings(max_examples=50, deadline=None)
def test_a_recipe_goes_on_with_the_smaller_of_its_last_slopes(now: float, change: float, before: float) -> None:
    recipe = SetPointCourse(4, 1, (row(-2.0), row(1.5)), ramp=True)
    past = [row(now - change)[None], row(now - change - before)[None]]
    found = recipe(row(now)[None], past)[0].numpy()
    slope = np.sign(change) * min(abs(change), abs(before)) if change * before > 0 else 0.0
    np.testing.assert_allclose(found, np.clip(now + slope * np.arange(1, 5), -2.0, 1.5), atol=1e-12)


def test_several_set_points_have_slopes_of_their_own() -> None:
    recipe = SetPointCourse(3, 2, None, ramp=True)
    found = recipe(row(1.0, 5.0)[None], [row(0.9, 5.2)[None], row(0.8, 5.4)[None]])
    np.testing.assert_allclose(found.reshape(3, 2), [[1.1, 4.8], [1.2, 4.6], [1.3, 4.4]])
    held = SetPointCourse(3, 2, None, ramp=False)(row(1.0, 5.0)[None], [])
    np.testing.assert_array_equal(held.reshape(3, 2), [[1.0, 5.0]] * 3)


@pytest.mark.parametrize("n_hidden", [0, 5])
def test_a_known_ramp_is_followed_more_closely(n_hidden: int) -> None:
    """Up and down at .02 a sample, flat between: without preview the law is late by its moves' price and dead time."""
    model = random_model(6, n_hidden=n_hidden) if n_hidden else first_order(pole=0.9, dead=3)
    gain = 2.0 if not n_hidden else float(closed(law_of(model, **SMALL), model, np.full((60, 1), TOP))[0].max()) / 2
    course = np.concatenate([np.zeros(5), np.linspace(0, 0.5, 26), np.full(10, 0.5), np.linspace(0.5, 0, 26)])
    sp = gain * course[:, None]
    held, ramp = (closed(law_of(model, **SMALL, preview=p), model, sp)[0] for p in ("held", "ramp"))
    errors = [np.abs(y[1:] - sp[1:]).mean() for y in (held, ramp)]
    assert errors[1] < 0.6 * errors[0]


def test_steps_of_the_set_point_are_no_recipe() -> None:
    model, sp = first_order(dead=1), np.repeat([1.0, -0.5], 20)[:, None]
    held, ramp = (closed(law_of(model, **SMALL, preview=p), model, sp) for p in ("held", "ramp"))
    np.testing.assert_allclose(ramp[1], held[1], atol=1e-12)


def test_a_cold_start_has_no_slope_and_the_next_two_samples_give_one() -> None:
    law = law_of(first_order(), **SMALL, preview="ramp")
    none, state, moved = torch.zeros(0, dtype=torch.float64), torch.zeros(law.n_state, dtype=torch.float64), []
    assert law.n_state == law_of(first_order(), **SMALL).n_state + 2
    for sp in (1.0, 1.1, 1.2):
        _, state, _ = law(row(sp), row(0.0), none, row(0.0), state)
        moved.append(state[-2:].tolist())
    np.testing.assert_allclose(moved, [[1.0, 1.0], [1.1, 1.0], [1.2, 1.1]])


def test_a_recipe_beyond_a_soft_limit_counts_as_one_at_the_limit() -> None:
    model, sp = first_order(), np.minimum(0.05 * np.arange(60), 1.5)[:, None]
    y, _, _ = closed(law_of(model, **SMALL, preview="ramp", cv_high=(0.8,)), model, sp)
    assert y.max() < 0.803
    assert y[-1, 0] == pytest.approx(0.8, abs=1e-3)


def test_a_word_that_is_no_preview_is_refused() -> None:
    with pytest.raises(ParamsError, match="preview is 'known'"):
        parse(Predictive.Params, {"preview": "known"}, "predictive")
    with pytest.raises(ValueError, match="preview is 'known'; allowed are held, ramp"):
        Predictive.Params(preview="known")
