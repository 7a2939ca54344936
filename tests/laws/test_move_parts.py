"""The next move of a predictive law in parts: they sum to it, and the first one is what happened."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from benchmark_modules import benchmark_modules
from hypothesis import given, settings
from hypothesis import strategies as st
from identified_models import random_model
from predictive_loops import law_of

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.predictive.move_parts import Explained, ExplainedPredictive

few = settings(max_examples=6, deadline=None)
made = benchmark_modules(["_situations"])._situations
LINEAR, NETWORK = (2, 2, 0), (2, 2, 5)  # outputs, MVs, units
THIRTY = [(LINEAR, 21, s) for s in made.SITUATIONS] + [(NETWORK, 3, s) for s in made.SITUATIONS[:8]]


def loop_of(seed: int, n_y: int, n_mv: int, units: int) -> Any:
    model = made.made_model(seed, n_y, n_mv, units)
    return made.MadeLoop(model, made.law_over(model))


def explained(loop: Any) -> Explained:
    with torch.no_grad():
        return loop.explained(*loop.inputs())


@few
@given(
    seed=st.integers(0, 2**16),
    size=st.sampled_from([(1, 1), (2, 2), (1, 2), (3, 3), (2, 1)]),
    units=st.sampled_from([0, 4]),
    rate=st.booleans(),
)
def test_the_parts_sum_to_the_move_whatever_operators_do(
    seed: int, size: tuple[int, int], units: int, *, rate: bool
) -> None:
    """Random operators' values, set points out of reach, readings that are not fresh; limits are active."""
    rng, (n_y, n_mv) = np.random.default_rng(seed), size
    model = random_model(seed, n_y, n_mv, 1, n_x=5, n_hidden=units)
    law = law_of(model, horizon=12, operate={}, mv_rate=0.3 if rate else None)
    module, state = ExplainedPredictive(law).eval(), torch.zeros(law.n_state, dtype=torch.float64)
    mv, x = torch.zeros(n_mv, dtype=torch.float64), torch.zeros(model.n_x, dtype=torch.float64)
    active = 0
    for _ in range(12):
        operate = torch.tensor(
            [
                float(rng.uniform() < 0.8) * e.high
                if e.what in ("use", "track", "rest_use")
                else rng.uniform(e.low, e.high)
                for e in law.operate
            ],
            dtype=torch.float64,
        )
        places = {e.name: i for i, e in enumerate(law.operate)}
        for name, i in places.items():
            if name.endswith(".low"):
                ends = sorted((float(operate[i]), float(operate[places[name[:-3] + "high"]])))
                operate[i], operate[places[name[:-3] + "high"]] = ends[0], ends[1]
        sp, dv, fresh = (
            torch.from_numpy(v) for v in (rng.uniform(-3, 3, n_y), rng.uniform(-1, 1, 1), rng.integers(0, 2, n_y))
        )
        given_all = (sp, model.measured(x), dv, mv, state, operate, fresh.double())
        with torch.no_grad():
            found, own = module(*given_all), law(*given_all)
        parts = found.parts.reshape(n_mv, -1)
        span = law.high - law.low
        assert torch.isfinite(parts).all()
        assert ((parts.sum(-1) - found.move).abs() <= 1e-9 * span).all()
        assert torch.equal(found.mv, own[0])
        assert torch.equal(found.state_next, own[1])
        active += sum(
            float(v.abs()) > 0
            for (c, _), v in zip(module.parts, parts.sum(0), strict=True)
            if c in ("mv_low", "mv_high")
        )
        mv, state = own[0], own[1]
        x = model(torch.cat([x, mv, dv]))
    assert active  # else no limit was ever tried


def test_a_law_at_rest_has_no_parts() -> None:
    loop = loop_of(21, *LINEAR)
    assert explained(loop).parts.abs().max() < 1e-4


@pytest.mark.parametrize(("seed", "kind"), [(21, LINEAR), (3, NETWORK)], ids=["linear", "network"])
def test_one_change_from_rest_is_the_whole_move(seed: int, kind: tuple[int, int, int]) -> None:
    loop = loop_of(seed, *kind)
    loop.dv[0] += 0.2
    for move in loop.moves():
        first = move.first
        assert (first.cause, first.signal) == ("disturbance", "d0")
        assert first.value == pytest.approx(move.move, rel=0.05, abs=5e-3)  # a network's errors weigh in


def test_two_readings_share_the_correction_as_the_filter_does() -> None:
    """A load at both outputs: the parts of a linear law without bounds are those of each load alone, and sum."""
    both = []
    for loads in ([0.05, 0.0], [0.0, -0.04], [0.05, -0.04]):
        loop = loop_of(21, *LINEAR)
        loop.load[:] = torch.tensor(loads, dtype=torch.float64)
        loop.step()
        news = explained(loop).news
        both.append(news[1:])
    assert torch.allclose(both[0] + both[1], both[2], atol=1e-6)
    assert both[0][0] == pytest.approx(0.05, abs=1e-4)
    assert both[0][1].abs() < 1e-4


def test_the_courses_are_what_the_model_does_under_the_plan() -> None:
    loop = loop_of(3, *NETWORK)
    loop.sp[0] += 0.3
    found, law, model = explained(loop), loop.law, loop.model
    z = found.z.reshape(-1, model.n_mv)
    course = torch.from_numpy(law.moves.profile) @ z
    x, ys = loop.x.clone(), []
    with torch.no_grad():
        for mv in course:
            x = model(torch.cat([x, mv, loop.dv]))
            ys.append(model.measured(x))
    y = found.y.reshape(law.moves.horizon, -1)
    assert (torch.stack(ys) - y).abs().max() < 0.01 * 0.3
    assert torch.allclose(z[0], found.mv, atol=1e-12)


def test_the_first_cause_is_right_in_28_of_thirty_situations() -> None:
    loops = {kind: (made.made_model(seed, *kind), seed) for kind, seed, _ in THIRTY}
    laws = {kind: made.law_over(model) for kind, (model, _) in loops.items()}
    right = []
    for kind, _, situation in THIRTY:
        loop = made.MadeLoop(loops[kind][0], laws[kind])
        assert loop.rests
        right.append(situation.right(loop)[0])
    assert len(right) == 30
    assert sum(right) >= 28


def test_an_mv_out_of_use_has_no_other_part() -> None:
    loop = loop_of(21, *LINEAR)
    loop.set(u0__use=0)
    loop.sp[0] += 0.2
    out, other = loop.moves()
    assert (out.move, out.first.cause) == (0.0, "not_in_use")
    assert (other.first.cause, other.first.signal) == ("setpoint", "y0")


def test_a_law_without_operate_explains_nothing() -> None:
    with pytest.raises(LawError, match="operate"):
        ExplainedPredictive(law_of(random_model(3), horizon=12))
