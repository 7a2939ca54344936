"""A model of a person's own plant as the plant of tests: with its noise, and with the errors that it may have."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from pipeline.errors import PlantError
from pipeline.plants.identified import IdentifiedPlant
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array, Simulator
from pipeline.plants.spoilt import SpoiltPlant

GAINS, SPEEDS, DELAYS = (0.8, 1.25), (1.25, 0.8), (1.0, 0.0)  # factors of gain and time constant; [periods]


class OwnPlant(IdentifiedPlant):
    """A model of an own plant, with the measurement noise of its record and the errors that it may have."""

    noise: Array
    rest: tuple[Array, Array] | None = None

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise, shape (n_pv,)."""
        return self.noise

    @property
    def start(self) -> tuple[Array, Array]:
        """(state (n_x,), mv (n_mv,)) of a rest."""
        return super().start if self.rest is None else (self.rest[0].copy(), self.rest[1].copy())

    def begun_at(self, x: Array, mv: Array) -> Self:
        """The same plant with another start; its errors of gain turn about the MVs there, so that it stays a rest."""
        other = type(self)(
            self.signals, self.arrays, name=self.name, mv=mv, dv=self.dv_nominal, most_dead_time=self.most_dead_time
        )
        other.noise, other.rest = self.noise, (x, mv)
        return other

    def variations(self) -> tuple[Simulator, ...]:
        """The model itself, and with errors of gain, speed and dead time."""
        return (self, *(SpoiltPlant(self, errors) for errors in errors_of(self)))


def errors_of(plant: IdentifiedPlant) -> list[dict[str, float]]:
    """Parameters of the spoilt plants: slow with a high gain and a longer dead time, fast with a low gain."""
    gains = [dict.fromkeys((f"gain_{s.name}" for s in plant.mv_signals), gain) for gain in GAINS]
    return [
        {**gain, "time_constant": speed, "dead_time": delay}
        for gain, speed, delay in zip(gains, SPEEDS, DELAYS, strict=True)
    ]


def suits(file: Path, signals: Signals) -> bool:
    """Whether a trained model is there and has as many outputs and inputs as the plant has signals."""
    if not file.exists():
        return False
    with np.load(file, allow_pickle=False) as arrays:
        n_y, n_v = len(arrays["y_scale"]), len(arrays["v_scale"])
    return n_y <= len(signals.pv) and n_v == len(signals.mv) + len(signals.dv)


class Untrained(Simulator):
    """A plant of which only the signals are known yet."""

    needs: ClassVar[Path]  # the folder of the models

    @property
    def start(self) -> tuple[Array, Array]:
        """Raises PlantError, as all that follows."""
        raise self._error

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        """Raises PlantError."""
        raise self._error

    def measure(self, x: Array) -> Array:
        """Raises PlantError."""
        raise self._error

    @property
    def _error(self) -> PlantError:
        return PlantError(
            f"{self.needs} holds no model; `loopwright run {self.name}` trains the models of the plant first"
        )
