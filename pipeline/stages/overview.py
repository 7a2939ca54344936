"""Stage overview: one page over all cases of params.yaml, from what their reports left for programs."""

from __future__ import annotations

import sys

from pipeline.config.params import sections
from pipeline.engine.command import run_stage
from pipeline.evaluation.standing import Standing
from pipeline.report.overview import write_overview
from pipeline.stages.paths import ARTIFACTS


def overview() -> None:
    """Write artifacts/report.html and artifacts/report.md."""
    standings = [Standing.read(ARTIFACTS / case) for case in sections("cases")]
    for path in write_overview(standings, ARTIFACTS):
        print(path)


if __name__ == "__main__":
    sys.exit(run_stage(overview, sys.argv))
