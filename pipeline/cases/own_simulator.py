"""An own plant with a simulator: the same tests, on the simulator itself instead of models of its record."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from loopwright.pipeline.cases.own_plant import LOADED, OwnCase, own_case
from loopwright.pipeline.cases.own_tests import LOAD_ROOM, load_size
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.plants.simulator_file import FileSimulator, files_of
from loopwright.pipeline.simulation.scenario import Scenario

LOADS = "load_"  # at the start of a parameter that is a load
APART = "spoilt"  # a test that needs errors of gain and dead time, which a simulator does not offer: on models
TRIED_LOAD = 1e-2  # of an MV's range: a load that the simulator's answer is measured with


class SimulatedCase(OwnCase):
    """Tests of an own plant on its simulator; laws are designed and tuned on models of its record alone.

    Set points and loads are those of ``OwnCase``. A load acts on the MV that moves the CV most, and would move it as
    far as on the models.
    """

    stand_in: ClassVar[str] = "simulator"
    simulator_file: ClassVar[Path]

    @cached_property
    def simulator(self) -> FileSimulator:
        """The simulator, with the period of the record."""
        first = FileSimulator(self.simulator_file, self.name)
        return FileSimulator(self.simulator_file, self.name, max(1, round(self.signals.period_s / first.period_s)))

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        """The tests of ``OwnCase`` on the simulator, but for ``spoilt``."""
        found = {
            name: tuple(map(_on_models if name == APART else self._on_simulator, tests))
            for name, tests in super().scenarios().items()
        }
        found[LOADED] = tuple(t for t in found.get(LOADED, ()) if any(v.any() for v in t.changes.values()))
        return {name: tests for name, tests in found.items() if tests}

    def _on_simulator(self, test: Scenario) -> Scenario:
        x0, mv0 = self.simulator.start
        changes: dict[str, Array] = {}
        for key, values in test.changes.items():
            cv = [s.name for s in self.simulator.pv_signals].index(key.removeprefix(LOADS))
            name, size = self._load_on_mv(cv)
            upwards = bool(values.sum() > 0)
            changes[name] = self._held(name, size if upwards else -size) * (values != 0)
        sp, dv = test.sp, test.dv
        if dv is not None:  # the same steps from where the simulator is
            dv = dv - dv[0] + self.simulator.dv_nominal
        if changes or dv is not None:  # such a test begins at rest
            sp = np.tile(self.simulator.measure(x0)[: sp.shape[1]], (len(sp), 1))
        # How much of a load the MVs can hold was found on the models.
        title = (
            self._load_title if changes else test.title.replace("models identified from the record", "the simulator")
        )
        return replace(test, title=title, sp=sp, plant=self.simulator, x0=x0, mv0=mv0, changes=changes, dv=dv)

    def _load_on_mv(self, cv: int) -> tuple[str, float]:
        """The load [MV's unit] that moves a CV by ``load_size`` within a hold, if no controller acts."""
        wanted = load_size(self.reach, cv)
        answers = {}
        for name, s in zip(self.simulator.parameter_names(), self.simulator.mv_signals, strict=True):
            tried = TRIED_LOAD * (s.high - s.low)
            answers[name] = abs(self._moved(self.simulator, name, tried, cv)) / tried
        name = max(answers, key=lambda key: answers[key])
        return name, wanted / max(answers[name], 1e-12)

    def _held(self, name: str, load: float) -> float:
        """The load on an MV, no larger than what the MV can take back within its range."""
        i = list(self.simulator.parameter_names()).index(name)
        signal, at = self.commanded.mv[i], float(self.simulator.start[1][i])
        room = LOAD_ROOM * (signal.high - signal.low)
        return float(np.clip(load, min(at - signal.high + room, 0.0), max(at - signal.low - room, 0.0)))

    def _moved(self, plant: Simulator, name: str, size: float, cv: int) -> float:
        """Change of a CV by a load over a hold, against the same hold without it."""
        ends = []
        for load in (size, 0.0):
            (x, mv), p = plant.start, plant.parameters({name: load})
            for _ in range(self.hold):
                x = plant.step(x, mv, plant.dv_nominal, p)
            ends.append(float(plant.measure(x)[cv]))
        return ends[0] - ends[1]


def _on_models(test: Scenario) -> Scenario:
    return replace(test, title=test.title.replace("such models", "models identified from the record"))


def simulated_case(name: str) -> Case:
    """The case of ``plants.<name>`` of params.yaml, which has a simulator."""
    file = PlantParams.read(name).simulator
    if file is None:
        raise ParamsError(f"plants.{name} has no simulator; `loopwright new NAME --simulator FILE` gives it one")
    return own_case(name, SimulatedCase, simulator_file=file, reads=files_of(file))
