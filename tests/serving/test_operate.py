"""Operators change ranges, uses and limits of a running law: by name, checked, without a bump."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from operated_law import FASTEST, Given

from loopwright.serving import Controller, ControlLoop, LoopError, Mode, Sample
from loopwright.serving.errors import ContractError
from loopwright.serving.fields import nearest
from loopwright.serving.manifest import SWITCHES
from loopwright.serving.operating import Operate

pytest_plugins = ["small_laws", "operated_files"]


def sample(t: float = 299.0, p: float = 5.0, valve: float = 40.0, heat: float = 0.5) -> Sample:
    return Sample(np.array([t, p, 0.5]), np.array([valve, heat]))


def loop_of(controller: Controller, **options: Any) -> ControlLoop:
    return ControlLoop(controller, **{"sp": [300.0, 5.0], "mv": [40.0, 0.5], "mode": Mode.AUTO, **options})


def named(loop: ControlLoop) -> dict[str, float]:
    entries = loop.controller.manifest.operate
    return dict(zip([e.name for e in entries], loop.operate.tolist(), strict=True))


def test_it_begins_with_the_defaults_and_takes_changes_by_name(operated: Controller) -> None:
    loop = loop_of(operated)
    defaults = {e.name: e.default for e in operated.manifest.operate}
    assert named(loop) == defaults
    loop.set_operate({"valve.high": 45, "speed": np.float64(2.0)})
    assert named(loop) == {**defaults, "valve.high": 45.0, "speed": 2.0}
    command = loop.scan(sample())
    assert Given.of(operated.manifest, command.info).operate == named(loop)
    assert named(loop_of(operated, operate={"speed": 2.0})) == {**defaults, "speed": 2.0}
    loop.operate[:] = 9.0  # a copy
    assert named(loop)["speed"] == 2.0


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ({"valve.hihg": 50.0}, "valve.high"),
        ({"valve.high": 101.0}, "100"),
        ({"valve.use": 0.5}, "valve.use"),
        ({"valve.low": 60.0, "valve.high": 50.0}, "valve.low"),
        ({"speed": float("nan")}, "speed"),
        ({"speed": "fast"}, "speed"),
        ({"speed": True}, "speed"),
        ({"speed": [1.0, 2.0]}, "speed"),
        ({"speed": 2.0, "T.use": -1.0}, "T.use"),
        ([1.0] * 9, "operate"),
        (None, "operate"),
    ],
    ids=str,
)
def test_a_wrong_change_is_one_error_and_changes_nothing(operated: Controller, values: Any, names: str) -> None:
    loop = loop_of(operated, operate={"valve.high": 70.0})
    before = named(loop)
    with pytest.raises(LoopError, match=names) as error:
        loop.set_operate(values)
    assert "\n" not in str(error.value)
    assert named(loop) == before
    if isinstance(values, dict):
        with pytest.raises(LoopError, match=names):
            loop_of(operated, operate=values)


def test_a_law_that_does_not_read_it_says_so(not_operated: Controller) -> None:
    loop = loop_of(not_operated)
    assert loop.operate.shape == (0,)
    for made in (lambda: loop.set_operate({"speed": 2.0}), lambda: loop_of(not_operated, operate={"speed": 2.0})):
        with pytest.raises(LoopError, match="formula has no operate"):
            made()


def test_no_transfer_begins(operated: Controller) -> None:
    """A change takes the law's own way: the transfer after AUTO is over, and would be slower than it."""
    slow = loop_of(operated, transfer_s=1000.0)
    assert abs(slow.scan(sample(t=290.0)).mv[0] - 40.0) < 0.11  # the transfer itself
    loop = loop_of(operated, transfer_s=1000.0)
    loop.scan(sample(t=300.0))  # the law is where it wants to be, so the transfer is over
    loop.set_operate({"valve.low": 80.0})
    assert loop.scan(sample(t=300.0)).mv[0] == 40.0 + FASTEST


def test_in_manual_and_hold_the_law_is_stepped_with_it_all_the_same(operated: Controller) -> None:
    loop = loop_of(operated, mode=Mode.MANUAL)
    loop.set_operate({"valve.low": 80.0})
    command = loop.scan(sample())
    assert command.mv.tolist() == [40.0, 0.5]
    assert command.law_mv is not None
    assert command.law_mv[0] == 40.0 + FASTEST


# ------------------------------------------------------------------------------------------------------------- a swap
def swapped(loop: ControlLoop, to: Controller, trial: int = 2) -> list[Any]:
    loop.swap(to, trial)
    return [loop.scan(sample()) for _ in range(trial)]


def test_a_successor_takes_what_it_has_by_name_and_its_own_defaults(
    operated: Controller, otherwise_operated: Controller
) -> None:
    loop = loop_of(operated, operate={"valve.high": 60.0, "p.use": 0.0, "speed": 3.0})
    loop.swap(otherwise_operated, 3)
    loop.scan(sample())
    loop.set_operate({"valve.high": 55.0})  # during the trial: of the one in charge, and of the one on trial by name
    loop.scan(sample())
    loop.scan(sample())
    assert loop.controller is otherwise_operated
    assert named(loop) == {"valve.low": 10.0, "valve.high": 55.0, "p.use": 0.0, "caution": 2.0}
    assert Given.of(otherwise_operated.manifest, loop.scan(sample()).info).operate == named(loop)
    assert swapped(loop, operated)[-1].successor_mv is not None
    assert loop.controller is operated
    assert named(loop)["valve.high"] == 55.0
    assert named(loop)["speed"] == 3.0  # also what the one before has not


def test_a_successor_has_its_own_defaults_where_nobody_set_anything(
    operated: Controller, otherwise_operated: Controller
) -> None:
    loop = loop_of(operated)
    swapped(loop, otherwise_operated)
    assert loop.controller is otherwise_operated
    assert named(loop) == {e.name: e.default for e in otherwise_operated.manifest.operate}


def test_a_default_outside_the_successors_range_keeps_it_from_nothing(operated: Controller, narrow: Controller) -> None:
    loop = loop_of(operated)
    swapped(loop, narrow)
    assert loop.controller is narrow
    loop = loop_of(operated)
    loop.set_operate({"valve.low": 0.0})  # the default, but somebody's word
    swapped(loop, narrow)
    assert loop.controller is operated
    assert loop.successor is not None
    assert "valve.low" in loop.successor.reason


def test_what_was_set_outlasts_laws_that_lack_it(
    operated: Controller, otherwise_operated: Controller, not_operated: Controller
) -> None:
    loop = loop_of(operated, operate={"speed": 3.0})
    loop.set_operate({"valve.high": 90.0, "T.use": 0.0})  # an MV in hand would keep the law without `use` out
    for law in (otherwise_operated, not_operated, operated):
        swapped(loop, law)
        assert loop.controller is law
    defaults = {e.name: e.default for e in operated.manifest.operate}
    assert named(loop) == {**defaults, "speed": 3.0, "valve.high": 90.0, "T.use": 0.0}


def test_a_value_outside_the_successors_range_keeps_its_trial_from_counting(
    operated: Controller, otherwise_operated: Controller
) -> None:
    loop = loop_of(operated, operate={"valve.high": 45.0})
    swapped(loop, otherwise_operated, 3)
    assert loop.controller is operated
    assert loop.successor is not None
    assert loop.successor.good == 0
    assert "valve.high" in loop.successor.reason
    loop.set_operate({"valve.high": 60.0})
    for _ in range(3):
        loop.scan(sample())
    assert loop.controller is otherwise_operated


def test_a_swap_between_laws_with_and_without_it(operated: Controller, not_operated: Controller) -> None:
    loop = loop_of(operated, operate={"speed": 2.0}, bridge_s=50.0)
    loop.scan(sample())
    loop.swap(not_operated, 2)
    bad = sample(t=float("nan"))
    assert list(loop.scan(bad).bridged) == ["T"]
    assert loop.successor is not None
    assert loop.successor.reason  # it needs all of its readings
    loop.scan(sample())
    loop.scan(sample())
    assert loop.controller is not_operated
    assert loop.operate.shape == (0,)
    with pytest.raises(LoopError):
        loop.set_operate({"speed": 1.0})
    assert loop.scan(bad).mode is Mode.HOLD
    loop.set_mode(Mode.AUTO)
    swapped(loop, operated)
    assert loop.controller is operated
    assert named(loop)["speed"] == 2.0
    assert list(loop.scan(bad).bridged) == ["T"]


# ------------------------------------------------------------------------------------------------- the predictive law
class Plant:
    """Two outputs of the law's own model, and a read-back."""

    def __init__(self, model: Any, seed: int = 0) -> None:
        self.model, self.rng = model, np.random.default_rng(seed)
        self.x = torch.zeros(model.n_x, dtype=torch.float64)
        self.mv = np.zeros(2)

    def sample(self) -> Sample:
        return Sample(self.model.measured(self.x).numpy() + 0.005 * self.rng.normal(size=2), self.mv.copy())

    def write(self, mv: np.ndarray) -> None:
        self.mv = mv.copy()
        with torch.no_grad():
            self.x = self.model(torch.cat([self.x, torch.from_numpy(self.mv)]))


def test_a_change_to_the_same_value_or_of_an_inactive_limit_changes_nothing(
    predictive: Controller, predictive_model: Any
) -> None:
    courses = []
    for changes in (False, True):
        plant = Plant(predictive_model)
        loop = ControlLoop(predictive, sp=[0.2, -0.1], mv=[0.0, 0.0], mode=Mode.AUTO)
        course = []
        for k in range(60):
            if changes and k % 7 == 3:
                loop.set_operate(named(loop))
            command = loop.scan(plant.sample())
            plant.write(command.mv)
            course.append(command.mv.tolist())
        courses.append(course)
    assert courses[0] == courses[1]


SWITCH = st.sampled_from([0.0, 1.0, 1.0])


@st.composite
def change(draw: st.DrawFn, controller: Controller) -> dict[str, float]:
    """Some entries changed; each pair of ends in order."""
    found: dict[str, float] = {}
    for e in controller.manifest.operate:
        if not draw(st.integers(0, 3)):
            value = draw(SWITCH if e.what in SWITCHES else st.floats(e.low, e.high))
            found[e.name] = min(value, e.high)
    for signal in {e.signal for e in controller.manifest.operate if e.what == "low"}:
        ends = [f"{signal}.low", f"{signal}.high"]
        if any(end in found for end in ends):
            low, high = (next(e for e in controller.manifest.operate if e.name == end) for end in ends)
            given = [found.get(ends[0], low.default), found.get(ends[1], high.default)]
            found |= dict(zip(ends, sorted(given), strict=True))
    return found


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_no_mv_leaves_the_operators_range_or_is_faster_than_operators_let_it(
    predictive: Controller, predictive_model: Any, data: st.DataObject
) -> None:
    """It goes into its range by its largest move a period where it stands outside, and never out again."""
    plant = Plant(predictive_model, data.draw(st.integers(0, 99)))
    loop = ControlLoop(predictive, sp=[0.2, -0.1], mv=[0.0, 0.0], mode=Mode.AUTO, bridge_s=3.0)
    plant_mv = plant.mv
    for _ in range(data.draw(st.integers(1, 5))):
        loop.set_operate(data.draw(change(predictive)))
        loop.set_sp(data.draw(st.lists(st.floats(-3.0, 3.0), min_size=2, max_size=2)))
        for _ in range(data.draw(st.integers(1, 12))):
            seen = plant.sample()
            bad = data.draw(st.lists(st.booleans(), min_size=2, max_size=2)) if data.draw(st.booleans()) else [0, 0]
            pv = np.where(bad, np.nan, np.clip(seen.pv, -3.0, 3.0))
            command = loop.scan(Sample(pv, seen.mv_applied))
            at = named(loop)
            for i, before in enumerate(plant_mv.tolist()):
                mv, most = float(command.mv[i]), at[f"u{i}.max_move"]
                low, high = at[f"u{i}.low"], at[f"u{i}.high"]
                if command.mode is not Mode.AUTO or not at[f"u{i}.use"]:
                    assert mv == before
                    continue
                assert abs(mv - before) <= most + 1e-9
                nearest = min(max(before, low), high)  # as near to the range as a move lets it come
                reach = before + np.sign(nearest - before) * min(most, abs(nearest - before))
                assert min(low, reach) - 1e-9 <= mv <= max(high, reach) + 1e-9
            if command.mode is Mode.HOLD:
                loop.set_mode(Mode.AUTO)
            plant.write(command.mv)
            plant_mv = plant.mv


# ------------------------------------------------------------------------------------------------ words and switches
def test_a_switch_may_be_true_or_false(operated: Controller) -> None:
    loop = loop_of(operated)
    loop.set_operate({"valve.use": False, "T.use": np.False_, "p.use": True})
    assert [named(loop)[n] for n in ("valve.use", "T.use", "p.use")] == [0.0, 0.0, 1.0]
    operate = Operate(operated.manifest.operate)
    mixed = [bool(v) if e.what in SWITCHES else v for e, v in zip(operate.entries, operate.default, strict=True)]
    given: dict[str, Any] = {"sp": [300.0, 5.0], "pv": [299.0, 5.0, 0.5], "mv_applied": [40.0, 0.5]}
    steps = [
        operated.step(**given, state=operated.cold_state(), operate=values, fresh=fresh)
        for values, fresh in ((mixed, [True, False, True]), (None, [1, 0, 1]), (None, np.array([True, False, True])))
    ]
    assert steps[0].info.tolist() == steps[1].info.tolist() == steps[2].info.tolist()
    with pytest.raises(ContractError, match="operate"):
        operated.step(**given, state=operated.cold_state(), operate=[True] * len(mixed))


@pytest.mark.parametrize(("name", "value"), [("operate", np.ones(9)), ("fresh", [1, 1, 1])])
def test_a_law_without_these_inputs_refuses_them(not_operated: Controller, name: str, value: Any) -> None:
    given: dict[str, Any] = {"sp": [300.0, 5.0], "pv": [299.0, 5.0, 0.5], "mv_applied": [40.0, 0.5], name: value}
    with pytest.raises(ContractError, match=name) as error:
        not_operated.step(**given, state=not_operated.cold_state())
    assert "\n" not in str(error.value)


def test_values_that_are_right_stay_right_and_others_are_refused_each_time(operated: Controller) -> None:
    operate = Operate(operated.manifest.operate)
    right = operate.with_values({"valve.high": 60.0})
    for _ in range(2):
        assert operate.checked(right) is right
        wrong = right.copy()
        wrong[operate.places["valve.high"]] = 600.0
        with pytest.raises(ContractError, match="high"):
            operate.checked(wrong)


@given(st.integers(0, 999), st.floats(0.0, 1.0))
def test_drawn_values_are_allowed(operated: Controller, seed: int, share: float) -> None:
    operate = Operate(operated.manifest.operate)
    drawn = operate.drawn(np.random.default_rng(seed), share)
    assert operate.checked(drawn).tolist() == drawn.tolist()


def test_many_names_are_shortened_to_the_nearest() -> None:
    many = [f"TIC-{i}.{what}" for i in range(20) for what in ("use", "low", "high")]
    words = nearest("TIC-7.hihg", many)
    assert "TIC-7.high" in words
    assert sum(name in words.split(", ") or name in words for name in many) < 20
    assert all(name in nearest("lwo", ["low", "high"]) for name in ("low", "high"))
