"""What uncertain answers of several loops are worth: the margin of integral action over what a record leaves open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loopwright.pipeline.models.identified.model_validation import ProvenAnswer
from loopwright.pipeline.models.identified.open_answers import MOST_OPEN, sign_margin, sign_margins, unused_answers
from loopwright.pipeline.models.identified.structure import Structure

CERTAIN = ProvenAnswer(1.0, 0.9, 1.1, 1, 9, 1.0, 0.05)
GAINS = np.array([[1.0, 0.3, -0.1], [-0.3, 0.8, 0.2], [0.4, -0.2, 1.0]])


def answers_of(gains: np.ndarray, sd: dict[tuple[int, int], float]) -> dict[tuple[int, int], ProvenAnswer]:
    """An answer of each pair, certain unless a larger ``sd`` is given."""
    return {
        (i, j): replace(CERTAIN, model=g, low=0.9 * g, high=1.1 * g, direct=g, sd=sd.get((i, j), 0.05 * abs(g)))
        for (i, j), g in np.ndenumerate(gains)
    }


def integral_loop(plant: np.ndarray, model: np.ndarray) -> float:
    """The largest radius of slow integral action u+ = u + .01 G^-1 e on a plant of gains."""
    return float(np.abs(np.linalg.eigvals(np.eye(len(plant)) - 0.01 * plant @ np.linalg.inv(model))).max())


def test_certain_answers_keep_the_whole_worth() -> None:
    """Without an open answer there is one plant, the model."""
    assert sign_margin(answers_of(GAINS, {}), np.zeros((3, 3)), 2.0) == pytest.approx(1.0)


def test_a_weak_coupling_that_is_open_costs_little_and_a_main_answer_all() -> None:
    """Both have an uncertain sign: of the coupling either serves, of the answer that holds its PV only one."""
    weak = sign_margin(answers_of(GAINS, {(1, 2): 0.14}), np.zeros((3, 3)), 2.0)
    main = sign_margin(answers_of(GAINS, {(1, 1): 0.5}), np.zeros((3, 3)), 2.0)
    assert weak > 0.7
    assert main < 0


@pytest.mark.parametrize("seed", range(20))
def test_above_zero_each_plant_that_is_as_likely_is_stable_under_slow_integral_action(seed: int) -> None:
    """And below it one is not."""
    rng = np.random.default_rng(seed)
    gains = rng.normal(size=(2, 2)) + 1.5 * np.eye(2)
    sd = {(0, 1): 0.4 * abs(gains[0, 1]) + 0.3, (1, 0): 0.4 * abs(gains[1, 0]) + 0.3}
    margin = sign_margin(answers_of(gains, sd), np.zeros((2, 2)), 2.0)
    radii = []
    for turn in np.linspace(0, 2 * np.pi, 360, endpoint=False):
        plant = gains.copy()
        plant[0, 1] += 2 * np.cos(turn) * sd[0, 1]
        plant[1, 0] += 2 * np.sin(turn) * sd[1, 0]
        radii.append(integral_loop(plant, gains))
    if abs(margin) > 0.02:
        assert (max(radii) < 1) == (margin > 0)


def test_answers_that_are_open_together_are_not_all_at_their_ends_at_once() -> None:
    """A dissolver's record: three answers open, the weakest in sign. All at their ends the loops hardly stand."""
    gains = np.array([[-0.18, -0.0798], [-0.246, 0.766]])
    found = answers_of(gains, {})
    for place, direct, sd in (((0, 1), -0.0124, 0.05), ((1, 0), -0.205, 0.077), ((1, 1), 0.775, 0.26)):
        found[place] = replace(found[place], direct=direct, sd=sd)
    assert sign_margin(found, np.zeros((2, 2)), 2.0) == pytest.approx(0.30, abs=0.01)


def test_one_open_answer_is_at_either_end() -> None:
    """The margin is that of the worse of two plants."""
    found = answers_of(GAINS, {(1, 2): 0.14})
    worst = []
    for end in (-2, 2):
        plant = GAINS.copy()
        plant[1, 2] += end * 0.14
        worst.append(np.linalg.eigvals(plant @ np.linalg.inv(GAINS)).real.min())
    assert sign_margin(found, np.zeros((3, 3)), 2.0) == pytest.approx(min(worst))


def test_too_many_open_answers_or_one_without_a_number_prove_nothing() -> None:
    """Minus infinity: no plant was looked at."""
    gains = np.eye(3) + 0.2
    every = dict.fromkeys(np.ndindex(3, 3), 1.0)
    assert len(every) > MOST_OPEN
    assert sign_margin(answers_of(gains, every), np.zeros((3, 3)), 2.0) == -np.inf
    unknown = answers_of(gains, {}) | {(0, 1): ProvenAnswer(0.2, 0.1, 0.3, 1, 9)}
    assert sign_margin(unknown, np.zeros((3, 3)), 2.0) == -np.inf


def test_answers_that_nobody_uses_are_of_the_age_of_the_others() -> None:
    """Of slow plants the end of a curve is several times an answer of sixty rows, and the margin another."""
    rows = np.arange(1, 1001)
    slow = 1 - np.exp(-rows / 200)
    unit = np.zeros((2, 1000, 2))
    unit[0, :, 0], unit[1, :, 0], unit[1, :, 1] = slow, 0.2 * slow, slow
    used = {(0, 0): replace(CERTAIN, model=slow[29:60].mean(), first=30, last=60)}
    used[1, 1] = used[0, 0]
    structure = Structure("balanced", 1, (0, 0), (0, 0))
    found = unused_answers(used, unit, structure, (2, 2))
    assert found[0, 1] == pytest.approx(0.2 * slow[29:60].mean())
    assert found[0, 0] == found[1, 1] == found[1, 0] == 0
    late = unused_answers(used, unit, replace(structure, delays=(0, 10)), (2, 2))
    assert late[0, 1] == pytest.approx(0.2 * slow[19:50].mean())


# ----------------------------------------------------------------------------------------- variables with a range alone
def margins_of(gains: np.ndarray, sd: dict[tuple[int, int], float], n_cv: int = 1) -> dict[int, float]:
    """Of a plant whose answers have one age."""
    n_mv = gains.shape[1]
    structure = Structure("balanced", 1, (0,) * n_mv, (0,) * n_mv)
    unit = np.repeat(gains.T[:, None, :], 20, axis=1)
    return sign_margins(answers_of(gains, sd), unit, structure, n_cv, n_mv, 2.0)


EVAPORATOR = np.array([[-1.04, 0.90, -0.015], [8.32, -5.32, -8.47], [-0.026, 0.458, -0.145]])


def test_a_constraint_whose_main_answer_is_certain_stands_open_ones() -> None:
    """A pressure that the steam moves; what feed and product do to it is open, and is nothing on the plant."""
    open_ones = {(2, 0): 0.022, (2, 2): 0.30}
    margins = margins_of(EVAPORATOR, open_ones)
    assert margins[2] > 0.25
    assert margins[1] == 1.0


def test_a_constraint_whose_main_answer_is_open_is_worth_nothing() -> None:
    """Then the law would push the wrong way at its limit."""
    assert margins_of(EVAPORATOR, {(2, 1): 0.4})[2] < 0


def test_a_constraint_stands_no_answer_that_is_worth_something_only_beside_the_set_points() -> None:
    """Operators may take the others out: alone its loop would run away on a plant that the record leaves open."""
    gains = np.array([[1.0, 1.0], [0.1, 1.0]])
    wide = {(1, 1): 2.0}
    alone = sign_margin({(0, j): a for (i, j), a in answers_of(gains, wide).items() if i == 1}, np.zeros((1, 2)), 2.0)
    assert margins_of(gains, wide)[1] <= alone < 0


@pytest.mark.parametrize("seed", range(5))
def test_variables_with_set_points_have_the_margin_of_them_all_whatever_constraints_do(seed: int) -> None:
    gains = np.random.default_rng(seed).normal(size=(3, 3)) + 2 * np.eye(3)
    sd = {(0, 1): 1.0, (1, 0): 1.0, (2, 0): 1.0}
    controlled = {place: answer for place, answer in answers_of(gains, sd).items() if place[0] < 2}
    margins = margins_of(gains, sd, n_cv=2)
    assert margins[0] == margins[1] == pytest.approx(sign_margin(controlled, np.zeros((2, 3)), 2.0))


def test_with_one_mv_nothing_outweighs_an_open_answer() -> None:
    assert margins_of(np.array([[1.0], [0.5]]), {(1, 0): 0.5}) == {}
