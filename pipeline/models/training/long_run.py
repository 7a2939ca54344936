"""Long free runs of a network over validation data: what its one-step error says little about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.metrics import fit_percent, rmse
from pipeline.models.part import Array

TRAINED = ("one_step_trained", "free_run_trained")
"""Names of the network after the first training and after the second, in metrics and curves."""


@dataclass(frozen=True, slots=True, eq=False)
class LongRun:
    """Free runs of a network beside the measurement: (N, k, n_pv) each, N runs of k periods.

    ``one_step`` holds (measured, predicted) one period ahead, (M, n_pv) each.
    """

    one_step: tuple[Array, Array]
    measured: Array
    predicted: Array

    def figures(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """Of each PV: RMSE one step ahead, RMSE [unit of the PV] and fit [%] of the free runs."""
        return {
            name: {
                "one_step_rmse": rmse(*(side[:, i] for side in self.one_step)),
                "free_run_rmse": rmse(self.measured[..., i], self.predicted[..., i]),
                "free_run_fit": fit_percent(self.measured[..., i].ravel(), self.predicted[..., i].ravel()),
            }
            for i, name in enumerate(names)
        }


def curves(runs: Mapping[str, LongRun], period_s: float) -> dict[str, Array]:
    """The first PV over the first of the runs: ``time_s``, ``measured``, and each network's course by its name."""
    measured = next(iter(runs.values())).measured[0, :, 0]
    time_s: Array = period_s * np.arange(1, len(measured) + 1, dtype=np.float64)
    return {"time_s": time_s, "measured": measured, **{name: run.predicted[0, :, 0] for name, run in runs.items()}}
