"""What every law in LAWS must hold, whatever it computes."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from quick_laws import QUICK_PARAMS, plant_of, quick_parts, rest_points
from shipped import required
from torch import Tensor

from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.laws.reference.reference_law import ReferenceLaw
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.serving import Controller

# A law is the same for all examples: nothing of it changes from one to the next.
# An example of the range is 8 steps of 16 rows, one of the rows 2 steps of 4.
repeated = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
seeds = st.integers(0, 2**32 - 1)
RATE = 0.014  # of the MV's range
KICK = 0.05  # of the MV's range


class Step(NamedTuple):
    mv: Tensor
    state: Tensor
    info: Tensor


class Inputs(NamedTuple):
    sp: Tensor
    pv: Tensor
    dv: Tensor
    mv_applied: Tensor


def step(law: ControlLaw, inputs: Inputs, state: Tensor | None = None) -> Step:
    if state is None:
        state = torch.zeros(*inputs.sp.shape[:-1], law.n_state, dtype=torch.float64)
    with torch.no_grad():
        return Step(*law(*inputs, state))


def drawn(law: ControlLaw, rng: np.random.Generator, *batch: int, wide: float = 1.0) -> Inputs:
    """Inputs over the signals' ranges, or ranges ``wide`` times as wide; the applied MV always within its own."""

    def uniform(group: str, factor: float) -> Tensor:
        signals = getattr(law.signals, group)
        low, high = (np.array([getattr(s, end) for s in signals]) for end in ("low", "high"))
        middle, half = (low + high) / 2, (high - low) / 2 * factor
        return torch.from_numpy(middle + half * rng.uniform(-1, 1, (*batch, len(signals))))

    sp, pv, dv, mv = (uniform(g, w) for g, w in (("sp", wide), ("pv", wide), ("dv", wide), ("mv", 1.0)))
    for i, s in enumerate(law.signals.mv):
        if s.values:
            mv[..., i] = torch.from_numpy(rng.choice(s.values, batch))
    return Inputs(sp, pv, dv, mv)


def at_rest(law: ControlLaw, plant: EquationPlant, cv: float) -> Inputs:
    """The plant at the steady state of ``cv``, the set point there too."""
    x, mv = plant.steady_state_at(cv)
    pv = torch.from_numpy(plant.measure(x).copy())
    return Inputs(pv[: len(law.signals.sp)], pv, torch.from_numpy(plant.dv_nominal), torch.from_numpy(mv))


def span(law: ControlLaw) -> float:
    return float((law.high - law.low).max())


def test_name_and_params(law: ControlLaw) -> None:
    assert LAWS[law.name] is type(law)
    assert law.title
    params = parse(law.Params, required(law.name), law.name)
    assert params == law.Params(**required(law.name))
    assert params.mv_rate is None
    assert dataclasses.fields(law.Params)
    with pytest.raises(dataclasses.FrozenInstanceError):
        params.mv_rate = 1.0


def test_shapes_and_info(law: ControlLaw) -> None:
    for batch in ((), (3,), (2, 3)):
        out = step(law, drawn(law, np.random.default_rng(0), *batch))
        assert out.mv.shape == (*batch, len(law.signals.mv))
        assert out.state.shape == (*batch, law.n_state)
        assert out.info.shape == (*batch, len(law.info))
    assert len(set(law.info)) == len(law.info)


def test_every_number_is_float64(law: ControlLaw) -> None:
    out = step(law, drawn(law, np.random.default_rng(1)))
    assert {t.dtype for t in out} == {torch.float64}
    numbers = [*law.named_parameters(), *law.named_buffers()]
    assert [name for name, value in numbers if value.is_floating_point() and value.dtype != torch.float64] == []


@given(seed=seeds, wide=st.sampled_from([1.0, 3.0, 1e4]))
@repeated
def test_mv_stays_in_its_range_whatever_comes(law: ControlLaw, seed: int, wide: float) -> None:
    rng = np.random.default_rng(seed)
    state = None
    for _ in range(8):
        out = step(law, drawn(law, rng, 16, wide=wide), state)
        assert (out.mv >= law.low).all()
        assert (out.mv <= law.high).all()
        for i, s in enumerate(law.signals.mv):
            assert s.values is None or torch.isin(out.mv[..., i], torch.tensor(s.values, dtype=torch.float64)).all()
        assert torch.isfinite(out.state).all()
        state = out.state


@pytest.mark.parametrize("name", sorted(LAWS))
def test_mv_stays_within_its_rate(make_law, name: str) -> None:
    continuous = [i for i, s in enumerate(plant_of(name).mv_signals) if s.values is None]
    signal = plant_of(name).mv_signals[continuous[0]]
    rate = RATE * (signal.high - signal.low)
    law = make_law(name, mv_rate=rate)
    assert torch.isfinite(law.rate).all()  # also of an MV without a rate
    rng = np.random.default_rng(2)
    state = None
    for _ in range(30):
        inputs = drawn(law, rng, 64)
        out = step(law, inputs, state)
        state = out.state
        assert ((out.mv - inputs.mv_applied)[..., continuous].abs() <= rate * (1 + 1e-12)).all()
    for none in (0.0, -1.0, float("nan")):
        with pytest.raises(LawError, match="mv_rate"):
            make_law(name, mv_rate=none)


@given(seed=seeds)
@repeated
def test_batch_equals_its_rows(law: ControlLaw, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = drawn(law, rng, 4), drawn(law, rng, 4)
    together = step(law, second, step(law, first).state)
    for i in range(4):
        one, two = (Inputs(*(t[i] for t in inputs)) for inputs in (first, second))
        alone = step(law, two, step(law, one).state)
        for batch, row in zip(together, alone, strict=True):
            torch.testing.assert_close(batch[i], row, rtol=1e-10, atol=1e-12 * span(law))


def test_a_step_leaves_nothing_behind(law: ControlLaw) -> None:
    rng = np.random.default_rng(3)
    inputs, other = drawn(law, rng), drawn(law, rng)
    before = step(law, inputs)
    step(law, other, step(law, other).state)
    after = step(law, inputs)
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_state_zero_is_no_past(law: ControlLaw) -> None:
    """Without a past, a law adds to the applied MV, or estimates the plant's state by it, or does not look at it."""
    inputs = drawn(law, np.random.default_rng(4))
    away = inputs._replace(mv_applied=law.low + law.high - inputs.mv_applied)
    change = step(law, away).mv - step(law, inputs).mv
    if law.estimates:  # its MV may be at a limit with either
        assert not torch.equal(step(law, away).state, step(law, inputs).state)
    elif law.velocity_form:
        assert change.abs().max() > 0
    else:
        assert change.abs().max() == 0


@pytest.mark.parametrize("which", range(3))
def test_start_on_set_point_keeps_the_actuator(law: ControlLaw, law_plant: EquationPlant, which: int) -> None:
    if not law.velocity_form:
        pytest.skip("computes its MV afresh: on set point as accurate as its model")
    inputs = at_rest(law, law_plant, rest_points(law_plant)[which])
    state = None
    for _ in range(20):
        out = step(law, inputs, state)
        state = out.state
        torch.testing.assert_close(out.mv, inputs.mv_applied, rtol=0, atol=1e-9 * span(law))


def test_manual_to_auto_does_not_bump(law: ControlLaw, law_plant: EquationPlant) -> None:
    """In manual the law is stepped and not obeyed; what it does first in auto follows the error alone."""
    if not law.velocity_form:
        pytest.skip("computes its MV afresh: in auto it goes where its model says")
    rest = at_rest(law, law_plant, rest_points(law_plant)[1])
    rng = np.random.default_rng(5)
    state = None
    for _ in range(40):  # the operator moves the MV, the set point is elsewhere, the plant follows some course
        state = step(law, drawn(law, rng), state).state
    for _ in range(3):
        state = step(law, rest, state).state
    torch.testing.assert_close(step(law, rest, state).mv, rest.mv_applied, rtol=0, atol=1e-3 * span(law))


@pytest.mark.parametrize("held", [3, 60])
@pytest.mark.parametrize("away", [0.1, 0.9])
def test_a_stuck_actuator_that_comes_free_on_set_point_does_not_kick(
    law: ControlLaw, law_plant: EquationPlant, away: float, held: int
) -> None:
    """The plant rests under an MV that is stuck; the set point is elsewhere, and then put where the plant is.

    Nothing is to be done, and a law without a past does nothing. What the law did with the error while it stood, the
    actuator has never received; to take it back is a kick. What remains is a `ramp` law's slope of the set point.
    """
    if not law.velocity_form:
        pytest.skip("computes its MV afresh: where its model says, whatever was applied")
    if isinstance(law, ReferenceLaw):
        pytest.skip("follows its reference on while its request is within 1 % of the applied MV")
    rest = at_rest(law, law_plant, rest_points(law_plant)[1])
    sp = law_plant.sp_signals[0]
    elsewhere = rest._replace(sp=torch.full_like(rest.sp, sp.low + away * (sp.high - sp.low)))
    state = None
    for inputs in [rest] * 3 + [elsewhere] * held:
        state = step(law, inputs, state).state
    for _ in range(20):
        out = step(law, rest, state)
        torch.testing.assert_close(out.mv, rest.mv_applied, rtol=0, atol=KICK * span(law))
        state = out.state


@pytest.mark.parametrize("group", ["sp", "pv"])
def test_nan_never_becomes_a_number(law: ControlLaw, group: str) -> None:
    inputs = drawn(law, np.random.default_rng(6))
    broken = getattr(inputs, group).clone()
    broken[0] = float("nan")
    assert torch.isnan(step(law, inputs._replace(**{group: broken})).mv).all()
    past = step(law, inputs).state
    assert torch.isnan(step(law, inputs._replace(**{group: broken}), past).mv).all()


@pytest.mark.parametrize("name", sorted(LAWS))
def test_the_parts_that_a_law_declares_are_enough_and_each_is_needed(name: str) -> None:
    cls, plant = LAWS[name], plant_of(name)
    parts, given = quick_parts(plant.name), cls.Params(**QUICK_PARAMS[name])
    if hasattr(given, "part"):
        given = dataclasses.replace(given, part=next(iter(parts)))
    declared = {part: parts[part] for part in cls.needs(given)}
    law = cls.design(given, declared, plant.signals, plant).eval()
    assert torch.isfinite(step(law, drawn(law, np.random.default_rng(9))).mv).all()
    assert len(declared) == len(cls.parts)
    for part in declared:
        rest = {name: model for name, model in declared.items() if name != part}
        with pytest.raises(LawError, match=f"law '{name}' needs a part.* '{part}'"):
            cls.design(given, rest, plant.signals, plant)


def test_exported_graph_equals_the_module(law: ControlLaw, tmp_path) -> None:
    """A loop through the runtime that will serve the file, each side on its own state and MV."""
    manifest = export(law, tmp_path / "law.onnx", case="contract", provenance={})
    assert (manifest.law, manifest.n_state, manifest.info) == (law.name, law.n_state, law.info)
    controller = Controller(tmp_path / "law.onnx")
    assert controller.manifest == manifest
    rng = np.random.default_rng(7)
    state, mv = torch.zeros(law.n_state, dtype=torch.float64), 0.5 * (law.low + law.high)
    served, served_mv = controller.cold_state(), mv.numpy()
    for _ in range(50):
        inputs = drawn(law, rng)
        out = step(law, inputs._replace(mv_applied=mv), state)
        sp, pv, dv = (t.numpy() for t in inputs[:3])
        got = controller.step(sp=sp, pv=pv, mv_applied=served_mv, state=served, dv=dv if dv.size else None)
        np.testing.assert_allclose(got.mv, out.mv.numpy(), rtol=1e-9, atol=1e-9 * span(law))
        np.testing.assert_allclose(got.info, out.info.numpy(), rtol=1e-7, atol=1e-7)
        state, mv, served, served_mv = out.state, out.mv, got.state, got.mv
