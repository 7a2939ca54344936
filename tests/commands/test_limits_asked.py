"""``loopwright new`` asks for the limits of an old controller's output, which no record shows."""

from __future__ import annotations

from loopwright.pipeline.commands.own_plant.knowledge import confirmed
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.serving.manifest import Signal

SIGNALS = (Signal("OP", "%", 0.0, 100.0), Signal("damper", "%", 0.0, 90.0))
FREE = (Tag("OP", "mv", "%", 0.0, 100.0, "OP"), Tag("the damper", "mv", "%", 0.0, 90.0, "damper"))
LIMITED = (Tag("OP", "mv", "%", 0.0, 100.0, "OP", command_high=56.0), FREE[1])


def test_an_mv_of_an_old_controller_without_limits_is_asked_of_once() -> None:
    (line,) = confirmed(SIGNALS, FREE, {"damper"})
    assert "'the damper=LOW..HIGH'" in line
    assert "0 to 90 %" in line


def test_limits_that_were_said_are_confirmed_and_not_asked() -> None:
    (line,) = confirmed(SIGNALS, LIMITED, {"OP"})
    assert "0 to 56 %" in line
    assert "--command" not in line
    assert confirmed(SIGNALS, FREE) == []
