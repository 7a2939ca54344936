"""The laws over a hybrid fuzzy model: its inverse, what of a recipe it can do, and what feedback adds."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jacketed_batch_reactor_parts
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shipped import required
from torch import Tensor

from loopwright.pipeline.cases import CASES, PLANTS
from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import LawError, ParamsError
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.laws.fuzzy.fuzzy_law import FuzzyLaw
from loopwright.pipeline.models.hybrid_fuzzy import HybridFuzzy

CASE = CASES["jacketed_batch_reactor"]
PLANT = CASE.plant
SIGNALS = PLANT.signals
PRINTED = jacketed_batch_reactor_parts.parts(PLANT)["printed"]
assert isinstance(PRINTED, HybridFuzzy)
RECIPE = CASE.scenarios()["same_model"][0].sp[:, 0]
NOISE = (0.05, 0.1)
HOT, COLD = 1.0, 2.0


class Loops(NamedTuple):
    pv: np.ndarray  # (loops, n, 2)
    mv: np.ndarray
    info: np.ndarray


def made(name: str, model: HybridFuzzy = PRINTED, **params: object) -> FuzzyLaw:
    cls = LAWS[name]
    law = cls.design(cls.Params(**required(name) | params), {"any": model}, SIGNALS, PLANT).eval()
    assert isinstance(law, FuzzyLaw)
    return law


def off(seeds: int, share: float) -> np.ndarray:
    """Consequents of printed models (seeds, ...) off by up to ``share``, of a1 what it lacks to 1."""
    rng = np.random.default_rng(5)
    theta = PRINTED.consequents.numpy()[None] * rng.uniform(1 - share, 1 + share, (seeds, 2, 4, 5))
    a1 = PRINTED.consequents.numpy()[None, :, 0]
    theta[:, :, 0] = 1 - (1 - a1) * rng.uniform(1 - share, 1 + share, a1.shape)
    return theta


def plants(theta: np.ndarray) -> Callable[[Tensor, Tensor], Tensor]:
    """A step of each plant (loops, 2) under its MVs (loops, 2)."""
    models = [HybridFuzzy(PRINTED.centres.tolist(), one.tolist(), PRINTED.core.tolist()) for one in theta]
    blend = torch.stack([torch.cat([m.first[None], m.rise]) for m in models])  # (loops, K, 8)

    def step(x: Tensor, mv: Tensor) -> Tensor:
        t, t_w = x[:, :1], x[:, 1:]
        into = torch.cat([torch.ones_like(t), models[0]._into(t_w)], dim=1)
        a1, a2, b, r = (into[:, None] @ blend).squeeze(1).split(2, dim=1)
        following = a1 * t_w + a2 * t + b * mv[:, :1] + r
        chosen = following.gather(1, (mv[:, 1:] - 1).long())
        return torch.cat([PRINTED.core_next(t, t_w), chosen], dim=1)

    return step


@torch.no_grad()
def loops(
    law: ControlLaw, step: Callable[[Tensor, Tensor], Tensor], count: int = 1, noise: tuple[float, float] = (0.0, 0.0),
    sp: np.ndarray = RECIPE, by_hand: Callable[[int], tuple[float, float] | None] = lambda k: None,
) -> Loops:  # fmt: skip
    x0, mv0 = PLANT.start
    x, mv = (torch.from_numpy(v).repeat(count, 1) for v in (x0, mv0))
    state, dv = torch.zeros(count, law.n_state, dtype=torch.float64), torch.zeros(count, 0, dtype=torch.float64)
    draws = torch.from_numpy(np.random.default_rng(3).standard_normal((len(sp), count, 2)) * noise)
    rows = []
    for k, level in enumerate(sp):
        asked, state, info = law(torch.full((count, 1), level, dtype=torch.float64), x + draws[k], dv, mv, state)
        hand = by_hand(k)
        mv = asked if hand is None else torch.tensor([hand], dtype=torch.float64).repeat(count, 1)
        rows.append((x, mv, info))
        x = step(x, mv)
    return Loops(*(torch.stack(column, dim=1).numpy() for column in zip(*rows, strict=True)))


def switches(run: Loops) -> np.ndarray:
    return np.count_nonzero(np.diff(run.mv[:, :, 1], axis=1), axis=1)


# ---------------------------------------------------------------- the inverse
@given(t=st.floats(18, 68), t_w=st.floats(12, 72), wanted=st.floats(20, 70), side=st.sampled_from([-1.0, 0.0, 1.0]))
@settings(max_examples=60, deadline=None)
def test_the_move_reaches_the_nearest_that_either_mode_can(t: float, t_w: float, wanted: float, side: float) -> None:
    law = made("fuzzy_feedforward")
    now = torch.tensor([[t, t_w]], dtype=torch.float64)
    line = PRINTED.jacket(now[:, :1], now[:, 1:])
    scalar = torch.tensor([[wanted]], dtype=torch.float64)
    side_, applied = torch.tensor([[side]], dtype=torch.float64), torch.tensor([[0.0, HOT]], dtype=torch.float64)
    mv, reached = law.move(line, scalar, side_, applied)
    grid = torch.cartesian_prod(torch.linspace(0, 1, 201, dtype=torch.float64), law.modes)
    every = PRINTED(torch.cat([now.expand(len(grid), 2), grid], dim=1))[:, 1]
    assert float((reached - scalar).abs()) <= float((every - wanted).abs().min()) + 1e-9
    torch.testing.assert_close(PRINTED(torch.cat([now, mv], dim=1))[:, 1:], reached, rtol=0, atol=1e-11)


def test_equal_modes_and_a_cheap_one_keep_the_present_mode() -> None:
    """Shut, both modes of a tied model do the same; the penalty outweighs what the other is nearer by."""
    theta = PRINTED.consequents.clone()
    theta[1, (0, 1, 3)] = theta[0, (0, 1, 3)]
    tied = HybridFuzzy(PRINTED.centres.tolist(), theta.tolist(), PRINTED.core.tolist())
    now = torch.tensor([[40.0, 45.0]], dtype=torch.float64)
    line = tied.jacket(now[:, :1], now[:, 1:])
    shut = line.base[:, :1]
    for side, mode in ((-1.0, HOT), (1.0, COLD)):
        at, applied = torch.tensor([[side]], dtype=torch.float64), torch.tensor([[0.5, mode]], dtype=torch.float64)
        mv, _ = made("fuzzy_feedforward", tied).move(line, shut, at, applied)
        assert mv[0].tolist() == pytest.approx([0.0, mode])
        dear = made("fuzzy_feedforward", tied, switch_penalty=0.6)
        other = HOT + COLD - mode
        for missed, expected in ((0.5, mode), (0.7, other)):
            wanted = shut + (missed if mode == COLD else -missed)
            assert float(dear.move(line, wanted, at, applied)[0][0, 1]) == expected


# ---------------------------------------------------------------- the recipe on the model itself
@pytest.fixture(scope="module")
def exact() -> Loops:
    return loops(made("fuzzy_feedforward"), plants(PRINTED.consequents.numpy()[None]))


def test_the_adjusted_reference_is_followed_to_rounding(exact: Loops) -> None:
    assert np.abs(exact.info[0, :-2, 0] - exact.pv[0, 2:, 0]).max() <= 1e-12
    assert np.abs(exact.info[0, :-1, 2] - exact.pv[0, 1:, 1]).max() <= 1e-12
    assert switches(exact).tolist() == [6]
    assert exact.pv[0, :, 1].min() >= 20 - 1e-9
    assert exact.pv[0, :, 1].max() <= 70 + 1e-9


def test_reference_figures(exact: Loops) -> None:
    adjusted = np.abs(exact.info[0, :, 1] - exact.info[0, :, 2]) > 1e-9
    assert np.count_nonzero(adjusted) == 251
    beyond = [
        s * (exact.pv[0, a:b, 0] - level)
        for a, b, level, s in ((0, 800, 62, 1), (800, 1600, 26, -1), (1600, 2000, 35, 1))
    ]
    assert [max(0.0, b.max()) for b in beyond] == pytest.approx([0, 0, 0.039], abs=1e-3)


@pytest.mark.parametrize("name", ["fuzzy_feedforward", "fuzzy_feedforward_pi", "fuzzy_feedforward_observer"])
def test_after_moves_by_hand_the_law_knows_where_the_plant_is(name: str) -> None:
    """The model follows the applied MVs: without noise and with the right model, nothing is left to correct."""
    rng = np.random.default_rng(1)
    moves = [(float(rng.uniform()), float(rng.choice([HOT, COLD]))) for _ in range(200)]
    run = loops(
        made(name),
        plants(PRINTED.consequents.numpy()[None]),
        sp=np.full(1200, 45.0),
        by_hand=lambda k: moves[k] if k < 200 else None,
    )
    assert np.abs(run.pv[0, -100:, 0] - 45.0).max() < 1e-6
    if name == "fuzzy_feedforward":  # the others' reference waits for the core that the operator took away from it
        assert np.abs(run.info[0, 200:-2, 0] - run.pv[0, 202:, 0]).max() <= 1e-12


# ---------------------------------------------------------------- a model that is off
@pytest.fixture(scope="module")
def without_feedback() -> Loops:
    """Six plants that the law's model does not describe, under the law that corrects nothing."""
    return loops(made("fuzzy_feedforward"), plants(off(6, 0.1)), 6)


@pytest.mark.parametrize(("name", "overshoot"), [("fuzzy_feedforward_pi", 0.4), ("fuzzy_feedforward_observer", 0.1)])
def test_feedback_leaves_no_offset_where_coefficients_are_off_and_the_signals_noisy(
    name: str, overshoot: float, without_feedback: Loops
) -> None:
    params = {"k_jacket": 0.5} if name.endswith("pi") else {}  # the printed cold gain is far from any of these
    run = loops(made(name, **params), plants(off(6, 0.1)), 6, NOISE)
    ends = [(slice(a, b), level, s) for a, b, level, s in ((0, 800, 62, 1), (800, 1600, 26, -1), (1600, 2000, 35, 1))]
    offsets = np.array(
        [
            [abs(np.mean(r.pv[:, part, 0][:, -50:] - level, axis=1)) for part, level, _ in ends]
            for r in (run, without_feedback)
        ]
    )
    assert offsets[0].max() <= 0.05
    assert offsets[1].max() > 1.0
    assert max((s * (run.pv[:, part, 0] - level)).max() for part, level, s in ends) <= overshoot


def test_a_dearer_switch_switches_less() -> None:
    step = plants(off(1, 0.0))
    found = [
        int(switches(loops(made("fuzzy_feedforward_observer", switch_penalty=p), step, 1, NOISE))[0])
        for p in (0.0, 0.6)
    ]
    assert found[0] > 5 * found[1]


@pytest.mark.parametrize("name", ["fuzzy_feedforward_pi", "fuzzy_feedforward_observer"])
def test_a_stuck_throttle_that_comes_free_on_set_point_does_not_kick(name: str) -> None:
    """Stuck with the core at rest, the set point 15 degC below it for ten minutes, then there: nothing is wound up."""
    step, stuck, away, after = plants(PRINTED.consequents.numpy()[None]), 1200, 60, 200
    throttle = (0.4, HOT)

    def run(level: float) -> Loops:
        sp = np.repeat([level, level - 15.0, level], [stuck - away, away, after])
        return loops(made(name), step, sp=sp, by_hand=lambda k: throttle if k < stuck else None)

    level = float(run(30.0).pv[0, stuck, 0])
    span = SIGNALS.sp[0].high - SIGNALS.sp[0].low
    assert np.abs(run(level).pv[0, stuck:, 0] - level).sum() / span < 0.2


def test_a_core_that_lags_draws_its_reference_along() -> None:
    """A level beyond the jacket's limit for good: nothing winds up, and the way back begins at once."""
    for name in ("fuzzy_feedforward_pi", "fuzzy_feedforward_observer"):
        law = made(name, jacket_high=50.0)
        run = loops(law, plants(PRINTED.consequents.numpy()[None]), sp=np.repeat([62.0, 40.0], [1500, 60]))
        assert abs(run.info[0, 1499, 0] - run.pv[0, 1499, 0]) < 0.5
        assert run.mv[0, 1500].tolist() == pytest.approx([1.0, COLD])


# ---------------------------------------------------------------- refusals
def test_a_model_without_an_inverse_is_refused() -> None:
    theta = PRINTED.consequents.clone()
    theta[1, 2, 0] = 0.1
    turned = HybridFuzzy(PRINTED.centres.tolist(), theta.tolist(), PRINTED.core.tolist())
    with pytest.raises(LawError, match="one way at every temperature"):
        made("fuzzy_feedforward", turned)
    with pytest.raises(LawError, match="two modes"):
        made("fuzzy_feedforward", HybridFuzzy([0, 1], [[[0, 0], [0, 0], [1, 1], [0, 0]]], [0.1, 0.9]))


def test_parts_signals_and_numbers_that_cannot_be_are_refused() -> None:
    cls, needed = LAWS["fuzzy_feedforward_observer"], required("fuzzy_feedforward_observer")
    two = {"a": PRINTED, "b": PRINTED}
    with pytest.raises(LawError, match="name it as `part`: the model set has a, b"):
        cls.design(cls.Params(**needed), two, SIGNALS, PLANT)
    with pytest.raises(LawError, match="which 'c' is not; the model set has a, b"):
        cls.design(cls.Params(**needed, part="c"), two, SIGNALS, PLANT)
    other = PLANTS["thiosulfate_cstr"]()
    with pytest.raises(LawError, match=r"T_j \(continuous\)"):
        cls.design(cls.Params(**needed), {"a": PRINTED}, other.signals, other)
    with pytest.raises(ParamsError, match=r"core_gain is 1\.5"):
        parse(cls.Params, {**needed, "core_gain": 1.5}, "controllers.x")
    with pytest.raises(ParamsError, match="ti_s 0"):
        parse(LAWS["fuzzy_feedforward_pi"].Params, {**required("fuzzy_feedforward_pi"), "ti_s": 0.0}, "controllers.x")


@pytest.mark.parametrize("law", jacketed_batch_reactor_parts.LAWS)
@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ({"jacket_low": 70.0, "jacket_high": 20.0}, "the lower one first"),
        ({"jacket_low": 30.0, "jacket_high": 30.0}, "the lower one first"),
        ({"jacket_low": np.nan}, "jacket_low is nan"),
        ({"jacket_high": np.inf}, "jacket_high is inf"),
        ({"switch_penalty": -0.1}, r"switch_penalty is -0\.1; it must be 0 or above"),
        ({"switch_penalty": np.nan}, "switch_penalty is nan"),
    ],
)
def test_numbers_of_the_cascade_that_make_no_sense_are_refused(law: str, numbers: dict[str, float], told: str) -> None:
    with pytest.raises(ParamsError, match=told):
        parse(LAWS[law].Params, required(law) | numbers, "controllers.x")


@pytest.mark.parametrize(
    ("law", "numbers", "told"),
    [
        ("fuzzy_feedforward_pi", {"kc": -1.0}, r"kc is -1\.0"),
        ("fuzzy_feedforward_pi", {"kc": np.nan}, "kc is nan"),
        ("fuzzy_feedforward_pi", {"ti_s": np.inf}, "ti_s is inf"),
        ("fuzzy_feedforward_pi", {"approach": 0.0}, "no set point is ever approached"),
        ("fuzzy_feedforward_pi", {"k_jacket": 1.1}, r"k_jacket is 1\.1"),
        ("fuzzy_feedforward_observer", {"approach": 0.0}, "no set point is ever approached"),
        ("fuzzy_feedforward_observer", {"approach": np.nan}, "approach is nan"),
        ("fuzzy_feedforward_observer", {"l_core": -0.1}, r"l_core is -0\.1"),
        ("fuzzy_feedforward_observer", {"k_jacket": 2.0}, r"k_jacket is 2\.0"),
    ],
)
def test_numbers_of_a_feedback_that_make_no_sense_are_refused(law: str, numbers: dict[str, float], told: str) -> None:
    with pytest.raises(ParamsError, match=told):
        parse(LAWS[law].Params, required(law) | numbers, "controllers.x")
