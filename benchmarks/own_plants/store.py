"""What the benchmark keeps on disk: fitted models and the NMPC's figures, so that a law is worked on without them."""

from __future__ import annotations

import hashlib
import inspect
import pickle
import tempfile
import time
from pathlib import Path

import numpy as np
from loops import tests_of
from plant import OwnPlant
from record import record_of

from loopwright.pipeline.evaluation.case import Effort
from loopwright.pipeline.files import write_bytes
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.optimal.perfect import PerfectNmpc, run_nmpc
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.scenario import Scenario

FOLDER = Path(tempfile.gettempdir()) / "loopwright_own_plants"
CODE = Path(__file__).parents[2] / "pipeline" / "models"


def model_of(plant: OwnPlant, rows: int, minutes: float | None = None) -> tuple[Identified, float]:
    """The model fitted to the plant's record with all defaults, and the processor time [s] that the fit took.

    ``minutes`` is the budget of its search; None: as many as the part takes by itself.
    A file is named after the record and the code of the models, so that a change of either fits again.
    """
    record, code = record_of(plant, rows), hashlib.sha256()
    for file in sorted(CODE.rglob("*.py")):
        code.update(file.read_bytes())
    path = FOLDER / f"{plant.name}-{rows}-{minutes or 'default'}-{record.digest()[:12]}-{code.hexdigest()[:12]}.pickle"
    if not path.exists():
        began = time.process_time()
        model = IdentifiedPart(minutes=minutes).learn(Source(record, plant.signals)).model
        write_bytes(path, pickle.dumps((model, time.process_time() - began)))
    found: tuple[Identified, float] = pickle.loads(path.read_bytes())
    return found


def nmpc_of(plant: OwnPlant, every: int) -> PerfectNmpc:
    """The NMPC that knows the equations; it solves at every so many samples where nothing surprises it."""
    return PerfectNmpc(plant, effort=Effort(periods=max(40, plant.hold // 2), elements=1, every=every))


def bound_of(plant: OwnPlant, sequences: int | None = None) -> float:
    """Set-point nMAE [%] of the NMPC that knows the equations and the state, without noise, over so many sequences.

    NaN of a plant with which its solver does not come to an end.
    """
    if not plant.bounded:
        return np.nan
    tests = [t.scenario for t in tests_of(plant)["set points"][:sequences]]
    known = [inspect.getsource(type(plant)), *(t.digest() for t in tests)]
    path = FOLDER / f"{plant.name}-nmpc-{hashlib.sha256(''.join(known).encode()).hexdigest()[:12]}.pickle"
    if not path.exists():
        nmpc = nmpc_of(plant, every=8)
        span = np.array([s.high - s.low for s in plant.sp_signals])

        def score(test: Scenario, pv: Array, mv: Array) -> dict[str, float]:
            return {"nmae": 100 * float((np.abs(test.sp - pv) / span).mean())}

        runs = [run_nmpc(nmpc, t, unforeseen=True, score=score) for t in tests]
        write_bytes(path, pickle.dumps(float(np.mean([r["nmae"] for r in runs]))))
    found: float = pickle.loads(path.read_bytes())
    return found
