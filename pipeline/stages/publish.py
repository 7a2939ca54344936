"""Stage publish: ``python -m loopwright.pipeline.stages.publish`` writes the store and published.json."""

from __future__ import annotations

import sys
from pathlib import Path

from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.files import write_json
from loopwright.pipeline.tracking.runs import publish as write_store

RECEIPT = Path("published.json")


def publish() -> None:
    """Publish what dvc.lock records; the receipt is the stage's output."""
    write_json(RECEIPT, write_store(Path.cwd()))


if __name__ == "__main__":
    sys.exit(run_stage(publish, sys.argv))
