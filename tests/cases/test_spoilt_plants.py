"""Plants gone wrong by an error of the gain: none that runs away where the model itself does not."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.cases.operating_range import OperatingRange
from loopwright.pipeline.cases.own_model import OwnPlant
from loopwright.pipeline.plants.identified import IdentifiedArrays
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

PV, MV = Signal("y", "K", -3.0, 3.0), Signal("u", "%", -2.0, 2.0)
SIGNALS = Signals(1.0, (PV,), (PV,), (), (MV,))


def reach_of(a: float, b: float, held: float) -> OperatingRange:
    """y+ = a y + b u - held tanh(y), whose record visits outputs from -1.5 to 1.5."""
    rows = {"a": [[a]], "b": [[b]], "c": [0.0], "w1": [[1.0, 0.0]], "b1": [0.0], "w2": [[-held]]}
    scales = {"y_center": [0.0], "y_scale": [1.0], "v_center": [0.0], "v_scale": [1.0], "rest": [[1.0, 0.0, 0.0]]}
    arrays = IdentifiedArrays(**{name: np.array(values) for name, values in (rows | scales).items()})
    plant = OwnPlant(SIGNALS, arrays, mv=np.zeros(1), most_dead_time=1)
    record = Record.of(SIGNALS, np.linspace(-1.5, 1.5, 50)[:, None], np.linspace(-2.0, 2.0, 50)[:, None])
    return OperatingRange(plant, record)


@pytest.mark.parametrize(
    ("a", "b", "held", "gain", "stays"),
    [
        (1.02, 0.2, 0.5, 1.0, True),  # tanh holds it up to u = 2.2
        (1.02, 0.2, 0.5, 1.05, True),
        (1.02, 0.2, 0.5, 1.25, False),
        (0.97, 0.02, 0.0, 2.0, True),  # a lag
        (0.995, 0.004, 0.0, 1.25, True),  # a slow one, which goes on all the same
        (1.0, 0.01, 0.0, 1.25, True),  # an integrator
    ],
)
def test_an_error_of_the_gain_takes_no_plant_beyond_where_it_stays(
    a: float, b: float, held: float, gain: float, stays: bool
) -> None:
    reach = reach_of(a, b, held)
    assert reach.stays(reach.model, reach.model.parameters({"gain_u": gain})) is stays
