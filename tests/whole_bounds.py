"""The bounds of a case that lacks none."""

from pathlib import Path

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.optimal.bounds import Bounds, stored_bounds


def whole_bounds(case: Case, path: Path | None = None) -> Bounds:
    bounds, missing = stored_bounds(case, path)
    assert missing == []
    return bounds
