"""Closed loops of laws before their export, over a simulated plant. Not a test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.laws import ControlLaw
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory, simulate_closed

DV = torch.zeros(0, dtype=torch.float64)


def stepper(law: ControlLaw, through: Callable[[np.ndarray], np.ndarray] = lambda mv: mv):
    """The law as ``simulate_closed`` steps it; ``through`` stands between its MV and the plant's, both ways."""
    state = torch.zeros(law.n_state, dtype=torch.float64)

    def step(sp, pv, mv_applied):
        nonlocal state
        with torch.no_grad():
            inputs = (torch.from_numpy(np.array(v)) for v in (sp, pv))
            mv, state, info = law(*inputs, DV, torch.from_numpy(through(mv_applied)), state)
        return through(mv.numpy()), info.numpy()

    return step


def closed(
    law: ControlLaw, case: Case, test: Scenario, noise: float = 0.0, seed: int = 0, **through: Any
) -> Trajectory:
    return simulate_closed(case.plant, stepper(law, **through), test, noise=[noise], seed=seed)


def sse(track: Trajectory, start: int = 0) -> float:
    return float(((track.sp - track.pv)[start:] ** 2).sum())
