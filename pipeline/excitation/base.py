"""What every excitation is: numbers from params.yaml that make a record out of a plant and a seed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pipeline.errors import ParamsError
from pipeline.plants.base import Array, Plant
from pipeline.record import Record
from pipeline.simulate import measured, noise_draws, simulate_open


@dataclass(frozen=True, kw_only=True)
class Excitation(ABC):
    """An experiment on a plant, repeatable by its seed.

    Attributes
    ----------
    samples : int
        Number of samples [-].
    noise : tuple of float
        Standard deviation of the measurement noise of each PV [unit of the PV]; empty: no noise.
    """

    kind: ClassVar[str]
    samples: int = 60_000
    noise: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        self.require("samples", 1)

    @abstractmethod
    def run(self, plant: Plant, seed: int) -> Record:
        """The record of the experiment; the same for the same seed."""

    def require(self, name: str, least: float, most: float = np.inf) -> None:
        """Raise ParamsError unless the field ``name`` lies in [least, most]."""
        value = getattr(self, name)
        if not least <= value <= most:
            allowed = f"at least {least:g}" if most == np.inf else f"between {least:g} and {most:g}"
            raise ParamsError(f"excitation {self.kind!r}: {name} is {value!r}; it must be {allowed}")


@dataclass(frozen=True, kw_only=True)
class OpenLoop(Excitation):
    """An excitation whose MVs do not depend on what the plant does.

    Attributes
    ----------
    low, high : float, optional
        Range of the MVs [unit of the MV], inside their signals' range, which is the default.
    start : tuple of float
        State at sample 0; empty: where the plant's experiments start (``Plant.start``).
    """

    low: float | None = None
    high: float | None = None
    start: tuple[float, ...] = ()

    @abstractmethod
    def unit_sequence(self, n_mv: int, rng: np.random.Generator) -> Array:
        """The MVs on [0, 1], shape (samples, n_mv)."""

    def run(self, plant: Plant, seed: int) -> Record:
        """The record of one run; the MVs and the noise come from ``seed``."""
        rng = np.random.default_rng(seed)
        low, high = self.limits(plant)
        mv = low + (high - low) * self.unit_sequence(len(low), rng)
        # Rounding may put the last bit of a limit outside it.
        mv = np.clip(mv, low, high)
        x = simulate_open(plant, self.initial_state(plant), mv)[:-1]
        return Record.of(plant, measured(plant, x) + noise_draws(plant, len(x), self.noise, rng), mv)

    def limits(self, plant: Plant) -> tuple[Array, Array]:
        """Lowest and highest MVs, shape (n_mv,); ParamsError where they leave the signals' ranges."""
        low = np.array([s.low if self.low is None else self.low for s in plant.mv_signals])
        high = np.array([s.high if self.high is None else self.high for s in plant.mv_signals])
        for s, a, b in zip(plant.mv_signals, low, high, strict=True):
            if not s.low <= a < b <= s.high:
                raise ParamsError(
                    f"excitation {self.kind!r}: {s.name} would run from {a:g} to {b:g} {s.unit}; "
                    f"low < high within {s.low:g} to {s.high:g} are allowed"
                )
        return low, high

    def initial_state(self, plant: Plant) -> Array:
        """State at sample 0, shape (n_x,)."""
        return np.array(self.start) if self.start else plant.start[0]
