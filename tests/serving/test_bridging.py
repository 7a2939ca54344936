"""A bad reading of one PV: bridged, then left out, and HOLD only where the loop cannot do without it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from operated_law import Given

from loopwright.serving import Controller, ControlLoop, Frozen, LoopError, Mode, Rate, Sample, default_guards
from loopwright.serving.guard import Fault, kind_of
from loopwright.serving.loop import Command

pytest_plugins = ["small_laws", "operated_files"]
NAN = float("nan")
BRIDGE = 3  # periods


def sample(t: float = 300.0, p: float = 5.0, x: float = 0.5, valve: float = 40.0, **changed: Any) -> Sample:
    return replace(Sample(np.array([t, p, x]), np.array([valve, 0.5])), **changed)


def loop_of(controller: Controller, **options: Any) -> ControlLoop:
    options = {"sp": [300.0, 5.0], "mv": [40.0, 0.5], "mode": Mode.AUTO, "bridge_s": float(BRIDGE), **options}
    return ControlLoop(controller, **options)


def law_sees(loop: ControlLoop, command: Command) -> Given:
    return Given.of(loop.controller.manifest, command.info)


BAD_READINGS = {
    "no number": sample(t=NAN),
    "infinite": sample(t=np.inf),
    "range": sample(t=500.0),
    "quality": sample(bad_pv=("BadSensorFailure", "", "")),
    "quality, no number": sample(t=NAN, bad_pv=("BadSensorFailure", "", "")),
}


@pytest.mark.parametrize("bad", BAD_READINGS.values(), ids=BAD_READINGS)
def test_a_bad_reading_is_bridged_then_left_out_and_taken_back(operated: Controller, bad: Sample) -> None:
    loop = loop_of(operated)
    assert not loop.scan(sample(t=301.0)).bridged
    for _ in range(BRIDGE):
        command = loop.scan(bad)
        assert (command.mode, command.fault) == (Mode.AUTO, "")
        assert list(command.bridged) == ["T"]
        assert command.bridged["T"]
        assert not command.shed
        seen = law_sees(loop, command)
        assert seen.fresh == {"T": 0.0, "p": 1.0, "x": 1.0}
        assert seen.pv["T"] == 301.0
        assert seen.operate["T.use"] == 1.0
    for _ in range(20):
        command = loop.scan(bad)
        assert (command.mode, command.fault) == (Mode.AUTO, "")
        assert list(command.shed) == ["T"]
        assert not command.bridged
        seen = law_sees(loop, command)
        assert seen.operate["T.use"] == 0.0
        assert seen.fresh["T"] == 0.0
    before = dict(zip([e.name for e in operated.manifest.operate], loop.operate.tolist(), strict=True))
    assert before["T.use"] == 1.0  # the operator's own word stays
    command = loop.scan(sample(t=305.0))
    assert not command.bridged
    assert not command.shed
    seen = law_sees(loop, command)
    assert (seen.fresh["T"], seen.pv["T"], seen.operate["T.use"]) == (1.0, 305.0, 1.0)


def test_an_operators_own_word_outlasts_a_bad_reading(operated: Controller) -> None:
    loop = loop_of(operated, bridge_s=0.0, operate={"T.use": 0.0})
    loop.scan(sample())
    assert list(loop.scan(sample(t=NAN)).shed) == ["T"]
    assert law_sees(loop, loop.scan(sample())).operate["T.use"] == 0.0


def test_each_pv_has_its_own_bridge(operated: Controller) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    loop.scan(sample(t=NAN))
    command = loop.scan(sample(t=NAN, p=NAN))
    assert sorted(command.bridged) == ["T", "p"]
    loop.scan(sample(t=NAN, p=NAN))
    command = loop.scan(sample(t=NAN, p=NAN))
    assert (list(command.bridged), list(command.shed)) == (["p"], ["T"])


def held(command: Command, subject: str) -> bool:
    return command.mode is Mode.HOLD and kind_of(command.fault)[-1] == subject


def test_the_loop_holds_where_no_controlled_variable_is_left(operated: Controller) -> None:
    loop = loop_of(operated, recover_after=2)
    loop.scan(sample())
    for _ in range(BRIDGE):
        assert loop.scan(sample(t=NAN, p=-9.0)).mode is Mode.AUTO
    for _ in range(3):
        assert held(loop.scan(sample(t=NAN, p=-9.0)), "PV T, PV p")
    assert loop.scan(sample(t=NAN)).mode is Mode.HOLD  # a good sample is one that the law may act on
    command = loop.scan(sample(t=NAN))
    assert (command.mode, list(command.shed)) == (Mode.AUTO, ["T"])


def test_what_an_operator_took_out_is_not_left(operated: Controller) -> None:
    loop = loop_of(operated, bridge_s=0.0, operate={"p.use": 0.0})
    loop.scan(sample())
    assert held(loop.scan(sample(t=NAN)), "PV T")
    loop = loop_of(operated, bridge_s=0.0, operate={"p.use": 0.0})
    loop.scan(sample())
    assert loop.scan(sample(p=NAN)).mode is Mode.AUTO  # nobody wants it


def test_a_critical_pv_is_not_left_out(operated: Controller) -> None:
    loop = loop_of(operated, critical=["p"])
    loop.scan(sample())
    for _ in range(BRIDGE):
        assert loop.scan(sample(p=NAN)).mode is Mode.AUTO
    assert held(loop.scan(sample(p=NAN)), "PV p")


def test_a_pv_that_the_law_cannot_leave_out_holds(operated: Controller) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    for _ in range(BRIDGE):
        assert loop.scan(sample(x=7.0)).mode is Mode.AUTO
    assert held(loop.scan(sample(x=7.0)), "PV x")


def test_a_pv_that_was_never_read_is_not_bridged(operated: Controller) -> None:
    loop = loop_of(operated, recover_after=1)
    assert held(loop.scan(sample(t=NAN)), "PV T")
    loop.scan(sample())
    assert loop.scan(sample(t=NAN)).mode is Mode.AUTO


@pytest.mark.parametrize(
    "bad",
    [
        sample(fault="the plant's watchdog stands"),
        sample(age_s=5.0),
        sample(mv_applied=np.array([40.0, NAN])),  # an MV that this law cannot do without
        sample(mv_applied=np.array([40.0])),
        sample(pv=np.array([300.0, 5.0])),
        sample(bad_pv=("bad",)),
        sample(bad_pv=(0.0, 0.0, 0.0)),
        sample(t=NAN, fault="late"),
    ],
    ids=["fault", "age", "applied", "length of the MV", "length of the PV", "bad_pv", "no texts", "both"],
)
def test_what_is_wrong_with_the_whole_sample_holds_at_once(operated: Controller, bad: Sample) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    command = loop.scan(bad)
    assert command.mode is Mode.HOLD
    assert command.fault
    assert not command.bridged


def test_a_law_without_fresh_takes_a_whole_sample_or_none(not_operated: Controller) -> None:
    for bad in BAD_READINGS.values():
        loop = loop_of(not_operated)
        loop.scan(sample())
        command = loop.scan(bad)
        assert command.mode is Mode.HOLD
        assert command.fault
        assert not command.bridged
        assert command.law_mv is None


def test_periods_without_a_sample_count(operated: Controller) -> None:
    loop = loop_of(operated, recover_after=1, max_gap=100)
    loop.scan(sample())
    loop.scan(sample(t=NAN))
    loop.miss("the plant cannot be read")
    command = loop.scan(sample(t=NAN))
    assert list(command.bridged) == ["T"]
    loop.gap(2)
    assert list(loop.scan(sample(t=NAN)).shed) == ["T"]


def test_guards_that_look_back_speak_of_one_pv_alone(operated: Controller) -> None:
    m = operated.manifest
    guards = (*default_guards(m), Frozen(m.pv[:3], 3), Rate(m.pv, (10.0, 1.0, 1.0)))
    loop = loop_of(operated, guards=guards, bridge_s=100.0)
    at = iter(np.linspace(0.1, 0.9, 50).tolist())
    for _ in range(2):
        assert not loop.scan(sample(p=4.0 + next(at), x=next(at))).bridged
    for _ in range(5):
        assert list(loop.scan(sample(p=4.0 + next(at), x=next(at))).bridged) == ["T"]  # frozen
    assert not loop.scan(sample(t=301.0, p=4.0 + next(at), x=next(at))).bridged
    assert list(loop.scan(sample(t=320.0, p=4.0 + next(at), x=next(at))).bridged) == ["T"]  # too fast
    assert list(loop.scan(sample(t=322.0, p=4.0 + next(at), x=next(at))).bridged) == ["T"]  # 21 K in two periods
    assert not loop.scan(sample(t=321.0, p=4.0 + next(at), x=next(at))).bridged  # 20 K in three


def rated(operated: Controller, **options: Any) -> ControlLoop:
    """A loop in which T may move by 5 K a period."""
    guards = (*default_guards(operated.manifest), Rate(operated.manifest.pv, (5.0, 5.0, 5.0)))
    return loop_of(operated, guards=guards, bridge_s=100.0, recover_after=1, **options)


def test_a_pv_that_jumped_and_stays_is_good_again_once_it_can_have_got_there(operated: Controller) -> None:
    loop = rated(operated)
    loop.scan(sample())
    moved = [loop.scan(sample(t=352.0)) for _ in range(12)]
    assert [bool(c.bridged) for c in moved] == [True] * 10 + [False] * 2  # 52 K, of 5 K for each of 11 periods
    assert {law_sees(loop, c).pv["T"] for c in moved[:10]} == {300.0}
    assert law_sees(loop, moved[10]).fresh["T"] == 1.0


def test_a_jump_is_not_forgotten_over_a_fault_of_the_whole_sample(operated: Controller) -> None:
    loop = rated(operated)
    loop.scan(sample())
    assert loop.scan(sample(t=380.0)).bridged
    assert loop.scan(sample(t=380.0, mv_applied=np.array([40.0, NAN]))).mode is Mode.HOLD
    loop.miss("the plant cannot be read")
    assert list(loop.scan(sample(t=380.0)).bridged) == ["T"]
    assert not loop.scan(sample(t=310.0)).bridged


def test_a_jump_that_was_read_as_bad_first_is_one_all_the_same(operated: Controller) -> None:
    loop = rated(operated)
    loop.scan(sample())
    assert loop.scan(sample(t=NAN)).bridged
    assert list(loop.scan(sample(t=380.0)).bridged) == ["T"]
    assert not loop.scan(sample(t=314.0)).bridged


class OneAfterTheOther:
    """A guard of somebody's own: it names the first PV that is too high, and knows of no ``bad_pv``."""

    memory = 0

    def check(self, sample: Sample, past: Any) -> str | None:
        for name, value, most in zip(("T", "p", "x"), sample.pv, (350.0, 6.0, 1.0), strict=True):
            if not value <= most:
                return Fault(f"PV {name} is too high", "own", f"PV {name}")
        return None


@pytest.mark.parametrize("first", [{"t": 360.0}, {"t": NAN}, {"t": 360.0, "bad_pv": ("bad", "", "")}], ids=str)
def test_a_guard_of_ones_own_hides_no_second_bad_pv(operated: Controller, first: dict[str, Any]) -> None:
    loop = loop_of(operated, guards=lambda m: (*default_guards(m), OneAfterTheOther()))
    loop.scan(sample())
    for _ in range(2):
        command = loop.scan(sample(p=9.0, x=3.0, **first))
        assert sorted(command.bridged) == ["T", "p", "x"]
        assert law_sees(loop, command).pv == {"T": 300.0, "p": 5.0, "x": 0.5}
    assert list(loop.scan(sample(**first)).bridged) == ["T"]


def test_a_guard_of_ones_own_that_no_good_number_contents_refuses_the_sample(operated: Controller) -> None:
    class Never:
        memory = 0

        def check(self, sample: Sample, past: Any) -> str | None:
            return Fault("T is odd", "odd", "PV T") if sample.pv[1] > 5 else None

    loop = loop_of(operated, guards=[Never()])
    loop.scan(sample())
    assert held(loop.scan(sample(p=6.0)), "PV T")


def test_a_guard_of_ones_own_that_looks_at_every_pv_ends(operated: Controller) -> None:
    class Stubborn:
        memory = 0

        def check(self, sample: Sample, past: Any) -> str | None:
            return Fault("T is odd", "odd", "PV T") if not sample.pv[0] < 310 else None

    loop = loop_of(operated, guards=[Stubborn()])
    loop.scan(sample())
    assert list(loop.scan(sample(t=NAN)).bridged) == ["T"]
    assert list(loop.scan(sample(p=NAN)).bridged) == ["p"]  # also without a guard that asks for numbers


@pytest.mark.parametrize(
    "options",
    [{"bridge_s": -1.0}, {"bridge_s": NAN}, {"critical": ["q"]}, {"critical": "T"}, {"critical": ["valve"]}],
    ids=str,
)
def test_settings_that_cannot_be_are_refused(operated: Controller, options: dict[str, Any]) -> None:
    with pytest.raises(LoopError):
        loop_of(operated, **options)


# ------------------------------------------------------------------------------------------------------- no new reading
def stale(*names: str, **changed: Any) -> Sample:
    return sample(**changed, fresh=np.array([float(n not in names) for n in ("T", "p", "x")]))


@pytest.mark.parametrize("number", [300.0, 333.0, 999.0, NAN])
def test_a_pv_without_a_new_reading_is_predicted_for_as_long_as_it_takes(operated: Controller, number: float) -> None:
    guards = (*default_guards(operated.manifest), Rate(operated.manifest.pv, (1.0, 1.0, 1.0)))
    loop = loop_of(operated, guards=guards, critical=["T", "x"])
    loop.scan(sample(t=301.0))
    for _ in range(5 * BRIDGE):
        command = loop.scan(stale("T", "x", t=number))
        assert (command.mode, command.fault, dict(command.bridged), dict(command.shed)) == (Mode.AUTO, "", {}, {})
        seen = law_sees(loop, command)
        assert (seen.fresh, seen.pv["T"]) == ({"T": 0.0, "p": 1.0, "x": 0.0}, 301.0)
        assert seen.operate["T.use"] == 1.0
    command = loop.scan(sample(t=310.0))
    assert (law_sees(loop, command).fresh["T"], law_sees(loop, command).pv["T"]) == (1.0, 310.0)


def test_a_bad_reading_after_old_ones_has_its_whole_bridge_and_stays_bad(operated: Controller) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    for _ in range(20):
        loop.scan(stale("T"))
    assert list(loop.scan(sample(t=NAN)).bridged) == ["T"]
    found = [loop.scan(stale("T")) for _ in range(BRIDGE + 1)]
    assert [list(c.bridged) for c in found] == [["T"], ["T"], [], []]
    assert [list(c.shed) for c in found] == [[], [], ["T"], ["T"]]
    assert not loop.scan(sample()).shed
    assert not loop.scan(stale("T")).bridged


def test_a_pv_that_was_never_read_is_not_predicted(operated: Controller) -> None:
    loop = loop_of(operated, recover_after=1)
    assert held(loop.scan(stale("T")), "PV T")
    assert loop.scan(sample()).mode is Mode.AUTO
    assert loop.scan(stale("T")).mode is Mode.AUTO


def test_old_numbers_make_no_pv_frozen(operated: Controller) -> None:
    loop = loop_of(operated, guards=(*default_guards(operated.manifest), Frozen(operated.manifest.pv[:1], 3)))
    loop.scan(sample())
    for _ in range(5):
        assert not loop.scan(stale("T")).bridged
    assert not loop.scan(sample()).bridged


@pytest.mark.parametrize("fresh", [np.ones(2), np.array([1.0, 0.5, 1.0]), "new", [1, None, 1]], ids=str)
def test_a_fresh_that_is_none_refuses_the_sample(operated: Controller, fresh: Any) -> None:
    loop = loop_of(operated)
    loop.scan(sample())
    assert loop.scan(sample(fresh=fresh)).mode is Mode.HOLD


def test_any_other_law_takes_the_number_that_stands_there(not_operated: Controller) -> None:
    assert loop_of(not_operated).scan(stale("T")).mode is Mode.AUTO
    assert loop_of(not_operated).scan(stale("T", t=999.0)).mode is Mode.HOLD


READINGS = st.sampled_from([300.0, 305.0, NAN, 500.0, np.inf])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(READINGS, READINGS, st.sampled_from([0.5, NAN]), st.sampled_from(["", "", "", "lost"])), max_size=40
    )
)
def test_whatever_is_read_the_law_gets_good_numbers_and_bad_ones_are_named(operated: Controller, scans: Any) -> None:
    loop = loop_of(operated, recover_after=1)
    last: dict[str, float] = {}
    for t, p, x, fault in scans:
        given = sample(t=t, p=p / 100, x=x, fault=fault)
        command = loop.scan(given)
        bad = {n for n, v, most in (("T", t, 400.0), ("p", p / 100, 10.0), ("x", x, 1.0)) if not v <= most}
        if not fault:
            last |= {n: v for n, v in (("T", t), ("p", p / 100), ("x", x)) if n not in bad}
        if command.law_mv is None:
            assert fault or bad
            continue
        assert set(command.bridged) | set(command.shed) == bad
        assert not set(command.bridged) & set(command.shed)
        seen = law_sees(loop, command)
        assert seen.pv == last
        assert {n for n, fresh in seen.fresh.items() if not fresh} == bad
        assert {n for n in ("T", "p") if not seen.operate[f"{n}.use"]} == set(command.shed)


@pytest.mark.parametrize("critical", [(), ("T", "p")], ids=["none left", "critical"])
def test_hold_names_every_pv_that_is_missing(operated: Controller, critical: tuple[str, ...]) -> None:
    loop = loop_of(operated, critical=critical)
    loop.scan(sample())
    command = [loop.scan(sample(t=NAN, p=NAN)) for _ in range(BRIDGE + 1)][-1]
    assert command.mode is Mode.HOLD
    assert "PV T" in command.fault
    assert "PV p" in command.fault
