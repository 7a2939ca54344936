"""A mode that is given by its name, as a settings file has it, and the traceback of a host's own mistake."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from loopwright.serving import Controller, ControlLoop, LoopError, Mode, Sample, VirtualClock

pytest_plugins = ["small_laws"]


class Tank:
    """A plant at rest that remembers what it was sent."""

    def __init__(self) -> None:
        self.written: list[float] = []

    def read(self) -> Sample:
        return Sample(pv=np.array([0.8, 300.0]), dv=np.zeros(1), mv_applied=np.array([40.0]))

    def write(self, mv: np.ndarray) -> None:
        self.written.append(float(mv[0]))


def loop_on(tank: Any, file: Path, mode: object) -> ControlLoop:
    clock = VirtualClock()
    return ControlLoop(Controller(file), tank, sp=1.0, mv=40.0, mode=cast(Mode, mode), clock=clock, warm_lead_s=0)


@pytest.mark.parametrize("mode", list(Mode))
def test_a_mode_by_its_name_is_that_mode(pi_file: Path, mode: Mode) -> None:
    by_name, by_mode = Tank(), Tank()
    one, other = loop_on(by_name, pi_file, str(mode)), loop_on(by_mode, pi_file, mode)
    one.run(3)
    other.run(3)
    assert one.mode is mode
    assert by_name.written == by_mode.written
    assert bool(by_name.written) == (mode is not Mode.SHADOW)
    one.set_mode(cast(Mode, "MANUAL"))
    assert one.mode is Mode.MANUAL


@pytest.mark.parametrize("mode", ["auto", "", "shadow ", 3, None])
def test_what_is_no_mode_is_refused_before_anything_is_written(pi_file: Path, mode: object) -> None:
    with pytest.raises(LoopError, match="must be one of MANUAL, AUTO, HOLD, SHADOW"):
        loop_on(Tank(), pi_file, mode)
    loop = loop_on(Tank(), pi_file, Mode.SHADOW)
    loop.run(1)
    with pytest.raises(LoopError, match="must be one of"):
        loop.set_mode(cast(Mode, mode))
    assert loop.mode is Mode.SHADOW


def test_the_traceback_of_an_endpoint_can_be_had(pi_file: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Mistaken(Tank):
        def read(self) -> Sample:
            return Sample(pv=np.array([readings["level"]]))

    readings: dict[str, float] = {}
    with caplog.at_level(logging.DEBUG, logger="loopwright.serving.loop"):
        loop_on(Mistaken(), pi_file, Mode.AUTO).run(1)
    assert [r.getMessage() for r in caplog.records] == ["the endpoint's read failed"]
    assert 'in read\n    return Sample(pv=np.array([readings["level"]]))' in caplog.text
