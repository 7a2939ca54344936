"""A controller that reads fewer signals than the loop takes over there, and the loop goes on reading all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving import (
    ContractError,
    Controller,
    ControlLoop,
    Guard,
    InRange,
    LoopError,
    Manifest,
    Mode,
    Sample,
    Signal,
    default_guards,
)
from loopwright.serving.in_charge.adapted import AdaptedController, adapted
from loopwright.serving.journal import columns
from loopwright.serving.trust import signer

pytest_plugins = ["small_laws"]

LEVEL, T = Signal("level", "m", 0.0, 2.0), Signal("T", "K", 250.0, 400.0)
SIGNALS = Signals(0.5, (LEVEL,), (LEVEL, T), (Signal("inflow", "l/s", 0.0, 3.0),), (Signal("valve", "%", 0.0, 100.0),))
P, HEAT = Signal("P", "bar", 0.0, 10.0), Signal("heat", "kW", -1.0, 1.0)
WIDE = replace(SIGNALS, pv=(LEVEL, T, P), dv=(*SIGNALS.dv, HEAT))
Made = Callable[..., Controller]


def afresh(law: Any, sp: Any, pv: Any, dv: Any, mv_applied: Any, state: Any) -> Any:
    """Uses the first and the last PV and the last measured disturbance."""
    mv = law.limited(50.0 + 10.0 * (sp - pv[..., :1]) + pv[..., -1:] + 5.0 * dv[..., -1:], mv_applied)
    return mv, state, pv[..., :0]


def deaf(law: Any, sp: Any, pv: Any, dv: Any, mv_applied: Any, state: Any) -> Any:
    """Uses the controlled variable alone."""
    return law.limited(50.0 + 10.0 * (sp - pv[..., :1]), mv_applied), state, pv[..., :0]


@pytest.fixture
def made(make_formula: Callable[..., Any], tmp_path: Path) -> Made:
    def make(formula: Any, signals: Signals) -> Controller:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.onnx"
        export(make_formula(formula, signals=signals), path, case="tank", provenance={})
        return Controller(path)

    return make


def sample(level: float = 0.8, t: float = 300.0, p: float = 2.0, mv: float = 40.0, heat: float = 0.5) -> Sample:
    return Sample(np.array([level, t, p]), np.array([mv]), np.array([1.0, heat]))


def test_it_gets_its_own_signals_by_name(made: Made) -> None:
    """Also where it has them in another order, behind what it controls."""
    loop = made(afresh, WIDE).manifest
    for pv, dv, expected in (
        ((LEVEL, P), (HEAT,), 50 + 2.0 + 2.0 + 2.5),
        ((LEVEL,), (HEAT,), 50 + 2.0 + 0.8 + 2.5),
        ((LEVEL, P, T), (*WIDE.dv,), 100.0),
        ((LEVEL, P), (HEAT, *SIGNALS.dv), 50 + 2.0 + 2.0 + 5.0),
    ):
        own = made(afresh, replace(WIDE, pv=pv, dv=dv))
        seat = adapted(own, loop)
        step = seat.step(sp=1.0, pv=sample().pv, dv=sample().dv, mv_applied=40.0, state=seat.cold_state())
        assert step.mv.tolist() == pytest.approx([expected])
        seat.warm()
    with pytest.raises(ContractError, match=r"pv has the shape \(2,\); the loop has \(3,\)"):
        seat.step(sp=1.0, pv=np.zeros(2), dv=sample().dv, mv_applied=40.0, state=seat.cold_state())


def test_its_manifest_has_the_signals_of_the_loop_and_its_own_ranges(made: Made) -> None:
    loop = made(afresh, WIDE)
    narrow = replace(LEVEL, high=1.5)
    own = made(deaf, replace(WIDE, pv=(narrow,), dv=()))
    seat = adapted(own, loop.manifest)
    assert isinstance(seat, AdaptedController)
    assert seat.manifest.pv == (narrow, T, P)
    assert seat.manifest.dv == WIDE.dv
    assert "dv" in seat.manifest.inputs  # the loop judged it, and goes on doing so
    assert (seat.sha256, seat.path, seat.size_bytes) == (own.sha256, own.path, own.size_bytes)
    assert signer(seat) is None
    assert columns(seat.manifest)[: 1 + 3] == ["sp level", "pv level", "pv T", "pv P"]
    assert adapted(loop, loop.manifest) is loop
    assert adapted(seat, loop.manifest) is seat  # once replaced, it may be put back


def test_it_takes_over_and_the_old_one_is_put_back(made: Made) -> None:
    old, new = made(afresh, WIDE), made(deaf, replace(WIDE, pv=(LEVEL,), dv=()))
    loop = ControlLoop(old, sp=1.0, mv=40.0, mode=Mode.AUTO)
    loop.swap(new, trial=2)
    for _ in range(2):
        command = loop.scan(sample())
        assert command.successor_mv is not None
        assert command.successor_mv.tolist() == pytest.approx([52.0])
    assert loop.scan(sample()).mv.tolist() == pytest.approx([52.0])
    assert "PV P is 12" in loop.scan(sample(p=12.0)).fault  # which the new one does not read
    loop.set_mode(Mode.AUTO)
    assert "PV T is nan" in loop.scan(sample(t=np.nan)).fault
    loop.set_mode(Mode.AUTO)
    assert "DV heat is nan" in loop.scan(sample(heat=np.nan)).fault
    loop.set_mode(Mode.AUTO)
    assert loop.replaced is old
    loop.swap(loop.replaced, trial=1)
    loop.scan(sample())
    assert loop.controller is old
    assert loop.replaced is not None
    loop.swap(loop.replaced, trial=1)
    loop.scan(sample())
    assert loop.controller.manifest.pv == old.manifest.pv
    assert loop.scan(sample()).mv.tolist() == pytest.approx([52.0])


def test_what_the_loop_reads_stays_what_its_first_controller_reads(made: Made) -> None:
    first = made(afresh, WIDE)
    loop = ControlLoop(first, sp=1.0, mv=40.0, mode=Mode.AUTO)
    loop.swap(made(deaf, replace(WIDE, pv=(LEVEL,), dv=())), trial=1)
    loop.scan(sample())
    third = made(deaf, replace(WIDE, pv=(LEVEL, P), dv=()))
    loop.swap(third, trial=1)
    loop.scan(sample())
    assert loop.controller.sha256 == third.sha256
    more = made(deaf, replace(WIDE, pv=(*WIDE.pv, Signal("Q", "W", 0.0, 1.0))))
    with pytest.raises(LoopError, match="it may leave some of them out, but have no others"):
        loop.swap(more, trial=1)


# ---------------------------------------------------------------------- guards
def test_guards_are_made_anew_for_the_ranges_of_whoever_takes_over(made: Made) -> None:
    old = made(deaf, SIGNALS)
    wide = made(deaf, replace(SIGNALS, pv=(replace(LEVEL, high=4.0), T), sp=(replace(LEVEL, high=4.0),)))
    loop = ControlLoop(old, sp=1.0, mv=40.0, mode=Mode.AUTO, recover_after=1)
    rest = np.array([40.0]), np.zeros(1)
    high, low = (Sample(np.array([level, 300.0]), *rest) for level in (3.0, 0.8))
    assert "PV level is 3 m, outside its range [0, 2] m" in loop.scan(high).fault
    loop.swap(wide, trial=1)
    loop.scan(low)
    assert loop.scan(high).fault == ""
    assert loop.replaced is old
    loop.swap(old, trial=1)
    loop.scan(high)
    assert loop.successor is not None  # where the plant is now, the old one was never proven
    assert "outside its range [0, 2] m" in loop.successor.reason
    loop.scan(low)
    assert loop.controller is old
    assert "outside its range [0, 2] m" in loop.scan(high).fault


def test_a_host_s_own_guards_stay_and_its_maker_is_asked_again(made: Made) -> None:
    old, new = made(deaf, SIGNALS), made(deaf, replace(SIGNALS, pv=(replace(LEVEL, high=1.5), T)))
    own = InRange(SIGNALS.pv, 0.5)
    loop = ControlLoop(old, sp=1.0, mv=40.0, guards=[own])
    one = Sample(np.array([0.8, 300.0]), np.array([40.0]), np.zeros(1))
    loop.swap(new, trial=1)
    loop.scan(one)
    assert loop.controller is new
    assert loop.guards == (own,)
    asked: list[Manifest] = []

    def make(manifest: Manifest) -> tuple[Guard, ...]:
        asked.append(manifest)
        return default_guards(manifest)

    loop = ControlLoop(old, sp=1.0, mv=40.0, guards=make)
    loop.swap(new, trial=1)
    loop.scan(one)
    assert asked == [old.manifest, new.manifest]


def test_one_that_commands_a_part_of_the_actuators_range_takes_over_and_keeps_to_it(made: Made) -> None:
    """As a controller of an own plant does, whose model has a gain that turns: by hand the MV has all of its range."""
    old = made(deaf, SIGNALS)
    part = made(deaf, replace(SIGNALS, mv=(replace(SIGNALS.mv[0], low=60.0),)))
    loop = ControlLoop(old, sp=1.0, mv=40.0, mode=Mode.AUTO)

    def scan(mv: float) -> float:
        return float(loop.scan(Sample(np.array([0.8, 300.0]), np.array([mv]), np.array([1.0]))).mv[0])

    loop.swap(part, trial=1)
    assert scan(40.0) == pytest.approx(52.0)  # on trial
    assert scan(52.0) == pytest.approx(60.0)
    assert loop.controller.sha256 == part.sha256
    assert (loop.manifest.mv[0].low, loop.manifest.mv[0].high) == (0.0, 100.0)
    loop.set_mode(Mode.MANUAL)
    loop.set_mv([20.0])
    assert scan(60.0) == 20.0
    loop.set_mode(Mode.AUTO)
    assert scan(20.0) == pytest.approx(60.0)
    assert loop.replaced is old
    loop.swap(old, trial=1)
    assert scan(60.0) == pytest.approx(60.0)
    assert scan(60.0) == pytest.approx(52.0)
    # A wider one, or one with other values, belongs to another actuator.
    wide = made(deaf, replace(SIGNALS, mv=(replace(SIGNALS.mv[0], high=101.0),)))
    with pytest.raises(LoopError, match="ranges within the loop's"):
        loop.swap(wide, trial=1)


def test_it_goes_into_its_part_of_the_range_by_its_largest_move_a_period(made: Made) -> None:
    old = made(deaf, SIGNALS)
    part = made(deaf, replace(SIGNALS, mv=(replace(SIGNALS.mv[0], low=60.0, max_move=5.0),)))
    loop = ControlLoop(old, sp=1.0, mv=40.0, mode=Mode.AUTO)

    def scan(mv: float) -> float:
        return float(loop.scan(Sample(np.array([0.8, 300.0]), np.array([mv]), np.array([1.0]))).mv[0])

    loop.swap(part, trial=1)
    assert scan(40.0) == pytest.approx(52.0)  # on trial
    assert loop.successor is None
    for mv, expected in ((47.0, 52.0), (52.0, 57.0), (57.0, 60.0), (62.0, 60.0), (60.0, 60.0)):
        assert scan(mv) == pytest.approx(expected)
    # A read-back beyond the actuator's range counts as its end.
    seat, one = adapted(part, old.manifest), sample()
    step = seat.step(sp=1.0, pv=one.pv[:2], dv=one.dv[:1], mv_applied=-3.0, state=seat.cold_state())
    assert step.mv.tolist() == pytest.approx([5.0])
