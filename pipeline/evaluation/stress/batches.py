"""Many loops of one controller on the engine, in batches of a piece of work."""

from __future__ import annotations

import os

from loopwright.pipeline.engine.cluster import address, workers_here
from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.evaluation.stress.loops import Stress, StressOutcome

STRESS_BATCH = 100  # loops of a piece of work
FEW = 500  # loops that are done before workers have started
PIECES = 4  # a worker at least, so that none waits long for the last


def outcomes_of(
    stress: Stress,
    plants: int,
    batch: int = STRESS_BATCH,
    workers: int | None = None,
    label: str = "stress: batches of loops",
) -> list[StressOutcome]:
    """Outcomes of the loops 0 to ``plants`` - 1, in order, on the engine: its cluster, or ``workers`` of this machine.

    ``label`` (``STAGE: WHAT``) names the progress. Neither ``batch`` nor the number of workers changes a bit of them.
    """
    here = address() is None
    wanted = workers or (1 if not here or plants <= FEW else os.cpu_count() or 1)
    size = max(min(batch, plants // (PIECES * wanted)), 1) if wanted > 1 else batch
    pieces = [range(i, min(i + size, plants)) for i in range(0, plants, size)]
    with workers_here(wanted if here else workers, "--workers"):
        found = parallel_map(stress.outcomes, pieces, label, [len(p) for p in pieces])
    return [one for piece in found for one in piece]
