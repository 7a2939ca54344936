"""The models of an own plant's record, of which one is the law's and the others stand in for the plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar
from zipfile import BadZipFile

import numpy as np

from loopwright.pipeline.cases.operating_range import ANSWERS_A_SET_POINT, OperatingRange, visited_mv
from loopwright.pipeline.cases.operator_asks import best_rest
from loopwright.pipeline.cases.own_model import LAW_PART, MODEL_ARRAYS, MODEL_SET, Doubts, OwnPlant, doubted, suits
from loopwright.pipeline.config.exports import is_exported
from loopwright.pipeline.errors import ModelError, PlantError, RecordError
from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.evaluation.evidence_basis import RecordVerdict
from loopwright.pipeline.evaluation.model_evidence import Metrics, identified_part
from loopwright.pipeline.evaluation.one_side import before_turns, on_one_side
from loopwright.pipeline.files import read_json
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.plants.simulator import Signals, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.records.record_file import RecordedSetPoints
from loopwright.pipeline.records.recorded_rests import RecordedRest, rests_of
from loopwright.pipeline.simulation.operator_changes import OperatedCourse
from loopwright.pipeline.simulation.rests import answered
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving.manifest import OperateEntry

MEMBERS = "plant*.npz"  # further models, in whose place no law is tuned
CURVE_MV_VALUES = 101  # values of an MV over its range at which the models' turns are sought: 1 % apart


class OwnEnsemble(Case):
    """A case whose plants are the models of a record; its subclass tests laws on them."""

    signals: ClassVar[Signals]  # the MVs with the ranges that laws may command, see ``commanded``
    record_signals: ClassVar[Signals]  # the MVs with the ranges of their readings
    models: ClassVar[Path]
    data: ClassVar[Path]

    @property
    def ready(self) -> bool:
        """Whether models and record are there and of these signals; those of a plant that was edited since are not."""
        return suits(self._law_file, self.signals) and self._recorded

    @cached_property
    def _recorded(self) -> bool:
        if not is_exported(self.name):
            return True  # a person's own record: whoever reads it says what is wrong
        try:
            _ = self.record
        except (RecordError, OSError):
            return False  # stage `screen` makes it anew
        return True

    @property
    def _law_file(self) -> Path:
        return self.models / f"{LAW_PART}.npz"

    @cached_property
    def plant(self) -> Simulator:
        """The law's own model in place of the plant; only its signals are known before it is trained."""
        return self._resting(self._model) if self.ready else self.plant_class()

    @property
    def _nominal(self) -> OwnPlant:
        assert isinstance(self.plant, OwnPlant)
        return self.plant

    @cached_property
    def _model(self) -> OwnPlant:
        """The law's own model, begun at the median MVs that laws may command."""
        return self._member(self._law_file, visited_mv(self.record, self.commanded.mv)[1])

    def rest_within_ranges(self, test: Scenario, entries: Sequence[OperateEntry], row: int, mv: Array) -> Array | None:
        """By the model of the test: ranges first, by their ranks, then set points; see ``RestProblem``."""
        plant = test.plant or self.plant
        if not entries or not isinstance(plant, IdentifiedPlant):
            return None
        course = OperatedCourse.of(entries, test.operate, test.samples, f"test {test.name!r}")
        best = best_rest(replace(test, plant=plant), course, mv, row)
        return None if best is None else best.y[: test.sp.shape[1]]

    @cached_property
    def members(self) -> tuple[OwnPlant, ...]:
        """The other models of the ensemble; PlantError where there are none."""
        paths = sorted(self.models.glob(MEMBERS))
        if not paths:
            raise PlantError(
                f"{self.models} holds no {MEMBERS}, the models to validate on; add parts plant1, plant2, ... of kind "
                f"identified to models.{self.name}-{MODEL_SET}, and run its fit stage"
            )
        return tuple(self._resting(self._member(path, self._model.start[1])) for path in paths)

    def _member(self, path: Path, mv: Array) -> OwnPlant:
        """A model that begins at MVs (n_mv,), and takes those that laws may command."""
        return self._over(self.commanded, path, mv)

    def _over(self, signals: Signals, path: Path, mv: Array) -> OwnPlant:
        """A model over the ranges of these signals; ModelError for a damaged file."""
        try:
            with np.load(path, allow_pickle=False) as file:
                found = {name: file[name] for name in MODEL_ARRAYS}
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            raise ModelError(f"{path} is damaged, or no identified model; remove it, and run its fit stage") from None
        dv = np.median(self.record.dv, axis=0)
        return OwnPlant.of_model(found, signals, name=self.name, mv=mv, dv=dv, dead=self._doubts.dead)

    @cached_property
    def _doubts(self) -> Doubts:
        """Errors that the record leaves open, by the law's own model: with them tests go wrong on all models."""
        with np.load(self._law_file, allow_pickle=False) as file:
            return Doubts.of(file)

    def ranges_of(self, plant: Simulator) -> Mapping[str, tuple[float, float]]:
        """Errors of gain, speed and dead time that the record leaves open, of a plant that is a model of it."""
        return doubted(plant, self._doubts) if isinstance(plant, OwnPlant) else self.ranges

    def _resting(self, plant: OwnPlant) -> OwnPlant:
        """The plant, begun where it rests within the record; most do so already."""
        rest = self.reach.rest(plant)
        return plant if rest is None else plant.begun_at(*rest)

    @cached_property
    def reach(self) -> OperatingRange:
        """The part of its range that the record visited, by the law's model."""
        return OperatingRange(self._model, self.record, self.kept_ranges)

    @cached_property
    def record(self) -> Record:
        """The record of the plant."""
        return Record.read(self.data, self.record_signals)

    @property
    def record_verdict(self) -> RecordVerdict | None:
        """The verdict of `loopwright new` or stage `screen` on the record, which lies beside it."""
        return RecordVerdict.beside(self.data)

    @cached_property
    def recorded(self) -> Mapping[str, tuple[float, float]]:
        """PV or MV -> its lowest and highest value in the record."""
        groups = ((self.signals.pv, self.record.pv), (self.signals.mv, self.record.mv))
        pairs = [(s, v) for signals, values in groups for s, v in zip(signals, values.T, strict=True)]
        return {s.name: (float(v.min()), float(v.max())) for s, v in pairs}

    @cached_property
    def commanded(self) -> Signals:
        """The signals of the laws: the MV ends where its gain turns, as the record proves or a model of it says.

        A model may also leave there what it had reached, see ``before_turns``.
        """
        low, median, high = visited_mv(self.record, self.signals.mv)[:, 0]
        found = on_one_side(self.signals, self._figures.get("proof") or {}, float(median))
        if len(found.mv) != 1 or len(found.sp) != 1 or not self.ready:
            return found
        (mv,) = found.mv
        values = np.linspace(mv.low, mv.high, CURVE_MV_VALUES)
        curves = [self._curves(path, values) for path in (self._law_file, *sorted(self.models.glob(MEMBERS)))]
        reached, rests = np.stack(curves, axis=1)
        visited = float(max(low, mv.low)), float(min(high, mv.high))
        return before_turns(found, values, reached, rests, visited)

    def _curves(self, path: Path, values: Array) -> Array:
        """The CV (2, n) that a model reaches from its rest under MVs (n,): when its answer is known, and in the end."""
        plant = self._over(self.signals, path, visited_mv(self.record, self.signals.mv)[1])
        (signal,), (start, _) = plant.sp_signals, plant.start
        known, rests = answered(plant, start, values[:, None], plant.foreseen)
        span = signal.high - signal.low
        # No record knows of curves out there.
        return np.asarray(np.clip([known[:, 0], rests[:, 0]], signal.low - span, signal.high + span))

    @property
    def same_row(self) -> bool:
        """Whether an MV of the record acts on the outputs of its own row, by the models."""
        return bool((self._figures.get("structure") or {}).get("same_row"))

    @property
    def _figures(self) -> Metrics:
        """The figures of the law's model; none before it is trained."""
        figures = self.models.parent / "metrics.json"
        return identified_part({"": read_json(figures)}) if figures.is_file() else {}

    @cached_property
    def set_points(self) -> Array | None:
        """The set points (n, n_cv) under which the record was made, NaN out of automatic; None where one is unknown."""
        found = RecordedSetPoints.beside(self.data)
        known = None if found is None else found.of([s.name for s in self.signals.sp])
        return known if known is not None and len(known) == len(self.record) else None

    @property
    def replayed(self) -> tuple[Record, int]:
        """The record, and the samples in which the slowest CV has half answered."""
        return self.record, self.reach.halfway

    @cached_property
    def recorded_rests(self) -> tuple[RecordedRest, ...]:
        """Rests of the record, by the settling time of the law's model."""
        return rests_of(self.record, self.reach.hold // ANSWERS_A_SET_POINT, self.reach.integrates)
