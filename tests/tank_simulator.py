"""A user's own simulator: two tanks in plain Python, without CasADi. Not a test."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt
from typing import ClassVar

import numpy as np

from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class Tanks(Simulator):
    """A dh1/dt = u - k sqrt(h1), A dh2/dt = k sqrt(h1) - k sqrt(h2); ten Euler steps a period; h2 is measured."""

    area: float = field(default=2.0, metadata={"unit": "m2"})
    k: float = field(default=0.5, metadata={"unit": "m2.5/s"})

    name: ClassVar[str] = "tanks"
    title: ClassVar[str] = "Two tanks in series"
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("h2", "m", 0.0, 10.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("h2", "m", 0.5, 3.0),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("u", "m3/s", 0.0, 1.5),)
    period_s: ClassVar[float] = 1.0

    @property
    def start(self) -> tuple[Array, Array]:
        return np.ones(2), np.array([self.k])  # at rest: k sqrt(1) flows in and out

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        area, k = p
        h1, h2 = x
        for _ in range(10):
            first, second = k * sqrt(max(h1, 0.0)), k * sqrt(max(h2, 0.0))
            h1, h2 = h1 + 0.1 * (mv[0] - first) / area, h2 + 0.1 * (first - second) / area
        return np.array([h1, h2])

    def measure(self, x: Array) -> Array:
        return x[1:]
