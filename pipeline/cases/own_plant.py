"""A person's own plant as a case: known by its record, and validated on models of that record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from pipeline.config.plants import PlantParams, SignalParams
from pipeline.errors import PlantError
from pipeline.evaluation.case import Array, Case
from pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.plants.spoilt import SpoiltPlant
from pipeline.records.record import Record
from pipeline.simulation.scenario import Scenario, held
from pipeline.simulation.simulate import simulate_batch
from serving.manifest import Signal

MODEL_SET = LAW_PART = "identified"  # the model that laws are designed on
MEMBER_NUMBERS = (1, 2)
MEMBERS = "plant*.npz"  # further models, in whose place no law is tuned
VISITED = (0.1, 0.9)  # quantiles of the record's MV between which tests move
LEVELS = 6  # set points of a sequence
SETTLED = 0.05  # of a step
HOLD = (30, 400)  # fewest and most samples of a set point
LOAD = 0.25  # standard deviations of the record's CV
RESTING = 2_000  # samples
GAINS, SPEEDS, DELAYS = (0.8, 1.25), (1.25, 0.8), (1.0, 0.0)  # factors of gain and time constant; [periods]


class OwnPlant(IdentifiedPlant):
    """A model of an own plant, with the measurement noise of its record and the errors that it may have."""

    noise: Array

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise, shape (n_pv,)."""
        return self.noise

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


class OwnCase(Case):
    """Tests of an own plant: on models of its record that had no part in tuning, and on such models spoilt.

    Set points are what the law's model reaches at rest under MVs of the record's range. The subclass of a plant
    states its signals, see ``own_case``.
    """

    development_seeds: ClassVar[tuple[int, ...]] = (1, 2)
    gate: ClassVar[Mapping[str, float]] = {"held_out": 0.5, "held_out_noise": 0.2, "load": 0.15, "spoilt": 0.15}
    on_models: ClassVar[bool] = True
    data_seeds: ClassVar[int] = 1
    unforeseen: ClassVar[bool] = True
    signals: ClassVar[Signals]
    models: ClassVar[Path]
    data: ClassVar[Path]

    @property
    def ready(self) -> bool:
        """Whether the models are trained."""
        return self._law_file.exists()

    @property
    def _law_file(self) -> Path:
        return self.models / f"{LAW_PART}.npz"

    @cached_property
    def plant(self) -> Simulator:
        """The law's own model in place of the plant; only its signals are known before it is trained."""
        return self._member(self._law_file) if self.ready else self.plant_class()

    @property
    def _nominal(self) -> OwnPlant:
        assert isinstance(self.plant, OwnPlant)
        return self.plant

    @cached_property
    def members(self) -> tuple[OwnPlant, ...]:
        """The other models of the ensemble; PlantError where there are none."""
        paths = sorted(self.models.glob(MEMBERS))
        if not paths:
            raise PlantError(
                f"{self.models} holds no {MEMBERS}, the models to validate on; add parts plant1, plant2, ... of kind "
                f"identified to models.{self.name}-{MODEL_SET}, and run its fit stage"
            )
        return tuple(map(self._member, paths))

    def _member(self, path: Path) -> OwnPlant:
        with np.load(path, allow_pickle=False) as file:
            arrays = IdentifiedArrays(**{field.name: file[field.name] for field in fields(IdentifiedArrays)})
            noise = np.asarray(file["noise"] * file["y_scale"])
        mv, dv = (np.median(values, axis=0) for values in (self.record.mv, self.record.dv))
        plant = OwnPlant(self.signals, arrays, name=self.name, mv=mv, dv=dv, most_dead_time=int(max(DELAYS)))
        plant.noise = noise
        return plant

    @cached_property
    def record(self) -> Record:
        """The record of the plant."""
        return Record.read(self.data, self.signals)

    @property
    def noise_std(self) -> Array:
        """Measurement noise as the law's model estimates it, shape (n_pv,)."""
        return self._nominal.noise_std

    @cached_property
    def hold(self) -> int:
        """Samples of a set point: three times what the law's model needs to settle over the visited range."""
        courses = self._courses(self._visited_mv)
        (low, high), steps = courses[:, -1], courses[1] - courses[0]
        # From the same start, the difference of the two courses is the response to a step over the visited range.
        away = np.flatnonzero(np.abs(steps - (high - low)) > SETTLED * abs(high - low))
        return int(np.clip(3 * (away[-1] + 1 if away.size else 1), *HOLD))

    @cached_property
    def _visited_mv(self) -> Array:
        return np.asarray(np.quantile(self.record.mv, VISITED, axis=0))

    def _courses(self, mvs: Array) -> Array:
        """The CV (n, samples) of the law's model from its start under constant mvs (n, n_mv)."""
        starts = np.tile(self.plant.start[0], (len(mvs), 1))
        x = simulate_batch(self.plant, starts, np.repeat(mvs[:, None], RESTING, axis=1))
        return self.plant.measured(x)[..., 0]

    def _sequence(self, seed: int) -> Array:
        """Set points (n, 1) that the law's model reaches at rest, within the range of the set point."""
        low, high = self._visited_mv
        sp = self.plant.sp_signals[0]
        ends = self._courses(np.random.default_rng(seed).uniform(low, high, (LEVELS, len(low))))[:, -1]
        return held(np.clip(ends, sp.low, sp.high).tolist(), self.hold)

    def _test(
        self, name: str, title: str, sp: Array, plant: IdentifiedPlant, seed: int | None, **changed: float
    ) -> Scenario:
        changes = {key: np.full(len(sp), value) for key, value in changed.items()}
        x0, mv0 = plant.start
        return Scenario(name, title, sp, x0, mv0, changes, self.hold if seed is not None else 0, seed, plant=plant)

    def _load(self, plant: IdentifiedPlant) -> float:
        """The load [CV a period] that moves the CV by ``LOAD`` within a hold, if no controller acts."""
        (x, mv), name = plant.start, f"load_{plant.pv_signals[0].name}"
        y0, tried = plant.measure(x)[0], 1e-3 * float(self.record.pv[:, 0].std())
        p = plant.parameters({name: tried})
        for _ in range(self.hold):
            x = plant.step(x, mv, plant.dv_nominal, p)
        return tried * LOAD * float(self.record.pv[:, 0].std()) / abs(float(plant.measure(x)[0] - y0))

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        """Set points on the other models; the same on spoilt ones; and a load, upwards and downwards."""
        members, cv = self.members, self.plant.pv_signals[0]
        pairs = [(seed, members[i % len(members)], i % 2) for i, seed in enumerate(self.held_out_seeds)]
        sp = {seed: self._sequence(seed) for seed in self.held_out_seeds}
        held_out = "Set points, on models identified from the record"
        spoilt = "Set points, on such models with errors of gain, speed and dead time"
        loads = f"A load worth {LOAD:g} standard deviations of the record's {cv.name}"
        errors = errors_of(self._nominal)
        return {
            "held_out": tuple(self._test("held_out", held_out, sp[s], p, s) for s, p, _ in pairs),
            "spoilt": tuple(self._test("spoilt", spoilt, sp[s], p, s, **errors[i]) for s, p, i in pairs),
            "load": tuple(
                self._test(
                    "load",
                    loads,
                    np.full((2 * self.hold, 1), p.measure(p.start[0])[0]),
                    p,
                    None,
                    **{f"load_{cv.name}": (1 - 2 * i) * self._load(p)},
                )
                for _, p, i in pairs
            ),
        }

    def development(self) -> tuple[Scenario, ...]:
        """Sequences on the law's own model."""
        return tuple(
            self._test("development", "Development", self._sequence(s), self._nominal, s)
            for s in self.development_seeds
        )


def own_case(name: str, base: type[OwnCase] = OwnCase, **further: Any) -> Case:
    """The case of ``plants.<name>`` of params.yaml; ``base`` with ``further`` attributes is its class."""
    params = PlantParams.read(name)
    pv, mv, dv = (tuple(map(_signal, group)) for group in (params.pv, params.mv, params.dv))
    signals = Signals(params.period_s, pv[:1], pv, dv, mv)  # one variable is controlled so far, the first
    models, title = Path("work") / name / "models" / MODEL_SET / "seed0", name.replace("_", " ").capitalize()
    described = {f"{group}_signals": getattr(signals, group) for group in ("sp", "pv", "mv", "dv")}
    described |= {"name": name, "title": title, "period_s": signals.period_s, "needs": models}
    own: dict[str, Any] = {
        "name": name,
        "title": title,
        "signals": signals,
        "plant_class": type("OwnPlant", (Untrained,), described),
        "models": models,
        "data": params.data,
        "__module__": base.__module__,
    }
    return type("OwnPlantCase", (base,), own | further)((9001, 9002, 9003))


def _signal(params: SignalParams) -> Signal:
    return Signal(params.name, params.unit, params.low, params.high)


def entries_of(name: str, plant: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The entries of params.yaml for an own plant: its section, its tests, its models, and two controllers."""
    parts = {LAW_PART: {"kind": LAW_PART}, **{f"plant{k}": {"kind": LAW_PART, "member": k} for k in MEMBER_NUMBERS}}
    own = {"case": name, "model": MODEL_SET}
    return {
        "plants": {name: dict(plant)},
        "cases": {name: {"held_out_seeds": [9001, 9002, 9003], "noise_seed": 1}},
        "models": {f"{name}-{MODEL_SET}": {**own, "data": plant["data"], "parts": parts}},
        "controllers": {
            f"{name}-predictive": {**own, "name": "predictive", "law": "predictive", "tuning": "search"},
            f"{name}-pid": {**own, "name": "pid", "law": "pid"},
        },
    }
