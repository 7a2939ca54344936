"""How long an identified model takes to settle, and whether a horizon reaches as far as it answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.dynamics.step_response import (
    BEGUN,
    SETTLED_IN_HORIZON,
    SLOPE_KEPT,
    first_beyond,
    settling_index,
    slope_thirds,
)
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Array

# ------------------------------------------------------------------------------------------------------------ settling
MV_LEVELS = (-0.8, -0.4, 0.0, 0.4, 0.8)  # of an MV in its range -1..1, the others in the middle of theirs
LEVEL_STEP = 0.3  # of an MV, up and down
LEVEL_SAMPLES, STEP_SAMPLES = 200, 150  # samples at each level, and after the step
LEAST_OUTPUT_ANSWER = 0.02  # share of the largest answer of an output; smaller ones have no settling time
TINY_SLOPE = 1e-12  # smallest slope that is divided by
COVERED_STEPS = 0.9  # of the steps that the horizon is long enough for
SHORTEST_CHOSEN, LONGEST_CHOSEN = 12, 50  # [samples] of a horizon that is chosen here
# scaled; a state this large that grows on fourfold in half of LEVEL_SAMPLES comes from an unstable model
UNSTABLE_STATE = 100.0


def mvs_of(model: Identified, middle: Tensor, half: Tensor) -> Callable[[Tensor], Tensor]:
    """The scaled MVs (..., n_mv) of the model for MVs within -1..1, of ranges middle +- half [mv]."""
    center, scale = model.v_center[: model.n_mv], model.v_scale[: model.n_mv]
    return lambda z: (middle + half * z - center) / scale


@torch.no_grad()
def horizon_for(model: Identified, mv_of: Callable[[Tensor], Tensor]) -> int:
    """Samples in which 90 % of the model's step responses over its range settle to 10 %, within 12 to 50.

    ``mv_of`` gives the scaled MVs (..., n_mv) of the model for MVs within -1..1. LawError for an unstable model.
    """
    settling = settling_times(step_responses(model, mv_of))
    wanted = np.quantile(settling, COVERED_STEPS) if settling.size else SHORTEST_CHOSEN
    return int(np.clip(np.ceil(wanted), SHORTEST_CHOSEN, LONGEST_CHOSEN))


@torch.no_grad()
def step_responses(model: Identified, mv_of: Callable[[Tensor], Tensor]) -> Array:
    """Scaled outputs (runs, STEP_SAMPLES + 1, n_y) from a step's sample on, of every MV at every level, both ways."""
    refuse_unstable(model)
    steps = [
        (i, at, by)
        for i in range(model.n_mv)
        for at in MV_LEVELS
        for by in (LEVEL_STEP, -LEVEL_STEP)
        if abs(at + by) <= 1
    ]
    z = torch.zeros(len(steps), model.n_mv, dtype=torch.float64)
    moved = z.clone()
    for run, (i, at, by) in enumerate(steps):
        z[run, i], moved[run, i] = at, at + by
    x = torch.zeros(len(steps), model.n_x, dtype=torch.float64)
    halfway = x
    for k in range(LEVEL_SAMPLES):
        x, halfway = advanced(model, x, mv_of(z)), x if k == LEVEL_SAMPLES // 2 else halfway
    end, before = (float(t.abs().max()) for t in (x, halfway))
    if not end < max(UNSTABLE_STATE, 4 * before):
        raise LawError(
            f"law 'predictive': the identified model is unstable, its states grow from {before:.3g} to {end:.3g} under "
            "constant MVs (they must settle, or grow evenly as a level does); identify it again with longer free runs"
        )
    y = [x[:, : model.n_y]]
    for _ in range(STEP_SAMPLES):
        x = advanced(model, x, mv_of(moved))
        y.append(x[:, : model.n_y])
    return torch.stack(y, dim=1).numpy()


def settling_times(responses: Array) -> Array:
    """Samples (answers,) until each answer stays within 10 % of its end, of responses (runs, n, n_y).

    An output that a step hardly moves has no answer. One that goes on and on, as a level, settles twice as late as it
    first moves as fast as later on: so long it takes to set it moving, and to stop it.
    """
    y = np.moveaxis(responses, 1, -1)  # (runs, n_y, n)
    change, slope = y[..., -1] - y[..., 0], np.abs(np.diff(y))
    begun, middle, end = slope_thirds(slope)
    goes_on = np.median(end / np.maximum(middle, TINY_SLOPE), axis=0) > SLOPE_KEPT  # (n_y,)
    moving = 2 * (slope >= (1 - SETTLED_IN_HORIZON) * begun[..., None]).argmax(axis=-1) + 2
    found = np.where(goes_on, moving, settling_index(y, SETTLED_IN_HORIZON * np.abs(change)))
    return np.asarray(found[np.abs(change) > LEAST_OUTPUT_ANSWER * np.abs(change).max(axis=0)], dtype=np.float64)


def advanced(model: Identified, x: Tensor, mv: Tensor) -> Tensor:
    """The next states (runs, n_x) under scaled MVs (runs, n_mv), measured disturbances at their centre."""
    v = torch.cat([mv, torch.zeros(len(mv), model.n_dv, dtype=torch.float64)], dim=-1)
    y: Tensor = model(torch.cat([x, v * model.v_scale + model.v_center], dim=-1))
    return y


def refuse_unstable(model: Identified) -> None:
    """LawError for a linear model with a pole outside the unit circle; a level's pole at 1 is allowed."""
    pole = float(torch.linalg.eigvals(model.a).abs().max())
    if model.n_hidden == 0 and pole > 1 + 1e-6:
        raise LawError(
            f"law 'predictive': the identified model is unstable, its largest pole is {pole:.6g} (at most 1 is "
            "allowed): a free run over the horizon says nothing; identify it again with a stable linear part"
        )


# ------------------------------------------------------------------------------------------------ reach of the horizon


@dataclass(frozen=True, slots=True)
class AnswerTimes:
    """Samples after a step of an MV: the first answer of the CV that answers last, and the settling of the answers."""

    first: int  # STEP_SAMPLES + 1 where none is there by then
    settles: int

    @classmethod
    @torch.no_grad()
    def of(cls, model: Identified, mv_of: Callable[[Tensor], Tensor], n_cv: int) -> AnswerTimes:
        """From the model's step responses; ``mv_of`` as in ``horizon_for``."""
        responses = step_responses(model, mv_of)
        settling = settling_times(responses)
        settles = int(np.ceil(np.quantile(settling, COVERED_STEPS))) if settling.size else 0
        # At the inner levels each step is made up and down; their difference knows nothing of what came before.
        paired = responses.reshape(model.n_mv, -1, *responses.shape[1:])[:, 1:-1]
        apart = (paired[:, ::2] - paired[:, 1::2]).reshape(-1, *responses.shape[1:])
        return cls(max(_first(y) for y in np.moveaxis(apart, -1, 0)[:n_cv]), settles)

    def require(self, horizon: int) -> None:
        """LawError where the horizon ends before the first answer: the law would see no effect of its moves."""
        if self.first > horizon:
            after = f"only {self.first}" if self.first <= STEP_SAMPLES else f"more than {STEP_SAMPLES}"
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
    change = moved.max(axis=1)
    clear = (change >= LEAST_OUTPUT_ANSWER * change.max()) & (change > 0)
    return int(first_beyond(moved[clear], BEGUN * change[clear]).min()) if clear.any() else STEP_SAMPLES + 1
