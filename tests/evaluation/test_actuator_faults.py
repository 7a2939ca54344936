"""Faults of actuators do what they say."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.evaluation.stress.draws import SLOW, SPAN, STUCK, ZERO, ActuatorFault, Actuators, draw_fault
from loopwright.serving import Signal

VALVE = (Signal("valve", "%", 0.0, 100.0),)


def moved(fault: ActuatorFault | None, commands: list[float], *, late: bool = False) -> tuple[list[float], list[float]]:
    """(positions, what the plant receives) from 50 % on."""
    actuators = Actuators(VALVE, [fault], np.array([[50.0]]), [late])
    rows = [actuators.move(k, np.array([[u]])) for k, u in enumerate(commands)]
    return [float(p[0, 0]) for p, _ in rows], [float(a[0, 0]) for _, a in rows]


@pytest.mark.parametrize(
    ("fault", "positions", "acting"),
    [
        (None, [60, 20, 100], [60, 20, 100]),
        (ActuatorFault(STUCK, 0, start=1, end=2), [60, 60, 100], [60, 60, 100]),
        (ActuatorFault(SLOW, 0, size=5.0), [60, 40, 60], [60, 40, 60]),
        (ActuatorFault(ZERO, 0, size=0.02), [60, 20, 100], [62, 22, 100]),
        (ActuatorFault(SPAN, 0, size=-0.05), [60, 20, 100], [57, 19, 95]),
    ],
)
def test_a_fault_does_what_it_says(fault: ActuatorFault | None, positions: list[float], acting: list[float]) -> None:
    assert moved(fault, [60.0, 20.0, 100.0]) == (pytest.approx(positions), pytest.approx(acting))


def test_a_late_actuator_acts_one_sample_later() -> None:
    assert moved(None, [60.0, 20.0], late=True) == ([60.0, 20.0], [50.0, 60.0])


def test_a_discrete_actuator_can_only_stick() -> None:
    on_off = (Signal("valve", "-", 0.0, 1.0, values=(0.0, 1.0)),)
    rng = np.random.default_rng(0)
    assert {draw_fault(rng, on_off, 100).kind for _ in range(20)} == {STUCK}
