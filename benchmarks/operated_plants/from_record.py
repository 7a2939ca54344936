"""Ours: a record of a plant, its model, the law with ``operate``, and the exported file stepped by the runtime."""

from __future__ import annotations

import hashlib
import pickle
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from operated_plant import OperatedPlant

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.files import write_bytes
from loopwright.pipeline.laws.predictive.params import PredictiveParams
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.identified.network_search import UNITS
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record
from loopwright.serving import Controller
from loopwright.serving.operating import Operate

FOLDER = Path(tempfile.gettempdir()) / "loopwright_operated_plants"
PIPELINE = Path(__file__).parents[2] / "pipeline"
CODE = (*(PIPELINE / "models").rglob("*.py"), PIPELINE / "historian" / "analyser_readings.py")
ROWS = 8_000


def record_of(plant: OperatedPlant, rows: int, seed: int = 0) -> Record:
    """Rows under an operator's random moves, with noise and all that wanders; an analyser reads at every row, late."""
    rng = np.random.default_rng(seed)
    dv, w = (
        np.column_stack([np.empty((rows, 0)), *(s.course(rows, rng) for s in of)])
        for of in (plant.dv_steps, plant.wanders)
    )
    noise = np.array(plant.noise) * rng.standard_normal((rows, len(plant.pv)))
    x, mv = plant.start
    low, high = (np.array([getattr(s, end) for s in plant.mv]) for end in ("low", "high"))
    most = np.array([np.inf if s.max_move is None else s.max_move for s in plant.mv])
    wanted, until, mv0 = mv.copy(), np.zeros(len(plant.mv)), mv.copy()
    held = {h.mv: h for h in plant.held}
    pv, mvs = np.empty((rows, len(plant.pv))), np.empty((rows, len(plant.mv)))
    for k in range(rows):
        pv[k] = plant.look(x)[1] + noise[k]
        for i in np.flatnonzero(until <= k):
            shortest, longest = held[i].look if i in held else plant.hold
            until[i] = k + rng.integers(shortest, longest + 1)
            if i in held:
                h = held[i]
                balance = mv0[i] + (h.of_dv * (dv[k, 0] - plant.dv0[0]) if h.of_dv else 0.0)
                balance += sum(share * (mv[j] - mv0[j]) for j, share in h.of_mv)
                wanted[i] = balance + h.gain * (pv[k, h.pv] - rng.uniform(h.low, h.high))
            else:
                wanted[i] = rng.uniform(*plant.moves[i])
        mv = mvs[k] = np.clip(np.clip(wanted, low, high), mv - most, mv + most)
        x = plant.step(x, mv, dv[k], w[k])
    return Record.of(plant.signals, pv, mvs, dv=dv)


@dataclass(frozen=True, slots=True)
class Fit:
    """How long the search for a model may take, and whether it tries networks beside linear models."""

    rows: int = ROWS
    minutes: float | None = 0.5
    networks: bool = False

    def model(self, plant: OperatedPlant) -> tuple[Identified, float]:
        """The model of all PVs, its other numbers by default, and the processor time [s] that it took."""
        model, _, seconds = self.learnt(plant, record_of(plant, self.rows))
        return model, seconds

    def learnt(self, plant: OperatedPlant, record: Record) -> tuple[Identified, Mapping[str, Any], float]:
        """The model of all PVs of a record, what its search says of it, and the processor time [s] that it took.

        A file keeps them, named after the record and the code of the models: a change of either fits again.
        """
        code = hashlib.sha256()
        for file in sorted(CODE):
            code.update(file.read_bytes())
        how = f"{self.minutes or 'default'}{'-networks' if self.networks else ''}"
        path = FOLDER / f"{plant.name}-{how}-{record.digest()[:12]}-{code.hexdigest()[:12]}.learnt"
        if not path.exists():
            began = time.process_time()
            units = UNITS if self.networks else ()
            part = IdentifiedPart(outputs="measured", minutes=self.minutes, units=units)
            learnt = part.learn(Source(record, plant.signals))
            write_bytes(path, pickle.dumps((learnt.model, learnt.metrics, time.process_time() - began)))
        found: tuple[Identified, Mapping[str, Any], float] = pickle.loads(path.read_bytes())
        return found


def params_of(plant: OperatedPlant) -> PredictiveParams:
    """As ``new`` writes them, with what operators have set: the law's numbers are searched on the model."""
    return PredictiveParams(operate=plant.operate, tuning="search")


def law_of(plant: OperatedPlant, model: Identified, tuning: Literal["given", "search"] = "search") -> Predictive:
    """The law with these parameters."""
    params = replace(params_of(plant), tuning=tuning)
    return Predictive.design(params, {"identified": model}, plant.signals, None).eval()


def controller_of(plant: OperatedPlant, law: Predictive) -> Controller:
    """The law's exported file, as the runtime loads it."""
    path = FOLDER / plant.name / "predictive.onnx"
    export(law, path, case=plant.name, provenance={})
    return Controller(path)


@dataclass
class Served:
    """The exported file through a day, by ``loopwright.serving.Controller``."""

    controller: Controller

    def __post_init__(self) -> None:
        self.state = self.controller.cold_state()
        self.operate: Array = Operate(self.controller.manifest.operate).default

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        first = np.ones_like(fresh) if not self.state.any() else fresh
        step = self.controller.step(
            sp=sp, pv=pv, dv=dv, mv_applied=mv, state=self.state, operate=self.operate, fresh=first
        )
        self.state = step.state
        return np.asarray(step.mv, dtype=np.float64)
