"""Closed loops from anywhere until they hold their set points, many side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.tuning.development import BatchLoops, LawStep

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

    def batches(self, size: int) -> list[Starts]:
        """The same starts, so many at a time."""
        places = [slice(i, i + size) for i in range(0, len(self.x), size)]
        return [Starts(self.x[at], self.sp[at], self.mv[at]) for at in places]


@dataclass(frozen=True, slots=True, eq=False)
class Recovery:
    """How loops ended."""

    arrived: NDArray[np.bool_]  # (n,) within the band for the whole of the holding time
    samples: Array  # (n,) from the start until the band was entered for good; all of them where not arrived
    end: Array  # (n, n_x) last state seen
    courses: Array  # (watched, samples / every, n_x) of the first loops; NaN after they arrived

    @classmethod
    def together(cls, batches: Sequence[Recovery]) -> Self:
        """The loops of several batches as one."""
        return cls(*(np.concatenate([getattr(batch, f.name) for batch in batches]) for f in fields(cls)))


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
    A loop that has not arrived after ``samples`` counts as lost. The first ``watched`` loops keep their
    courses, one state in ``every``. A state that is not finite never arrives.
    """
    n, n_x = starts.x.shape
    arrived, taken, end = np.zeros(n, dtype=bool), np.full(n, float(samples)), starts.x.copy()
    courses = np.full((watched, -(-samples // every), n_x), np.nan)
    at, sp, inside = np.arange(n), torch.from_numpy(starts.sp), np.zeros(n)  # of the loops that still run
    loops = BatchLoops(plant, law, n_state, (n,), starts.x.copy(), starts.mv)
    for k in range(samples):
        if k % every == 0:
            courses[at[at < watched], k // every] = loops.x[at < watched]
        pv = loops.measured()
        inside = np.where(np.abs(pv[:, 0] - sp[:, 0].numpy()) <= band, inside + 1, 0)
        done = inside >= holding
        if k % CHECK == 0 and done.any():
            arrived[at[done]], taken[at[done]] = True, k + 1 - inside[done]
            end[at[done]] = loops.x[done]
            stay = ~done & np.isfinite(loops.x).all(axis=1)
            at, sp, inside, pv = at[stay], sp[stay], inside[stay], pv[stay]
            loops.keep(stay)
            if not len(at):
                break
        loops.step(sp, pv)
    end[at] = loops.x
    return Recovery(arrived, taken, end, courses)


def other_rests(plant: EquationPlant, samples: int = 1_500, moving: float = 1e-9) -> Array:
    """States (n, n_x) at which the plant rests, the MV at one of its ends, outside the range of its set point.

    They are looked for from the corners of the states' ranges: a reactor that has gone out, or run away. Empty
    where the plant has none.
    """
    low, high = (np.array([getattr(s, end) for s in plant.state_signals]) for end in ("low", "high"))
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(len(low), -1).T
    sp, mv = plant.sp_signals[0], plant.mv_signals[0]
    rests: list[Array] = []
    advance = plant.many(len(corners))
    for end in (mv.low, mv.high):
        x, before = corners, corners
        for _ in range(samples):
            before, x = x, advance(x, np.full((len(x), 1), end))
        cv = plant.measured(x)[:, 0]
        still = np.isfinite(x).all(axis=1) & (np.abs(x - before).max(axis=1) <= moving * np.abs(x).max(axis=1))
        for state in x[still & ~((cv >= sp.low) & (cv <= sp.high))]:
            if all(np.abs(state - known).max() > 1e-6 * np.abs(state).max() for known in rests):
                rests.append(state)
    return np.array(rests).reshape(-1, len(low))
