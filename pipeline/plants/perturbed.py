"""A plant under other parameters: what a tuning must suit beside the model itself."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopwright.pipeline.plants.simulator import AdvanceMany, Array, Simulator

LEFT_OPEN_SDS = 2.0  # standard deviations of what a record leaves open


def likely_error(sd: Array, least: float, most: float) -> Array:
    """How far (n,) a plant may be off its model: ``LEFT_OPEN_SDS`` standard deviations, within ``least`` and ``most``.

    The least, as a plant does not stay as its record found it; the most, as beyond it a record tells nothing.
    """
    return np.clip(LEFT_OPEN_SDS * sd, least, most)


class SpoiltPlant(Simulator):
    """A plant whose parameters are others from the start on, such as a gain of 1.25; its equations are not seen."""

    def __init__(self, plant: Simulator, changed: Mapping[str, float]) -> None:
        # The attributes that other plants have by their class, this one has by the plant that it spoils.
        names = ("name", "period_s", "pv_signals", "sp_signals", "mv_signals", "dv_signals")
        vars(self).update({name: getattr(plant, name) for name in names})
        self.plant, self.changed = plant, dict(changed)

    @property
    def start(self) -> tuple[Array, Array]:
        """The start of the plant."""
        return self.plant.start

    @property
    def dv_nominal(self) -> Array:
        """Measured disturbances at the start, shape (n_dv,)."""
        return self.plant.dv_nominal

    @property
    def foreseen(self) -> int | None:
        """Samples over which an answer is known: those of the plant."""
        return self.plant.foreseen

    @property
    def asked(self) -> tuple[Array, Array]:
        """Set points that loops are tuned for: those of the plant."""
        return self.plant.asked

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise, shape (n_pv,)."""
        return self.plant.noise_std

    @property
    def noise_colour(self) -> Array:
        """Colour of the measurement noise, shape (n_pv,)."""
        return self.plant.noise_colour

    @property
    def dv_noise_std(self) -> Array:
        """Standard deviation of the noise of the measured disturbances, shape (n_dv,)."""
        return self.plant.dv_noise_std

    def parameter_names(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the plant's parameters."""
        return self.plant.parameter_names()

    def parameters(self, changed: Mapping[str, float] | None = None) -> Array:
        """The parameter vector with this plant's errors, some of them changed by name."""
        return self.plant.parameters({**self.changed, **(changed or {})})

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        """The state one period later."""
        return self.plant.step(x, mv, dv, p)

    def measure(self, x: Array) -> Array:
        """The process variables of a state."""
        return self.plant.measure(x)

    def measured(self, x: Array) -> Array:
        """Process variables (..., n_pv) of states (..., n_x)."""
        return self.plant.measured(x)

    def many(self, n: int, p: Array | None = None) -> AdvanceMany:
        """``step`` of ``n`` runs side by side; as in Simulator."""
        return self.plant.many(n, self.parameters() if p is None else p)
