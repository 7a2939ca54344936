"""Base of every excitation: numbers from params.yaml that make a record out of a plant and a seed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import noise_draws, simulate_open


def within(default: Any, least: float, most: float = np.inf) -> Any:
    """A field of an excitation that must lie in [least, most]; None, where the field allows it, always may stand."""
    return field(default=default, metadata={"range": (least, most)})


@dataclass(frozen=True, kw_only=True)
class Excitation(ABC):
    """An experiment of ``samples`` samples on a plant, repeatable by its seed.

    ``noise`` is the standard deviation of each PV's measurement noise [unit of the PV]; empty: no noise.
    """

    kind: ClassVar[str]
    samples: int = field(metadata={"range": (1, np.inf)})
    noise: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for f in fields(self):
            if "range" in f.metadata and getattr(self, f.name) is not None:
                self.require(f.name, *f.metadata["range"])

    @abstractmethod
    def run(self, plant: Simulator, seed: int) -> Record:
        """The record of the experiment; the same for the same seed."""

    def require(self, name: str, least: float, most: float = np.inf) -> None:
        """Raise ParamsError unless the field ``name`` lies in [least, most]."""
        value = getattr(self, name)
        if not least <= value <= most:
            allowed = f"at least {least:g}" if most == np.inf else f"between {least:g} and {most:g}"
            raise ParamsError(f"excitation {self.kind!r}: {name} is {value!r}; it must be {allowed}")

    def measured(
        self, plant: Simulator, x: Array, mv: Array, rng: np.random.Generator, run: NDArray[np.int64] | None = None
    ) -> Record:
        """The record of states x (n, n_x) and MVs (n, n_mv), measured with noise; one run unless ``run`` says."""
        pv = plant.measured(x) + noise_draws(plant, len(x), self.noise, rng)
        return Record.of(plant.signals, pv, mv, run=run, dv=plant.dv_nominal)


@dataclass(frozen=True, kw_only=True)
class OpenLoop(Excitation):
    """An excitation whose MVs do not depend on what the plant does.

    ``low`` and ``high`` are the range of the MVs [unit of the MV], inside their signals' range, which is the default.
    ``spacing`` "linear" spreads levels evenly over the range, "log" evenly over its logarithm: where an MV acts by
    its ratio (a flow by the time that it leaves), even levels hardly visit the low end. ``start`` is the state at
    sample 0; empty: where the plant's experiments start (``Simulator.start``).
    """

    low: float | None = None
    high: float | None = None
    spacing: Literal["linear", "log"] = "linear"
    start: tuple[float, ...] = ()

    @abstractmethod
    def unit_sequence(self, n_mv: int, rng: np.random.Generator) -> Array:
        """The MVs on [0, 1], shape (samples, n_mv)."""

    def run(self, plant: Simulator, seed: int) -> Record:
        """The record of one run; the MVs and the noise come from ``seed``."""
        rng = np.random.default_rng(seed)
        mv = self.levels(plant, self.unit_sequence(len(plant.mv_signals), rng))
        return self.measured(plant, simulate_open(plant, self.initial_state(plant), mv)[:-1], mv, rng)

    def levels(self, plant: Simulator, unit: Array) -> Array:
        """The MVs for values on [0, 1], shape (n, n_mv): over the range, of a discrete MV its values by equal shares.

        Raises ParamsError where ``low`` and ``high`` leave the signals' ranges, or leave a discrete MV no value.
        """
        low, high = self.limits(plant)
        mv = low * (high / low) ** unit if self.spacing == "log" else low + (high - low) * unit
        # Rounding may put the last bit of a limit outside it.
        mv = np.clip(mv, low, high)
        for i, s in enumerate(plant.mv_signals):
            if s.values is not None:
                allowed = np.array([v for v in s.values if low[i] <= v <= high[i]])
                if not allowed.size:
                    raise ParamsError(
                        f"excitation {self.kind!r}: {s.name} may be {list(s.values)}, and none of these lies between "
                        f"{low[i]:g} and {high[i]:g}"
                    )
                mv[:, i] = allowed[np.minimum((unit[:, i] * len(allowed)).astype(np.int64), len(allowed) - 1)]
        return mv

    def limits(self, plant: Simulator) -> tuple[Array, Array]:
        """Lowest and highest MVs, shape (n_mv,); ParamsError where they leave the signals' ranges."""
        low = np.array([s.low if self.low is None else self.low for s in plant.mv_signals])
        high = np.array([s.high if self.high is None else self.high for s in plant.mv_signals])
        for s, a, b in zip(plant.mv_signals, low, high, strict=True):
            if not s.low <= a < b <= s.high:
                raise ParamsError(
                    f"excitation {self.kind!r}: {s.name} would run from {a:g} to {b:g} {s.unit}; "
                    f"low < high within {s.low:g} to {s.high:g} are allowed"
                )
            if self.spacing == "log" and not a > 0:
                raise ParamsError(
                    f"excitation {self.kind!r}: {s.name} runs from {a:g} {s.unit}, which has no logarithm; "
                    "give a low above 0, or spacing: linear"
                )
        return low, high

    def initial_state(self, plant: Simulator) -> Array:
        """State at sample 0, shape (n_x,)."""
        return np.array(self.start) if self.start else plant.start[0]
