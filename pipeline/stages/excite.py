"""Stage excite: one record a data seed."""

from __future__ import annotations

import shutil
import sys
from functools import partial
from pathlib import Path

from loopwright.pipeline.cases import all_cases, beside
from loopwright.pipeline.config.params import RecordParams, choose, parse
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.excitation import EXCITATIONS, Excitation
from loopwright.pipeline.files import write_json
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.stages.paths import record_folder


def excite(name: str) -> None:
    """Write the records of ``records.<name>``: seed<k>.parquet each, and metrics.json."""
    params = RecordParams.read(name)
    where = f"records.{name}"
    case = choose(all_cases(), params.case, "case", where)
    kind = choose(excitations(case), params.kind, "excitation", where)
    excitation = parse(kind, params.excitation, where)
    folder = record_folder(params.case, params.record)
    shutil.rmtree(folder, ignore_errors=True)
    rows = parallel_map(
        partial(_record, excitation, case.plant, folder),
        params.seeds,
        f"excite {name}: experiments on the simulated plant",
        in_folder=True,
    )
    write_json(folder / "metrics.json", {"record": params.record, "per_seed": dict(rows)})


def excitations(case: Case) -> dict[str, type[Excitation]]:
    """The kinds of excitation that a record of the case may have: the general ones and its own."""
    return {**EXCITATIONS, **beside(case, "excitations", "EXCITATIONS", {})}


def _record(excitation: Excitation, plant: Simulator, folder: Path, seed: int) -> tuple[str, dict[str, object]]:
    record = excitation.run(plant, seed)
    record.write(folder / f"seed{seed}.parquet")
    where = plant.region(record.pv[:, 0])
    share = {name: float((where == i).mean()) for i, name in enumerate(plant.regions)}
    return str(seed), {"rows": len(record), "regions": share, "digest": record.digest()}


if __name__ == "__main__":
    sys.exit(run_stage(excite, sys.argv, "RECORD"))
