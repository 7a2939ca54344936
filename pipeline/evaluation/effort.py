"""How hard the bounds of a case are searched for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Effort:
    """How far and how finely the bounds' plans look: what the sampling period asks for.

    The defaults are for a plant that changes much within one period. Where many periods pass until a
    move shows, it takes more of them and coarser ones, longer reaches, and the patience to follow a
    plan for a while.
    """

    periods: int = 40  # that the NMPC looks ahead
    elements: int = 3  # of collocation a period, of the NMPC ...
    fine: int = 6  # ... and of the offline optimum
    degree: int = 3
    reaches: tuple[int, ...] = (1, 2, 3)  # of the rollouts that a fresh search starts from
    tail: int = 20  # periods of an offline plan beyond its set point's last sample
    every: int = 1  # samples for which the NMPC follows a plan whose predictions come true
    noisy: bool = True  # whether the NMPC also steps on noisy states; without a filter it hunts them
