"""Open-loop excitations: random steps, PRBS, multisine; of a batch, many short runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.excitation.base import OpenLoop, within
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import simulate_batch

TAPS: dict[int, tuple[int, ...]] = {
    2: (2, 1),
    3: (3, 2),
    4: (4, 3),
    5: (5, 3),
    6: (6, 5),
    7: (7, 6),
    8: (8, 6, 5, 4),
    9: (9, 5),
    10: (10, 7),
    11: (11, 9),
    12: (12, 6, 4, 1),
    13: (13, 4, 3, 1),
    14: (14, 5, 3, 1),
    15: (15, 14),
    16: (16, 15, 13, 4),
    17: (17, 14),
    18: (18, 11),
}
"""Exponents of a primitive polynomial of each order: the register then runs through all its states."""


def maximal_length(order: int) -> NDArray[np.int8]:
    """One period of a shift register's output, shape (2**order - 1,), of 0 and 1.

    s(k) = s(k - t1) xor s(k - t2) ..., with the taps t of a primitive polynomial over GF(2).
    """
    bits = np.ones(2**order - 1, dtype=np.int8)  # any state but all zeros starts it
    for k in range(order, len(bits)):
        bits[k] = np.bitwise_xor.reduce(bits[[k - t for t in TAPS[order]]])
    return bits


@dataclass(frozen=True, kw_only=True)
class RandomSteps(OpenLoop):
    """Levels drawn uniformly over the MV's range, each held ``hold`` samples.

    Source: [inverse_rbf, section 4.2] (0..500 K, held one period, 60,000 samples).
    """

    kind: ClassVar[str] = "random_steps"
    hold: int = within(1, 1)

    def unit_sequence(self, n_mv: int, rng: np.random.Generator) -> Array:
        """Levels on [0, 1], shape (samples, n_mv)."""
        return np.repeat(rng.random((-(-self.samples // self.hold), n_mv)), self.hold, axis=0)[: self.samples]


@dataclass(frozen=True, kw_only=True)
class Prbs(OpenLoop):
    """Pseudo-random binary sequence of maximal length: the low and the high level, white up to its clock.

    Several MVs get the same sequence, shifted by equal parts of its period, so that they are
    nearly uncorrelated. The seed draws the start within the period.

    A clock of the shift register lasts ``hold`` samples. The register has ``order`` bits, 2 to 18: the sequence
    repeats after (2**order - 1) hold samples.
    """

    kind: ClassVar[str] = "prbs"
    hold: int = within(1, 1)
    order: int = within(11, min(TAPS), max(TAPS))

    def unit_sequence(self, n_mv: int, rng: np.random.Generator) -> Array:
        """Zeros and ones, shape (samples, n_mv)."""
        return self.bits(n_mv, rng).astype(np.float64)

    def bits(self, n_mv: int, rng: np.random.Generator) -> NDArray[np.int8]:
        """The register's output, each bit held, shape (samples, n_mv)."""
        period = maximal_length(self.order)
        clock = np.arange(-(-self.samples // self.hold))[:, None] + int(rng.integers(len(period)))
        shift = np.arange(n_mv) * (len(period) // n_mv)
        return np.repeat(period[(clock + shift) % len(period)], self.hold, axis=0)[: self.samples]


@dataclass(frozen=True, kw_only=True)
class Aprbs(Prbs):
    """PRBS whose level is drawn anew, uniformly over the MV's range, whenever its bit flips.

    It holds levels for 1 to ``order`` clocks: fast and slow motion, over the whole range, which a
    nonlinear plant needs. Fields as in ``Prbs``.
    """

    kind: ClassVar[str] = "aprbs"

    def unit_sequence(self, n_mv: int, rng: np.random.Generator) -> Array:
        """Levels on [0, 1], shape (samples, n_mv)."""
        bits = self.bits(n_mv, rng)
        flips = np.cumsum(np.diff(bits, axis=0, prepend=bits[:1]) != 0, axis=0)
        levels = rng.random((int(flips.max()) + 1, n_mv))
        return np.asarray(np.take_along_axis(levels, flips, axis=0))


@dataclass(frozen=True, kw_only=True)
class Multisine(OpenLoop):
    """Periodic sum of equal cosines with Schroeder's phases, which keep its peaks low.

        u(k) = sum_i cos(2 pi i k / cycle - pi i (i - 1) / lines),   i = 1 .. lines

    scaled so that it just fills the MV's range. It repeats after ``cycle`` samples. Each MV has ``lines`` cosines of
    its own, interleaved with those of the others, so that their effects can be told apart; the highest frequency
    is lines n_mv / (cycle period_s) [Hz]. The seed draws the start within the cycle.

    Source: Schroeder, Synthesis of low-peak-factor signals and binary sequences with low
    autocorrelation, IEEE Transactions on Information Theory 16, 1970.
    """

    kind: ClassVar[str] = "multisine"
    cycle: int = within(2_000, 4)
    lines: int = within(200, 1)

    def unit_sequence(self, n_mv: int, rng: np.random.Generator) -> Array:
        """Values on [0, 1], shape (samples, n_mv)."""
        if not 2 * self.lines * n_mv < self.cycle:
            raise ParamsError(
                f"excitation {self.kind!r}: {self.lines} lines for each of {n_mv} MVs do not fit below half of the "
                f"sampling frequency with a cycle of {self.cycle} samples; lengthen it or take fewer lines"
            )
        i = np.arange(1, self.lines + 1)
        spectrum = np.zeros((self.cycle // 2 + 1, n_mv), dtype=np.complex128)
        for m in range(n_mv):
            spectrum[(i - 1) * n_mv + m + 1, m] = np.exp(-1j * np.pi * i * (i - 1) / self.lines)
        wave = np.fft.irfft(spectrum, n=self.cycle, axis=0)
        wave = (wave - wave.min(axis=0)) / np.ptp(wave, axis=0)
        return wave[(np.arange(self.samples) + int(rng.integers(self.cycle))) % self.cycle]


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
