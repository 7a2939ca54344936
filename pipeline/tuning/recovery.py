"""Does a loop come to its set point from anywhere? Thousands of starts at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.errors import PlantError
from pipeline.plants.equations import EquationPlant
from pipeline.plants.simulator import Simulator
from pipeline.tuning.development import LawStep

Array = NDArray[np.float64]

CHECK = 25  # samples between two looks at who has arrived


@dataclass(frozen=True, slots=True, eq=False)
class Starts:
    """Where loops begin: states, set points and MVs, a row each."""

    x: Array  # (n, n_x)
    sp: Array  # (n, n_sp)
    mv: Array  # (n, n_mv) applied before the first sample

    def __post_init__(self) -> None:
        if not len(self.x) == len(self.sp) == len(self.mv) or not len(self.x):
            raise PlantError(
                f"starts have {len(self.x)} states, {len(self.sp)} set points and {len(self.mv)} MVs; one of each"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Recovery:
    """How loops ended."""

    arrived: NDArray[np.bool_]  # (n,) within the band for the whole of the holding time
    samples: Array  # (n,) from the start until the band was entered for good; all of them where not arrived
    end: Array  # (n, n_x) last state seen
    courses: Array  # (watched, samples / every, n_x) of the first loops; NaN after they arrived


def recover(
    plant: Simulator,
    law: LawStep,
    n_state: int,
    starts: Starts,
    *,
    samples: int,
    band: float,
    holding: int,
    watched: int = 0,
    every: int = 5,
) -> Recovery:
    """Run a law from many starts, all in one batch, without noise, until they hold their set points.

    A loop has arrived when its controlled variable stays within ``band`` [CV] of the set point for
    ``holding`` samples, and is then no longer simulated: a linear loop's stability says the rest.
    What has not arrived after ``samples`` has not arrived. The first ``watched`` loops keep their
    courses, one state in ``every``. A state that is not finite never arrives.
    """
    n, n_x = starts.x.shape
    arrived, taken, end = np.zeros(n, dtype=bool), np.full(n, float(samples)), starts.x.copy()
    courses = np.full((watched, -(-samples // every), n_x), np.nan)
    at = np.arange(n)  # the loops that still run
    x, sp, state = starts.x.copy(), torch.from_numpy(starts.sp), torch.zeros(n, n_state, dtype=torch.float64)
    mv, inside = torch.from_numpy(starts.mv), np.zeros(n)
    advance, dv = plant.many(n), torch.from_numpy(np.tile(plant.dv_nominal, (n, 1)))
    with torch.inference_mode():
        for k in range(samples):
            if k % every == 0:
                courses[at[at < watched], k // every] = x[at < watched]
            pv = plant.measured(x)
            inside = np.where(np.abs(pv[:, 0] - sp[:, 0].numpy()) <= band, inside + 1, 0)
            if k % CHECK == 0:
                done = inside >= holding
                arrived[at[done]], taken[at[done]] = True, k + 1 - inside[done]
                end[at[done]] = x[done]
                if done.any():
                    stay = ~done & np.isfinite(x).all(axis=1)
                    at, x, inside, pv = at[stay], x[stay], inside[stay], pv[stay]
                    sp, state, mv, dv = sp[stay], state[stay], mv[stay], dv[stay]
                    if not len(at):
                        break
                    advance = plant.many(len(at))
            mv, state, _ = law(sp, torch.from_numpy(pv), dv, mv, state)
            x = advance(x, mv.numpy())
    end[at] = x
    return Recovery(arrived, taken, end, courses)


def other_rests(plant: EquationPlant, samples: int = 1_500, moving: float = 1e-9) -> Array:
    """States (n, n_x) at which the plant rests, the MV at one of its ends, outside the range of its set point.

    Found from the corners of the states' ranges: a reactor that has gone out, or run away. Empty
    where the plant has none.
    """
    low, high = (np.array([getattr(s, end) for s in plant.state_signals]) for end in ("low", "high"))
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(len(low), -1).T
    sp, mv = plant.sp_signals[0], plant.mv_signals[0]
    found: list[Array] = []
    advance = plant.many(len(corners))
    for end in (mv.low, mv.high):
        x, before = corners, corners
        for _ in range(samples):
            before, x = x, advance(x, np.full((len(x), 1), end))
        cv = plant.measured(x)[:, 0]
        still = np.isfinite(x).all(axis=1) & (np.abs(x - before).max(axis=1) <= moving * np.abs(x).max(axis=1))
        for state in x[still & ~((cv >= sp.low) & (cv <= sp.high))]:
            if all(np.abs(state - known).max() > 1e-6 * np.abs(state).max() for known in found):
                found.append(state)
    return np.array(found).reshape(-1, len(low))
