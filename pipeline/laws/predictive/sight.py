"""Whether the predictive law's horizon reaches as far as its model answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.predictive.settling import AFTER, LEAST_ANSWER, SHARE, settling_times, step_responses
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Array

BEGUN = 0.01  # share of the change within AFTER samples, from which an answer has begun


@dataclass(frozen=True, slots=True)
class Sight:
    """Samples after a step of an MV: the first answer of the CV that answers last, and the settling of the answers."""

    first: int  # AFTER + 1 where none is there by then
    settles: int

    @classmethod
    @torch.no_grad()
    def of(cls, model: Identified, mv_of: Callable[[Tensor], Tensor], n_cv: int) -> Sight:
        """From the model's step responses; ``mv_of`` as in ``horizon_for``."""
        responses = step_responses(model, mv_of)
        settling = settling_times(responses)
        settles = int(np.ceil(np.quantile(settling, SHARE))) if settling.size else 0
        # At the inner levels each step is made up and down; their difference knows nothing of what came before.
        paired = responses.reshape(model.n_mv, -1, *responses.shape[1:])[:, 1:-1]
        apart = (paired[:, ::2] - paired[:, 1::2]).reshape(-1, *responses.shape[1:])
        return cls(max(_first(y) for y in np.moveaxis(apart, -1, 0)[:n_cv]), settles)

    def require(self, horizon: int) -> None:
        """LawError where the horizon ends before the first answer: the law would see no effect of its moves."""
        if self.first > horizon:
            after = f"only {self.first}" if self.first <= AFTER else f"more than {AFTER}"
            raise LawError(
                f"law 'predictive' looks {horizon} samples ahead, and a controlled variable answers {after} samples "
                "after the MVs move: choose a longer sampling period, or a longer `horizon`"
            )

    def notes(self, horizon: int) -> tuple[str, ...]:
        """The words of a report on a horizon that ends before half of the answers' settling after the dead time."""
        wanted = (self.first + self.settles) / 2
        if horizon >= wanted:
            return ()
        return (
            f"The law looks {horizon} samples ahead. By the model the controlled variables answer after {self.first} "
            f"and take {self.settles} samples or more to settle over the MVs' whole range: the plan ends before they "
            "have come half of that time. With a longer horizon or a longer sampling period it sees more.",
        )


def _first(y: Array) -> int:
    """The first sample in which an output answers to any step, of responses (runs, n)."""
    moved = np.abs(y - y[:, :1])
    change = moved.max(axis=1, keepdims=True)
    clear = (moved > BEGUN * change) & (change >= LEAST_ANSWER * change.max()) & (change > 0)
    return int(np.argmax(clear.any(axis=0))) if clear.any() else AFTER + 1
