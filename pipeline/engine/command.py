"""A stage's command line: one line for an error, no traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from numpy.linalg import LinAlgError

from loopwright.serving.arguments import write_any_text
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.words import plain

FAILURES = (LoopwrightError, OSError, LinAlgError)
"""Errors that bad input can raise: one line on standard error, exit status 2."""


def reason(error: Exception) -> str:
    """The line for one of FAILURES."""
    text = plain(" ".join(str(error).split()))
    if isinstance(error, LinAlgError):
        return (
            f"a system of linear equations has no single solution ({text}); check the plant's "
            "equations at the operating point, and that the data excite every input"
        )
    return text


def run_stage(stage: Callable[..., None], argv: Sequence[str], what: str = "") -> int:
    """Run ``python -m loopwright.pipeline.stages.X [NAME]``; the exit status: 2 and one line where it could not.

    ``what`` says what NAME names; a stage over all cases takes none.
    """
    write_any_text()
    program, names = stage.__name__, list(argv[1:])
    if len(names) != bool(what) or any(name.startswith("-") for name in names):
        print(f"usage: python -m loopwright.pipeline.stages.{program} {what}".rstrip(), file=sys.stderr)
        return 2
    try:
        stage(*names)
    except FAILURES as error:
        print(f"{' '.join([program, *names])}: {reason(error)}", file=sys.stderr)
        return 2
    return 0
