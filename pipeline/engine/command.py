"""What every command of the pipeline does around its work: one line for an error, no traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import numpy as np

from serving.errors import LoopwrightError


def run_stage(stage: Callable[[str], None], argv: Sequence[str], what: str) -> int:
    """Run ``python -m pipeline.stages.X NAME``; the exit status: 2 and one line where it could not."""
    program = stage.__name__
    if len(argv) != 2 or argv[1].startswith("-"):
        print(f"usage: python -m pipeline.stages.{program} {what}", file=sys.stderr)
        return 2
    try:
        stage(argv[1])
    except (LoopwrightError, OSError) as error:
        print(f"{program} {argv[1]}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except np.linalg.LinAlgError as error:
        print(
            f"{program} {argv[1]}: a system of linear equations has no single solution ({error}); check the plant's "
            "equations at the operating point, and that the data excite every input",
            file=sys.stderr,
        )
        return 2
    return 0
