"""A model of a person's own plant as the plant of tests: with its noise, and with the errors that it may have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np

from loopwright.pipeline.engine.run_mark import runs_here
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.historian.settling import MOST_PERIODS
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant, longest_memory
from loopwright.pipeline.plants.noise import deviation
from loopwright.pipeline.plants.simulator import Array, PerturbedPlant, Signals, Simulator, likely_error
from loopwright.pipeline.simulation.scenario import Scenario

# Least errors: a plant does not stay as its record found it. Relative; of the dead time in periods.
LEAST_GAIN_ERROR, LEAST_PACE_ERROR, LEAST_DEAD_ERROR = 0.25, 0.25, 1.0
# twice the gain; beyond that a record tells nothing worth a test
MOST_GAIN_ERROR, MOST_PACE_ERROR, MOST_DEAD_ERROR = 1.0, 0.8, 5.0

MODEL_ARRAYS = (
    *(field.name for field in fields(IdentifiedArrays)),
    *("noise", "colour", "dv_noise", "gain_sd", "pace_sd", "dead_sd"),
)

MODEL_SET = LAW_PART = "identified"  # the model that laws are designed on
VISITED = 2.0  # standard deviations of an output in the record


class Doubts(NamedTuple):
    """Errors that a plant may have beside the model of its record, relative, of the dead time in periods.

    Twice the standard deviations that the record leaves open, at least a quarter and a period.
    """

    gain: tuple[float, ...]  # of each MV
    pace: float  # of the time constant
    dead: float

    @classmethod
    def of(cls, arrays: Mapping[str, Array]) -> Self:
        """From ``gain_sd`` (n_mv,), ``pace_sd`` (1,) and ``dead_sd`` (1,) of an identified model."""
        gain = likely_error(arrays["gain_sd"], LEAST_GAIN_ERROR, MOST_GAIN_ERROR)
        pace = likely_error(arrays["pace_sd"], LEAST_PACE_ERROR, MOST_PACE_ERROR)
        dead = likely_error(arrays["dead_sd"], LEAST_DEAD_ERROR, MOST_DEAD_ERROR)
        return cls(tuple(map(float, gain)), float(pace[0]), float(dead[0]))


# Kinds of plants gone wrong. The last one stands for the dead times that explain the record as the model's does: a
# model with one has about the same gain and pace.
SLOW, FAST, LATE = "slow", "fast", "late alone"


@dataclass(frozen=True, slots=True)
class GoneWrong:
    """A plant gone wrong: its kind, and its parameters, gains and time constant as factors, dead time in periods."""

    kind: str
    parameters: Mapping[str, float]

    @classmethod
    def on(cls, test: Scenario) -> Self:
        """The plant of a test on one."""
        names = ("time_constant", "dead_time")
        own = {k: float(v[0]) for k, v in test.changes.items() if k in names or k.startswith("gain_")}
        return cls(test.kind, own)

    @property
    def as_likely(self) -> Self:
        """The same kind with errors that are together as likely as one of them alone: n errors by 1/sqrt(n) each.

        Independent errors of k standard deviations each are together sqrt(n) k from none. Whole ones all at once are a
        plant that hardly comes about, and rank laws otherwise than plants do that changed (docs/benchmarks.md).
        """
        gains = {k: v for k, v in self.parameters.items() if k.startswith("gain_")}
        wrong = (
            any(v != 1 for v in gains.values()),
            self.parameters["time_constant"] != 1,
            self.parameters["dead_time"] != 0,
        )
        return self.lessened(max(sum(wrong), 1) ** -0.5)

    def lessened(self, share: float) -> Self:
        """The same kind, gone wrong by a share of these errors: factors to its power, dead times times it."""
        less = {k: v * share if k == "dead_time" else v**share for k, v in self.parameters.items()}
        return replace(self, parameters=less)

    def __str__(self) -> str:
        """In words."""
        of = dict(self.parameters)
        later, pace = float(of.pop("dead_time")), float(of.pop("time_constant"))
        factors = sorted({round(gain if pace >= 1 else 1 / gain, 2) for gain in (min(of.values()), max(of.values()))})
        gain = " to ".join(f"{factor:g}" for factor in factors)
        words = {
            SLOW: f"gain {gain} times as high, {pace:.3g} times as slow",
            FAST: f"gain {gain} times as low, {1 / pace:.3g} times as fast",
            LATE: "as the model",
        }[self.kind]
        return f"{self.kind}: {words}" + (f", {later:.2g} period{'s' * (later != 1)} later" if later else "")


class OwnPlant(IdentifiedPlant):
    """A model of an own plant, with the measurement noise of its record and the errors that the record leaves open."""

    noise: Array
    dv_noise: Array
    colour: Array
    doubts: Doubts
    rest: tuple[Array, Array] | None = None

    @classmethod
    def of_model(
        cls, found: Mapping[str, Array], signals: Signals, *, name: str, mv: Array, dv: Array, dead: float = 0.0
    ) -> Self:
        """The plant of an identified model's arrays, begun at MVs (n_mv,) under measured disturbances (n_dv,).

        It may be later than the model by ``dead`` periods, or by the dead times that its record leaves open.
        """
        doubts = Doubts.of(found)
        arrays = IdentifiedArrays(**{field.name: found[field.name] for field in fields(IdentifiedArrays)})
        most = int(np.ceil(max(doubts.dead, dead)))
        plant = cls(signals, arrays, name=name, mv=mv, dv=dv, most_dead_time=most)
        plant.noise = deviation(found["noise"] * found["y_scale"], found["colour"])
        plant.dv_noise = found["dv_noise"] * found["v_scale"][len(signals.mv) :]
        plant.colour, plant.doubts = found["colour"], doubts
        return plant

    @property
    def foreseen(self) -> int:
        """Samples after a move: as many as predictive control looks ahead at most, after the dead time.

        A record with loads says little of later samples.
        Without the dead time, an MV that acts after as many samples would seem not to act.
        """
        return MOST_PERIODS + longest_memory(self.arrays)

    @property
    def asked(self) -> tuple[Array, Array]:
        """The outputs that the record visited, two standard deviations to each side, within the set points' ranges.

        A range is often a transmitter's: moves over all of it drive an MV to its ends, and what suits them is too slow
        for what operators ask for.
        """
        low, high = super().asked
        n, of = len(low), self.arrays
        middle, half = of.y_center[:n], VISITED * of.y_scale[:n]
        return np.clip(middle - half, low, high), np.clip(middle + half, low, high)

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise, shape (n_pv,)."""
        return self.noise

    @property
    def noise_colour(self) -> Array:
        """Colour of the measurement noise, shape (n_pv,)."""
        return self.colour

    @property
    def dv_noise_std(self) -> Array:
        """Standard deviation of the noise of the measured disturbances, shape (n_dv,)."""
        return self.dv_noise

    @property
    def start(self) -> tuple[Array, Array]:
        """(state (n_x,), mv (n_mv,)) of a rest."""
        return super().start if self.rest is None else (self.rest[0].copy(), self.rest[1].copy())

    def begun_at(self, x: Array, mv: Array) -> Self:
        """The same plant with another start; its errors of gain turn about the MVs there, so that it stays a rest."""
        other = type(self)(
            self.signals, self.arrays, name=self.name, mv=mv, dv=self.dv_nominal, most_dead_time=self.most_dead_time
        )
        other.noise, other.dv_noise, other.colour = self.noise, self.dv_noise, self.colour
        other.doubts, other.rest = self.doubts, (x, mv)
        return other

    def variations(self) -> tuple[Simulator, ...]:
        """The model itself, and with errors of gain, speed and dead time."""
        return (self, *(PerturbedPlant(self, wrong.parameters) for wrong in errors_of(self)))


def errors_of(plant: OwnPlant) -> list[GoneWrong]:
    """The plants gone wrong: slow and late with a high gain; fast with a low gain; and late alone.

    There is none of the last kind where the dead times end within ``LEAST_DEAD_ERROR``.
    """
    d = plant.doubts
    high = {f"gain_{s.name}": 1 + error for s, error in zip(plant.mv_signals, d.gain, strict=True)}
    low, same = {name: 1 / gain for name, gain in high.items()}, dict.fromkeys(high, 1.0)
    found = [
        GoneWrong(SLOW, {**high, "time_constant": 1 + d.pace, "dead_time": LEAST_DEAD_ERROR}),
        GoneWrong(FAST, {**low, "time_constant": 1 / (1 + d.pace), "dead_time": 0.0}),
    ]
    late = GoneWrong(LATE, {**same, "time_constant": 1.0, "dead_time": d.dead})
    return [*found, late] if d.dead > LEAST_DEAD_ERROR else found


def doubted(plant: OwnPlant, doubts: Doubts) -> dict[str, tuple[float, float]]:
    """Parameter -> range within which the plant may lie: from 1 / (1 + error) to 1 + error, dead time from 0 on."""
    gains = {f"gain_{s.name}": (1 / (1 + e), 1 + e) for s, e in zip(plant.mv_signals, doubts.gain, strict=True)}
    return {**gains, "time_constant": (1 / (1 + doubts.pace), 1 + doubts.pace), "dead_time": (0.0, doubts.dead)}


def suits(file: Path, signals: Signals) -> bool:
    """Whether a trained model is there, with all that one of today has, and as many outputs and inputs as the plant."""
    if not file.exists():
        return False
    with np.load(file, allow_pickle=False) as arrays:
        if "dv_noise" not in arrays:  # of an older release: its fit runs again
            return False
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
        return PlantError(f"{self.needs} holds no model; {to_train(self.name)}")


def to_train(plant: str) -> str:
    """A clause for a person without the models of a plant: run it, or wait for the run that is under way."""
    if not runs_here():
        return f"`loopwright run {plant}` trains the models of the plant first"
    return (
        f"a run is under way in this folder: its stage `fit {plant}-{MODEL_SET}` trains them, so wait for its end; if "
        f"that run is of another plant, `loopwright run {plant}` comes after it"
    )
