"""Excitation of a batch: many short runs from the plant's start, under levels of every kind."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.excitation.base import OpenLoop, within
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import simulate_batch


@dataclass(frozen=True, kw_only=True)
class Batches(OpenLoop):
    """Start-ups: every run starts afresh, and its MVs lead through a different part of the batch.

    One long run of a batch reactor shows its start once and then the reactor with nothing left in
    it. Here a batch holds its first level for a random time, up to the whole batch, and then draws
    a new one every ``hold`` samples: full heating of any length followed by anything occurs, which
    is what a controller does. Some batches keep one level, some know only the ends of the range.

    Attributes
    ----------
    samples [-]
        Samples of a batch; the record has ``batches`` times as many.
    batches [-]
        Number of batches, each a run of the record.
    hold [-]
        Samples for which a level after the first is held.
    constant, binary [-]
        Fractions of the batches that keep one level, and that go from one end of the MV's range to
        the other only; together at most 1.
    end_fraction [-]
        Fraction of the other batches' levels that are an end of the range, 0 to 1; the rest are uniform over it.
    start_spread [unit of the state]
        Standard deviation of each state at the start of a batch, within the state's range; empty: all start alike.
    """

    kind: ClassVar[str] = "batches"
    batches: int = field(metadata={"range": (1, np.inf)})
    hold: int = within(3, 1)
    constant: float = within(0.0, 0, 1)
    binary: float = within(0.0, 0, 1)
    end_fraction: float = within(0.0, 0, 1)
    start_spread: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("binary", 0, 1 - self.constant)

    def run(self, plant: Simulator, seed: int) -> Record:
        """The record of all batches; levels, starts and noise come from ``seed``.

        Raises ParamsError for a spread that does not fit the plant's states.
        """
        rng = np.random.default_rng(seed)
        mv = self.levels(plant, self.unit_sequence(len(plant.mv_signals), rng))
        moves = mv.reshape(self.batches, self.samples, -1)
        x = simulate_batch(plant, self.initial_states(plant, rng), moves)[:, :-1]
        return self.measured(
            plant, x.reshape(len(mv), -1), mv, rng, run=np.repeat(np.arange(self.batches), self.samples)
        )

    def unit_sequence(self, n_mv: int, rng: np.random.Generator) -> Array:
        """The MVs of all batches on [0, 1], one batch after the other, shape (batches * samples, n_mv)."""
        b, n = self.batches, self.samples
        draw = rng.random(b)
        constant, binary = draw < self.constant, draw >= 1 - self.binary
        share = np.where(binary, 1.0, self.end_fraction)[:, None, None]
        levels = rng.random((b, n, n_mv))
        ends = rng.integers(0, 2, (b, n, n_mv)).astype(np.float64)
        levels = np.where(rng.random((b, n, n_mv)) < share, ends, levels)
        first = np.where(constant, n, rng.integers(1, n + 1, b))
        after = np.arange(n) - first[:, None]  # samples since the first level ended
        number = np.where(after < 0, 0, 1 + after // self.hold)
        return np.take_along_axis(levels, number[:, :, None], axis=1).reshape(b * n, n_mv)

    def initial_states(self, plant: Simulator, rng: np.random.Generator) -> Array:
        """State at the start of each batch, shape (batches, n_x)."""
        states = plant.state_signals if isinstance(plant, EquationPlant) else ()
        spread = np.array(self.start_spread or np.zeros(plant.n_x))
        if spread.shape != (plant.n_x,) or not np.all(np.isfinite(spread) & (spread >= 0)):
            names = ", ".join(s.name for s in states) or str(plant.n_x)
            raise ParamsError(
                f"excitation {self.kind!r}: start_spread is {list(self.start_spread)}; "
                f"give one standard deviation >= 0 for each state of {plant.name!r}: {names}"
            )
        x0 = self.initial_state(plant) + spread * rng.standard_normal((self.batches, plant.n_x))
        return np.clip(x0, [s.low for s in states], [s.high for s in states]) if states else x0
