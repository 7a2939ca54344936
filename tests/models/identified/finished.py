"""A finished identified model as a plant, and its free run over rows that a test gives."""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.output_error import fit_starts
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from loopwright.pipeline.plants.simulator import Array, Signals


def of_model(model: Identified) -> tuple[Dynamics, IdentifiedArrays]:
    """The arrays of a finished model, for the fit's functions and for a plant."""
    of = {name: np.array(value.numpy()) for name, value in model.state_dict().items()}
    dynamics = Dynamics(of["a"], of["b"], of["c"], of["w1"], of["b1"], of["w2"])
    scales = {name: of[name] for name in ("y_center", "y_scale", "v_center", "v_scale", "rest")}
    return dynamics, IdentifiedArrays(*(of[name] for name in ("a", "b", "c", "w1", "b1", "w2")), **scales)


def plant_of(
    model: Identified,
    signals: Signals,
    *,
    name: str = "identified",
    mv: Array | None = None,
    dv: Array | None = None,
    most_dead_time: int = 0,
) -> IdentifiedPlant:
    """The model as a plant; PlantError where the signals are not those of its record."""
    arrays = of_model(model)[1]
    return IdentifiedPlant(signals, arrays, name=name, mv=mv, dv=dv, most_dead_time=most_dead_time)


def free_run(model: Identified, y: Array, v: Array) -> Array:
    """Outputs (n, n_y) in their units over neighbouring rows y (n, n_y), v (n, n_v) in engineering units.

    The initial state is the one that fits y best.
    """
    dynamics, of = of_model(model)
    data = Stretch((y - of.y_center) / of.y_scale, (v - of.v_center) / of.v_scale)
    run = dynamics.free_run(fit_starts(dynamics, [data])[0], data)
    predicted = np.full(y.shape, np.nan) if run is None else run[0][:, : y.shape[1]]
    return predicted * of.y_scale + of.y_center
