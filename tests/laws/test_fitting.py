"""A law is withheld from a plant that it cannot hold, with what was found of the plant."""

from __future__ import annotations

import re

import numpy as np
import pytest
from identified_models import first_order, made_signals
from quick_laws import plant_of

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.laws.suitability import require_fit
from loopwright.pipeline.models import Model
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant


def plant(model: Model, n: int = 1, **more: np.ndarray) -> IdentifiedPlant:
    names = ("a", "b", "c", "w1", "b1", "w2", "y_center", "y_scale", "v_center", "v_scale", "rest")
    arrays = {name: getattr(model, name).numpy() for name in names}
    return IdentifiedPlant(made_signals(n, n), IdentifiedArrays(**{**arrays, **more}))


ONE_STEP = ["gauss_newton_pid", "linearized_pid", "minimum_variance", "recursive_pid", "self_tuning_pid"]


@pytest.mark.parametrize("name", ONE_STEP)
def test_one_step_laws_are_withheld_from_dead_time(name: str) -> None:
    require_fit(LAWS[name], plant(first_order()))
    words = f"law '{name}' is withheld: y0 answers 6 samples after u0 moves, the law looks 1 ahead; choose law 'predic"
    with pytest.raises(LawError, match=re.escape(words)):
        require_fit(LAWS[name], plant(first_order(dead=5)))


@pytest.mark.parametrize("name", ONE_STEP)
def test_one_step_laws_are_withheld_from_an_inverse_response(name: str) -> None:
    a, b = np.array([[0.9, -0.2], [0.0, 0.5]]), np.array([[-0.1], [0.5]])  # gain -3 of a response that starts at -.1
    model = first_order()
    rising = plant(model, a=a, b=-b, c=np.zeros(2), w1=np.zeros((0, 3)), w2=np.zeros((2, 0)), rest=np.zeros((2, 3)))
    require_fit(LAWS[name], rising)
    turned = plant(
        model, a=np.array([[0.9, 0.2], [0.0, 0.5]]), b=b, c=np.zeros(2), w1=np.zeros((0, 3)), w2=np.zeros((2, 0)),
        rest=np.zeros((2, 3)),
    )  # fmt: skip
    with pytest.raises(LawError, match="first goes the other way after u0 moves, by 10 % of its answer at sample 1,"):
        require_fit(LAWS[name], turned)


WITHHELD = {
    *ONE_STEP, "inverse_dob", "forward_dob", "model_reference", "model_reference_two_error", "pi_reference"
}  # fmt: skip
"""Laws that a dead time of the only PV is too long for."""


@pytest.mark.parametrize("name", sorted(LAWS))
def test_a_sentence_names_the_law_what_was_measured_and_what_to_do(name: str) -> None:
    late = plant(first_order(dead=5))
    if name not in WITHHELD:
        require_fit(LAWS[name], late)
        return
    with pytest.raises(LawError) as refused:
        require_fit(LAWS[name], late)
    said = str(refused.value)
    assert said.startswith(f"law '{name}' is withheld: ")
    assert re.search(r"y0 answers (after )?6\b", said)
    assert said.endswith("; choose law 'predictive' or 'pid', or remove the section")


@pytest.mark.parametrize("name", sorted(LAWS))
def test_laws_of_one_loop_say_so_and_plants_in_equations_are_left_alone(name: str) -> None:
    law = LAWS[name]
    require_fit(law, plant_of(name))
    two = plant(
        first_order(), 2, a=0.5 * np.eye(2), b=np.eye(2), c=np.zeros(2), w1=np.zeros((0, 4)), w2=np.zeros((2, 0)),
        y_center=np.zeros(2), y_scale=np.ones(2), v_center=np.zeros(2), v_scale=np.ones(2), rest=np.zeros((2, 5)),
    )  # fmt: skip
    if law.one_loop:
        with pytest.raises(
            LawError, match="is withheld: it controls one variable by one; got 2 set points and 2 MVs; choose law"
        ):
            require_fit(law, two)
    else:
        require_fit(law, two)
