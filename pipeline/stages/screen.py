"""Stage screen: the record of an own plant, made again of its export files."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace

from loopwright.pipeline.config.exports import SCREENED, ExportParams, screened_record
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.files import write_json
from loopwright.pipeline.historian.cleaning.record_rows import evenly
from loopwright.pipeline.historian.export_params import (
    as_stated,
    check_agreement,
    check_period,
    limits_of,
    read_and_screen,
    signal_tags,
    with_units,
    within_stated,
)
from loopwright.pipeline.historian.old_loop_fit import set_points
from loopwright.pipeline.historian.screening import refusal
from loopwright.pipeline.report.screening import write_page


def screen(name: str) -> None:
    """Write the record of ``exports.<name>``, its screening.json and screening.html, and metrics.json.

    ParamsError where the section disagrees with ``plants.<name>``, whose ranges prevail over what the readings show;
    RecordError where a file is missing or the record cannot be used.
    """
    params, plant = ExportParams.read(name), PlantParams.read(name)
    tags = limits_of(plant, signal_tags(params.tags))
    check_agreement(params, plant, tags)
    tags = with_units(tags, params)
    check_agreement(params, plant, tags)
    found = read_and_screen(params, tags)
    check_period(params, plant, found.record.period_s)
    stated = within_stated(plant, tags, found.record)
    if stated != tags:  # readings go beyond the plant's ranges: they are left out, and counted
        found = read_and_screen(params, stated)
    refused = refusal(found, tags, params.anyway)
    if refused:
        helps = [f"`loopwright new {name}` with --replace writes the step test to run"] * refused.step_test
        helps += [f"write `anyway: true` in exports.{name}"] * refused.anyway
        raise RecordError("; ".join(filter(None, (refused.why, ", or ".join(helps)))))
    record, report = as_stated(plant, found.record), found.report
    path = screened_record(name)
    shutil.rmtree(path.parent, ignore_errors=True)
    record.write(path)
    modes = {t.tag: found.series[t.tag].categories for t in tags if t.role == "mode"}
    believed = {law.pv for law in report.old_controllers if law.believed}
    set_points(found.grid, found.code, tags, modes, believed).write(path)
    write_json(path.with_name("screening.json"), report.to_dict())
    rows = {"rows": len(record), "digest": record.digest()}
    write_json(path.with_name("metrics.json"), {"record": SCREENED, "files": report.files, "per_seed": {"0": rows}})
    found = replace(found, record=evenly(record))  # a page needs no more
    write_page(path.with_name("screening.html"), found, None)
    dropped = "".join(f", {n} dropped: {reason.replace('_', ' ')}" for reason, n in report.dropped_rows.items())
    print(f"{name}: {report.summary}{dropped}")


if __name__ == "__main__":
    sys.exit(run_stage(screen, sys.argv, "PLANT"))
