"""Stage overview: one page over all cases of params.yaml, from what their reports left for programs."""

from __future__ import annotations

import sys

from pipeline.config.params import sections
from pipeline.errors import PipelineError
from pipeline.evaluation.standing import Standing
from pipeline.report.overview import write_overview
from pipeline.stages.paths import ARTIFACTS


def overview() -> None:
    """Write artifacts/report.html and artifacts/report.md."""
    standings = [Standing.read(ARTIFACTS / case) for case in sections("cases")]
    for path in write_overview(standings, ARTIFACTS):
        print(path)


def main() -> int:
    """The exit status: 2 and one line where it could not."""
    try:
        overview()
    except (PipelineError, OSError) as error:
        print(f"overview: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
