"""A person's own plant as a case: known by its record, and validated on models of that record."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from pipeline.config.params import PlantParams
from pipeline.errors import ParamsError, PlantError
from pipeline.evaluation.case import Array, Case
from pipeline.plants.identified import Identification, IdentifiedPlant, plant_of
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Simulator
from pipeline.records.record import Record
from pipeline.simulation.scenario import Scenario, held
from serving.errors import ArtifactError
from serving.manifest import Signal

MODEL_SET = LAW_PART = "identified"  # the model that laws are designed on
MEMBERS = "plant*.npz"  # further models, in whose place no law is tuned
VISITED = (0.1, 0.9)  # quantiles of the record's MV between which tests move
LEVELS = 6  # set points of a sequence
SETTLED = 0.05  # of a step
HOLD = (30, 400)  # fewest and most samples of a set point
LOAD = 0.1  # of the MV's range
GAINS = (0.8, 1.25)


class OwnCase(Case):
    """Tests of an own plant: on models of its record that had no part in tuning, and on such models spoilt.

    Set points are what the law's model reaches at rest under MVs of the record's range. The subclass of a plant
    states its signals, see ``own_case``.
    """

    development_seeds: ClassVar[tuple[int, ...]] = (1, 2)
    gate: ClassVar[Mapping[str, float]] = {"held_out": 0.5, "held_out_noise": 0.2, "load": 0.15, "gain": 0.15}
    evidence_of: ClassVar[str] = "identified"
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
        """The law's own model."""
        return self._member(self._law_file)

    @cached_property
    def members(self) -> tuple[IdentifiedPlant, ...]:
        """The other models of the ensemble; PlantError where there are none."""
        paths = sorted(self.models.glob(MEMBERS))
        if not paths:
            raise PlantError(
                f"{self.models} holds no {MEMBERS}, the models to validate on; add parts plant1, plant2, ... of kind "
                f"identified to models.{self.name}-{MODEL_SET}, and run its fit stage"
            )
        return tuple(map(self._member, paths))

    def _member(self, path: Path) -> IdentifiedPlant:
        return self.plant_class(partial(self._identification, path))  # type: ignore[call-arg,return-value]

    def _identification(self, path: Path) -> Identification:
        if not path.exists():
            raise PlantError(f"{path} is not there; `loopwright run {self.name}` trains the models of the plant first")
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files if key != "__model__"}
        return Identification(arrays, np.median(self.record.mv, axis=0), np.median(self.record.dv, axis=0))

    @cached_property
    def record(self) -> Record:
        """The record of the plant."""
        return Record.read(self.data, self.signals)

    @property
    def noise_std(self) -> Array:
        """Measurement noise as the law's model estimates it, shape (n_pv,)."""
        return self._law_model.noise_std

    @property
    def _law_model(self) -> IdentifiedPlant:
        assert isinstance(self.plant, IdentifiedPlant)
        return self.plant

    @cached_property
    def hold(self) -> int:
        """Samples of a set point: three times what the law's model needs to settle over the visited range."""
        low, high = self._visited_mv
        plant = self._law_model
        x, end = plant.at_rest(low), self._reached(high)
        start, step, y = self._reached(low), plant.stepper(), []
        state = np.append(x, 1.0)
        for _ in range(HOLD[1]):
            state = step(state, high, plant.dv_nominal, plant.parameters())
            y.append(plant.measure(state)[0])
        away = np.abs(np.array(y) - end) > SETTLED * abs(end - start)
        settled = int(np.flatnonzero(away)[-1]) + 2 if away.any() else 1
        return int(np.clip(3 * settled, *HOLD))

    @cached_property
    def _visited_mv(self) -> Array:
        return np.asarray(np.quantile(self.record.mv, VISITED, axis=0))

    def _reached(self, mv: Array) -> float:
        """The CV at rest under mv (n_mv,)."""
        plant = self._law_model
        return float(plant.measure(np.append(plant.at_rest(mv), 1.0))[0])

    def _sequence(self, seed: int) -> Array:
        """Set points (n, 1) that the law's model reaches at rest, within the range of the set point."""
        low, high = self._visited_mv
        sp = self.plant.sp_signals[0]
        moves = np.random.default_rng(seed).uniform(low, high, (LEVELS, len(low)))
        return held([float(np.clip(self._reached(mv), sp.low, sp.high)) for mv in moves], self.hold)

    def _test(
        self, name: str, title: str, sp: Array, plant: IdentifiedPlant, seed: int | None, **changed: float
    ) -> Scenario:
        changes = {key: np.full(len(sp), value) for key, value in changed.items()}
        x0, mv0 = plant.start
        if "gain" in changed:
            x0 = np.append(x0[:-1], changed["gain"])
        return Scenario(name, title, sp, x0, mv0, changes, self.hold if seed is not None else 0, seed, plant=plant)

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        """Set points on the other models; the same with another gain; and a load on the MV."""
        members, mv = self.members, self.plant.mv_signals[0]
        pairs = [(seed, members[i % len(members)]) for i, seed in enumerate(self.held_out_seeds)]
        held_out = "Set points, on models identified from the record"
        spoilt = "Set points, the plant's gain changed by a fifth"
        loads = f"A load of {LOAD:.0%} of {mv.name}'s range"
        rest = [np.full((2 * self.hold, 1), self._reached(plant.model.mv0)) for plant in members]
        load = LOAD * (mv.high - mv.low)
        return {
            "held_out": tuple(self._test("held_out", held_out, self._sequence(s), p, s) for s, p in pairs),
            "gain": tuple(
                self._test("gain", spoilt, self._sequence(s), p, s, gain=GAINS[i % len(GAINS)])
                for i, (s, p) in enumerate(pairs)
            ),
            "load": tuple(
                self._test("load", loads, sp, p, None, **{f"load_{mv.name}": sign * load})
                for sp, p, sign in zip(rest, members, np.resize([1.0, -1.0], len(members)), strict=True)
            ),
        }

    def development(self) -> tuple[Scenario, ...]:
        """Sequences on the law's own model."""
        return tuple(
            self._test("development", "Development", self._sequence(s), self._law_model, s)
            for s in self.development_seeds
        )


def own_case(name: str) -> Case:
    """The case of ``plants.<name>``; ParamsError for signals that cannot be, or more than one set point."""
    params, where = PlantParams.read(name), f"plants.{name}"
    signals = signals_of(params, where)
    title = params.title or name.replace("_", " ")
    own: dict[str, Any] = {
        "name": name,
        "title": title,
        "signals": signals,
        "plant_class": plant_of(name, title, signals),
        "models": Path("work") / name / "models" / MODEL_SET / "seed0",
        "data": params.data,
        "disclosure": "All tests ran on models identified from the record, none on the plant.",
    }
    return type("OwnPlantCase", (OwnCase,), own)((9001, 9002, 9003))


def signals_of(params: PlantParams, where: str) -> Signals:
    """The signals that the section of a plant states."""
    groups: dict[str, tuple[Signal, ...]] = {}
    for group in ("sp", "pv", "mv", "dv"):
        try:
            groups[group] = tuple(Signal.from_dict(dict(row)) for row in getattr(params, group))
        except (ArtifactError, KeyError, TypeError, ValueError) as error:
            raise ParamsError(f"{where}.{group}: {error}; each signal has name, unit, low and high") from None
    names = [s.name for s in groups["pv"]]
    if not groups["pv"] or not groups["mv"] or [s.name for s in groups["sp"]] != names[: len(groups["sp"])]:
        raise ParamsError(f"{where}: give at least one pv and one mv, and a set point for the first PVs, {names}")
    if len(groups["sp"]) != 1:
        raise ParamsError(
            f"{where}.sp has {len(groups['sp'])} set points; own plants are validated with one controlled variable "
            "so far"
        )
    return Signals(params.period_s, **groups)
