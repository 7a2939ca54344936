"""Stage publish: ``python -m pipeline.stages.publish`` writes the store and published.json."""

from __future__ import annotations

import sys
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.files import write_json
from pipeline.tracking.publish import publish

RECEIPT = Path("published.json")


def main() -> int:
    """Publish what dvc.lock records; the receipt is the stage's output."""
    try:
        receipt = publish(Path.cwd())
    except PipelineError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    write_json(RECEIPT, receipt)
    return 0


if __name__ == "__main__":
    sys.exit(main())
