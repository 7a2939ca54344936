"""Closed loops for tuning: random set points of development seeds, many candidates of a law at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.errors import PlantError
from pipeline.plants.equations import EquationPlant
from pipeline.plants.simulator import Simulator

Array = NDArray[np.float64]

LawStep = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""A control law or its ``forward``: (sp, pv, dv, mv_applied, state) -> (mv, state_next, info)."""

# Share of the reachable range of the controlled variable that is left out at either end.
MARGIN = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class DevelopmentLoops:
    """Set-point sequences over a nominal plant, each from the steady state at its first set point.

    They serve the choice of numbers and are never scored: the scored tests are those of the case.
    """

    plant: Simulator
    hold: int  # samples of each set point
    sp: Array  # (n, s) set point of every sequence at every sample
    x0: Array  # (s, n_x)
    mv0: Array  # (s, n_mv)

    @classmethod
    def draw(cls, plant: Simulator, seeds: tuple[int, ...], set_points: int, hold: int) -> Self:
        """One sequence a seed: ``set_points`` uniform over what the plant can hold, ``hold`` samples each.

        A plant without equations starts every sequence where it starts, and its set points are uniform over
        their signal's range. Raises PlantError where nothing was asked for, or the plant has no steady state
        in its MV's range.
        """
        if not seeds or set_points < 1 or hold < 1:
            raise PlantError(
                f"development loops need seeds, set points and a hold; got {seeds}, {set_points} and {hold}"
            )
        if isinstance(plant, EquationPlant):
            cvs, _, mvs = plant.steady_curve
            mv = plant.mv_signals[0]
            held = cvs[(mvs >= mv.low) & (mvs <= mv.high)]
            if not held.size:
                raise PlantError(f"plant {plant.name!r} has no steady state with {mv.name} in [{mv.low}, {mv.high}]")
        else:
            held = np.array([plant.sp_signals[0].low, plant.sp_signals[0].high])
        inset = MARGIN * (held.max() - held.min())
        low, high = held.min() + inset, held.max() - inset
        levels = np.array([np.random.default_rng(s).uniform(low, high, set_points) for s in seeds])
        if isinstance(plant, EquationPlant):
            starts = [plant.steady_state_at(float(first)) for first in levels[:, 0]]
        else:
            starts = [plant.start] * len(levels)
        return cls(
            plant,
            hold,
            np.repeat(levels, hold, axis=1).T,
            np.array([x for x, _ in starts]),
            np.array([u for _, u in starts]),
        )

    def error(self, step: LawStep, n_state: int, candidates: int = 1, *, time_weighted: bool = False) -> Array:
        """Mean absolute error (candidates,) of each candidate over all sequences.

        ``time_weighted`` multiplies each error by the periods since its set point moved, which makes
        of the mean an ITAE: a slow or swinging end then counts for more than the unavoidable beginning.
        ``step`` takes shapes (candidates, s, .): a law whose numbers have a leading dimension
        of candidates. The error of a sample counts before that sample's move acts. A candidate
        whose loop is not finite has an infinite error.
        """
        n, s = self.sp.shape
        lanes = (candidates, s)
        advance = self.plant.many(candidates * s)
        x = np.tile(self.x0, (candidates, 1))
        mv = torch.from_numpy(np.tile(self.mv0, (candidates, 1, 1)))
        state = torch.zeros(*lanes, n_state, dtype=torch.float64)
        seen_dv = torch.from_numpy(np.tile(self.plant.dv_nominal, (*lanes, 1)))
        error = np.zeros(lanes)
        with torch.no_grad():
            for k in range(n):
                pv = self.plant.measured(x).reshape(*lanes, -1)
                weight = k % self.hold if time_weighted else 1
                error += weight * np.abs(self.sp[k] - pv[..., 0])
                sp = torch.from_numpy(self.sp[k])[:, None].expand(*lanes, 1)
                mv, state, _ = step(sp, torch.from_numpy(pv), seen_dv, mv, state)
                x = advance(x, mv.reshape(candidates * s, -1).numpy())
        total = error.mean(axis=1) / n
        return np.where(np.isfinite(total), total, np.inf)
