"""Stage overview: one page over all cases of params.yaml, from what their reports left for programs."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

from loopwright.pipeline.config.params import sections
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.evaluation.leaderboard import CaseStanding
from loopwright.pipeline.evaluation.validation import FILE
from loopwright.pipeline.report.overview import PAGES, write_overview
from loopwright.pipeline.stages.paths import ARTIFACTS


def overview() -> None:
    """Write artifacts/report.html and artifacts/report.md. PipelineError where a case has no report."""
    for path in _written(sections("cases")):
        print(path)


def brought_up() -> bool:
    """Write both pages over the cases that have a report, as after a run of one case; whether they have changed."""
    pages = [ARTIFACTS / name for name in PAGES]
    before = [page.read_bytes() if page.exists() else b"" for page in pages]
    _written(case for case in sections("cases") if (ARTIFACTS / case / FILE).exists())
    return before != [page.read_bytes() for page in pages]


def _written(cases: Iterable[str]) -> list[Path]:
    return write_overview([CaseStanding.read(ARTIFACTS / case) for case in cases], ARTIFACTS)


if __name__ == "__main__":
    sys.exit(run_stage(overview, sys.argv))
