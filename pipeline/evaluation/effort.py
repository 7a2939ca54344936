"""Horizon and resolution of the search for the bounds of a case."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Effort:
    """Horizon and resolution of the bounds' plans; they depend on the sampling period.

    The defaults are for a plant that changes much within one period. A plant that needs many periods to
    respond to a move needs more and coarser periods, longer reaches, and a plan that is followed for
    several samples.
    """

    periods: int = 40  # horizon of the NMPC
    elements: int = 3  # of collocation a period, of the NMPC ...
    fine: int = 6  # ... and of the offline optimum
    degree: int = 3
    reaches: tuple[int, ...] = (1, 2, 3)  # of the rollouts that a fresh search starts from
    tail: int = 20  # periods of an offline plan beyond its set point's last sample
    every: int = 1  # samples for which the NMPC follows a plan while its predictions are correct
    noisy: bool = True  # whether the NMPC also runs with noisy states, which it does not filter
