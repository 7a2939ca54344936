"""A plant as a closed loop needs it: its signals, where it starts, one step, and what is measured."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import PlantError
from loopwright.serving.manifest import Signal


@dataclass(frozen=True, slots=True)
class Signals:
    """Set points, process variables, measured disturbances, MVs, and the sampling period [s]."""

    period_s: float
    sp: tuple[Signal, ...]
    pv: tuple[Signal, ...]  # controlled variables first
    dv: tuple[Signal, ...]
    mv: tuple[Signal, ...]


Array = NDArray[np.float64]

Advance = Callable[[Array, Array, Array, Array], Array]
"""``advance(x (n_x,), mv (n_mv,), dv (n_dv,), p (n_p,)) -> x (n_x,)`` one period later."""

AdvanceMany = Callable[[Array, Array], Array]
"""``advance(x (n, n_x), mv (n, n_mv)) -> x (n, n_x)`` one period later."""


class Simulator(ABC):
    """A plant that can be simulated, one sampling period at a time, with its MV held.

    A subclass states its signals and writes ``start``, ``step`` and ``measure``; nothing else is needed to simulate
    it, to excite it, and to design, try and validate controllers for it. Parameters that may change during a run,
    unseen by the controller, are the numeric fields of a subclass that is a dataclass (each with
    ``metadata={"unit": ...}``); any other subclass has none.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    pv_signals: ClassVar[tuple[Signal, ...]]  # controlled variables first
    sp_signals: ClassVar[tuple[Signal, ...]]
    mv_signals: ClassVar[tuple[Signal, ...]]
    dv_signals: ClassVar[tuple[Signal, ...]] = ()
    period_s: ClassVar[float]

    @property
    @abstractmethod
    def start(self) -> tuple[Array, Array]:
        """(x (n_x,), mv (n_mv,)) where an experiment starts. The tuning rules need a start at rest."""

    @abstractmethod
    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        """The state (n_x,) one period after ``x`` (n_x,), under mv (n_mv,), dv (n_dv,) and the parameters p (n_p,).

        It keeps nothing of its own from step to step: all that the plant remembers stands in ``x``.
        """

    @abstractmethod
    def measure(self, x: Array) -> Array:
        """The process variables (n_pv,) of a state (n_x,)."""

    @property
    def signals(self) -> Signals:
        """The signals of a controller for this plant."""
        return Signals(self.period_s, self.sp_signals, self.pv_signals, self.dv_signals, self.mv_signals)

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.start[0])

    @property
    def dv_nominal(self) -> Array:
        """Nominal measured disturbances, shape (n_dv,)."""
        return np.zeros(len(self.dv_signals))

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise that a tuning in closed loop counts with, shape (n_pv,)."""
        return np.zeros(len(self.pv_signals))

    @property
    def noise_colour(self) -> Array:
        """Colour phi (n_pv,) of the measurement noise e(k) = phi e(k-1) + w(k): 0 of white noise."""
        return np.zeros(len(self.pv_signals))

    @property
    def dv_noise_std(self) -> Array:
        """Standard deviation (n_dv,) of the white noise of the measured disturbances."""
        return np.zeros(len(self.dv_signals))

    @property
    def foreseen(self) -> int | None:
        """Samples after a move over which its answer is known; None: all."""
        return None

    @property
    def asked(self) -> tuple[Array, Array]:
        """Lowest and highest set points (n_cv,) that loops are tuned for: the ends of their ranges."""
        low, high = (np.array([getattr(s, end) for s in self.sp_signals]) for end in ("low", "high"))
        return low, high

    def variations(self) -> tuple[Simulator, ...]:
        """The plants that a tuning must suit: this one, and what it may be where its equations are not certain."""
        return (self,)

    # ------------------------------------------------------------------ parameters
    @classmethod
    def parameter_names(cls) -> tuple[str, ...]:
        """Names of the plant's parameters, in the order of the parameter vector."""
        return tuple(f.name for f in fields(cls)) if is_dataclass(cls) else ()

    @classmethod
    def parameter_units(cls) -> dict[str, str]:
        """Unit of each parameter."""
        return {f.name: str(f.metadata.get("unit", "")) for f in fields(cls)} if is_dataclass(cls) else {}

    def parameters(self, changed: Mapping[str, float] | None = None) -> Array:
        """The parameter vector, shape (n_p,), with some of them changed by name.

        Raises PlantError for a name that the plant does not have.
        """
        names = self.parameter_names()
        values = {n: float(getattr(self, n)) for n in names}
        for key, value in (changed or {}).items():
            if key not in values:
                has = f"it has {', '.join(names)}" if names else "it has none"
                raise PlantError(f"plant {self.name!r} has no parameter {key!r}; {has}")
            values[key] = float(value)
        return np.array([values[n] for n in names])

    # ------------------------------------------------------------------ faster forms of step and measure
    def stepper(self) -> Advance:
        """``step`` for a loop over many samples."""
        return self.step

    def meter(self) -> Callable[[Array], Array]:
        """``measure`` for a loop over many samples."""
        return self.measure

    def many(self, n: int, p: Array | None = None) -> AdvanceMany:
        """``step`` of ``n`` runs side by side under its own measured disturbances and p (n_p,), by default its own."""
        dv, known = self.dv_nominal, self.parameters() if p is None else p

        def advance(x: Array, mv: Array) -> Array:
            return np.array([self.step(a, b, dv, known) for a, b in zip(x, mv, strict=True)], dtype=np.float64)

        return advance

    def measured(self, x: Array) -> Array:
        """Process variables, shape (..., n_pv), of states of shape (..., n_x)."""
        flat = x.reshape(-1, x.shape[-1])
        return np.array([self.measure(row) for row in flat], dtype=np.float64).reshape(*x.shape[:-1], -1)

    # ------------------------------------------------------------------ operating regions
    @property
    def regions(self) -> dict[str, tuple[float, float]]:
        """Operating regions by name: the range [low, high) of the CV in each, smallest CV first."""
        return {"all": (-np.inf, np.inf)}

    def region(self, cv: Array) -> NDArray[np.int64]:
        """Number among ``regions`` of the region of each controlled variable, same shape as ``cv``."""
        bounds = [low for low, _ in self.regions.values()][1:]
        return np.asarray(np.searchsorted(bounds, np.asarray(cv, dtype=np.float64), side="right"), dtype=np.int64)


# -------------------------------------- a plant under other parameters: what a tuning must suit beside the model itself
LEFT_OPEN_SDS = 2.0  # standard deviations of what a record leaves open


def likely_error(sd: Array, least: float, most: float) -> Array:
    """How far (n,) a plant may be off its model: ``LEFT_OPEN_SDS`` standard deviations, within ``least`` and ``most``.

    The least, as a plant does not stay as its record found it; the most, as beyond it a record tells nothing.
    """
    return np.clip(LEFT_OPEN_SDS * sd, least, most)


class PerturbedPlant(Simulator):
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
