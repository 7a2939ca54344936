"""A process variable that somebody has taken out has an alarm while it is outside its range."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loopwright.serving import Controller, ControlLoop, Mode, Sample
from loopwright.serving.station.left_out import WELL_INSIDE, LeftOut

pytest_plugins = ["small_laws", "operated_files"]
NAN = float("nan")


class Watched:
    """A loop whose T is within 290 to 310 K by its operators, and the alarms of it."""

    def __init__(self, controller: Controller, **changed: float) -> None:
        operate = {"T.low": 290.0, "T.high": 310.0, "T.use": 0.0, **changed}
        self.loop = ControlLoop(
            controller, sp=[300.0, 5.0], mv=[40.0, 0.5], mode=Mode.AUTO, bridge_s=0.0, operate=operate
        )
        self.said: list[tuple[str, bool]] = []
        self.left_out = LeftOut(lambda _, name, raised: self.said.append((name, raised)))

    def scan(self, t: float, **changed: Any) -> list[tuple[str, bool]]:
        """What was said at a scan with this reading."""
        sample = replace(Sample(np.array([t, 5.0, 0.5]), np.array([40.0, 0.5])), **changed)
        command, before = self.loop.scan(sample), len(self.said)
        self.left_out.look(self.loop, sample, command)
        return self.said[before:]


@pytest.mark.parametrize("beyond", [289.0, 311.0], ids=["below", "above"])
def test_it_is_raised_once_and_over_well_inside(operated: Controller, beyond: float) -> None:
    made = Watched(operated)
    t = next(s for s in operated.manifest.pv if s.name == "T")
    inside = 300.0 + (beyond - 300.0) * (10.0 / 11.0)  # at the end of the range
    assert made.scan(300.0) == []
    assert made.scan(beyond) == [("T", True)]
    assert made.scan(beyond) == []
    assert made.scan(inside) == []  # noise at the end of the range raises nothing anew
    assert made.scan(inside + np.sign(300.0 - inside) * 1.5 * WELL_INSIDE * (t.high - t.low)) == [("T", False)]


def test_one_that_is_taken_back_in_is_over(operated: Controller) -> None:
    made = Watched(operated)
    made.scan(320.0)
    made.loop.set_operate({"T.use": 1.0})
    assert made.scan(320.0) == [("T", False)]
    assert Watched(operated, **{"T.use": 1.0}).scan(320.0) == []  # the law has it


def test_nothing_is_said_of_a_bad_reading_and_where_the_law_moves_nothing(operated: Controller) -> None:
    made = Watched(operated)
    made.scan(300.0)
    assert made.scan(NAN) == []
    made.loop.set_mode(Mode.MANUAL)
    assert made.scan(320.0) == []
