"""A predictive law that reads `operate` goes on from what is commanded, also while another one commands the MVs.

A law takes its own last command for the MV's. Where nobody carries it out, its moves would add up to 2 % of an MV's
range, the margin of a read-back, and a change to AUTO would jump by as much.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from actuators_of_plants import ActuatedPlant

from loopwright.serving import Controller, ControlLoop, Mode
from loopwright.serving.modes import Command

pytest_plugins = ["small_laws", "operated_files"]
MORE = 1.05  # times the first wish: a filter's estimate moves a little


def run(loop: ControlLoop, plant: ActuatedPlant, scans: int) -> list[Command]:
    found = []
    for _ in range(scans):
        command = loop.scan(plant.sample())
        plant.write(command.mv)
        found.append(command)
    return found


def at_rest(controller: Controller, model: Any, **options: Any) -> tuple[ControlLoop, ActuatedPlant]:
    plant = ActuatedPlant(model)
    loop = ControlLoop(controller, sp=[0.2, -0.1], mv=[0.0, 0.0], mode=Mode.AUTO, **options)
    run(loop, plant, 60)
    return loop, plant


def wishes(commands: list[Command]) -> np.ndarray:
    """How far the law is off the MV that is commanded, scan by scan; shape: (n, n_mv)."""
    return np.array([np.abs(c.law_mv - c.mv) for c in commands if c.law_mv is not None])


@pytest.mark.parametrize("mode", [Mode.SHADOW, Mode.MANUAL], ids=str)
def test_what_a_law_wants_does_not_grow_while_others_have_the_mvs(
    predictive: Controller, predictive_model: Any, mode: Mode
) -> None:
    loop, plant = at_rest(predictive, predictive_model)
    loop.set_mode(mode)
    loop.set_sp([0.21, -0.1])
    found = wishes(run(loop, plant, 30))
    assert found[0].max() > 1e-3  # it wants something
    assert (found <= MORE * found[0]).all()
    loop.set_mode(Mode.AUTO)
    before = loop.mv
    assert (np.abs(run(loop, plant, 1)[0].mv - before) <= MORE * found[0]).all()


def test_a_successor_begins_where_the_mvs_stand(predictive: Controller, predictive_model: Any) -> None:
    loop, plant = at_rest(predictive, predictive_model)
    loop.set_mode(Mode.MANUAL)
    loop.set_sp([0.21, -0.1])
    loop.swap(Controller(predictive.path), 20)
    shown = [c.successor_mv for c in run(loop, plant, 19)]
    off = np.array([np.abs(mv - loop.mv) for mv in shown if mv is not None])
    assert len(off) > 10
    assert (off <= MORE * off[1]).all()


def test_a_law_whose_commands_are_carried_out_is_stepped_once(
    predictive: Controller, predictive_model: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, plant = at_rest(predictive, predictive_model)
    steps, usual = 0, loop.controller.step

    def counted(**given: Any) -> Any:
        nonlocal steps
        steps += 1
        return usual(**given)

    monkeypatch.setattr(loop.controller, "step", counted)
    run(loop, plant, 10)
    assert steps == 10
    loop.set_mode(Mode.SHADOW)
    loop.set_sp([0.21, -0.1])
    run(loop, plant, 10)
    assert steps == 30


def test_a_second_step_that_fails_ends_the_past_and_not_the_scan(
    predictive: Controller, predictive_model: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, plant = at_rest(predictive, predictive_model)
    loop.set_mode(Mode.MANUAL)
    loop.set_sp([0.21, -0.1])
    usual, stands = loop.controller.step, loop.mv

    def pinned_fails(**given: Any) -> Any:
        operate = dict(zip([e.name for e in loop.controller.manifest.operate], given["operate"], strict=True))
        if operate["u0.low"] == operate["u0.high"]:
            raise RuntimeError("no more")
        return usual(**given)

    monkeypatch.setattr(loop.controller, "step", pinned_fails)
    commands = run(loop, plant, 3)
    assert [c.fault for c in commands] == ["", "", ""]
    assert all((c.mv == stands).all() for c in commands)
