"""Lags and size of an NNARX: the smallest candidate whose free run is nearly the best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pipeline.errors import ModelError

SLACK = 0.05
"""Relative free-run error above the best one that a smaller model may have."""


@dataclass(frozen=True, slots=True)
class Size:
    """What a candidate changes of a part: lags and hidden widths; None leaves the part's own."""

    n_y: int | None = None
    n_u: int | None = None
    hidden: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class Candidate:
    """One row of the search: the model's size and its validation errors [unit of the PV].

    ``rmse`` is of one step, ``free_run_rmse`` of all steps of free runs over validation data.
    """

    n_y: int
    n_u: int
    hidden: tuple[int, ...]
    parameters: int
    rmse: float
    free_run_rmse: float

    def row(self, chosen: bool) -> dict[str, Any]:
        """JSON-ready values for the metrics."""
        return {**asdict(self), "hidden": list(self.hidden), "chosen": chosen}


def parsimonious(candidates: Sequence[Candidate], slack: float = SLACK) -> int:
    """Index of the one with the fewest parameters among those within ``slack`` of the best free run.

    Differences of a few per cent between free-run errors lie within what another draw of the
    initial weights changes, and each parameter less is one less to mislead the model's slopes,
    by which controllers are tuned. Of equal sizes the better free run wins.
    Raises ModelError without a candidate.
    """
    if not candidates:
        raise ModelError("a search over no candidates: list at least one size, or leave `search` out")
    limit = (1 + slack) * min(c.free_run_rmse for c in candidates)
    near = [i for i, c in enumerate(candidates) if c.free_run_rmse <= limit]
    return min(near, key=lambda i: (candidates[i].parameters, candidates[i].free_run_rmse))
