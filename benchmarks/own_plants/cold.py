"""Laws started cold at rests of the record: how far from the record's MV they ask for."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from closed_plant import ClosedPlant
from closed_product import read
from closed_record import closed_record_of, roles, write_export
from plant import OwnPlant
from record import record_of

from loopwright.pipeline.cases.operating_range import ANSWERS_A_SET_POINT, OperatingRange
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.evaluation.open_loop import cold_start
from loopwright.pipeline.records.recorded_rests import rests_of
from loopwright.pipeline.workbench import PlantData, design, export, identify
from loopwright.pipeline.workbench.plant_data import signals_of

COLD_ROWS = 4_000
COLD_HEAD = (
    "distance from the record's MVs [% of the range]\n"
    f"{'plant':12} {'record':>6} {'model':>8} {'rests':>6} {'first':>8} {'later':>8} {'quarter':>8}  farthest at"
)


def data_of(plant: OwnPlant, rows: int) -> PlantData:
    """The plant's record: in closed loop from the file of a historian, else as it is."""
    if isinstance(plant, ClosedPlant):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"{plant.name}.csv"
            write_export(plant, closed_record_of(plant, rows), file)
            return read(file, roles(plant))
    record = record_of(plant, rows)
    return PlantData(record, signals_of(record), {})


def cold_row(plant: OwnPlant, rows: int, minutes: float) -> str:
    """A row of text for the predictive law; the PID in velocity form adds nothing to the MV at any rest."""
    began, data = time.process_time(), data_of(plant, rows)
    found = identify(data, minutes=minutes)
    reach = OperatingRange(found.plant, data.record)
    rests = rests_of(data.record, reach.hold // ANSWERS_A_SET_POINT, reach.integrates)
    kind = "closed" if isinstance(plant, ClosedPlant) else "open"
    head = f"{plant.name:12} {kind:>6} {'network' if len(found.model.b1) else 'linear':>8}"
    with tempfile.TemporaryDirectory() as folder:
        try:
            file = export(design("predictive", found), Path(folder) / "predictive.onnx")
        except PipelineError as error:
            return f"{head} {len(rests):6d} no law: {error}"
        of = cold_start([file], rests, data.signals)
    at = ", ".join(f"{name} {level:.3g}" for name, level in of.at.items())
    figures = "".join("-".rjust(9) if v is None else f"{v:9.2g}" for v in (of.first, of.later, of.quarter))
    return f"{head} {of.rests:6d}{figures}  {at} ({time.process_time() - began:.0f} s)"
