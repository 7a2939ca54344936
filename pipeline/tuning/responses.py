"""Answers of a plant to a small step of each MV, found by simulation, and the process that resembles it."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Self

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.step_response import (
    EVEN,
    RAMP_SLOPE,
    RESPONSE_ROUNDING,
    SETTLED_BAND,
    STILL_RESPONSE,
    first_answer_within,
    late_distance,
    late_slope,
    ramp_delay,
    settling_index,
    starts_inverse,
    two_point_lag,
)
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.simulator import Array, Simulator

RESPONSE_STEP = 0.01  # of an MV's range
SHORTEST_STEP_RUN, LONGEST_STEP_RUN = 100, 3200  # samples of a response


@dataclass(frozen=True, slots=True)
class FirstOrder:
    """The transfer function rate exp(-theta s) / (s + 1/tau); an integrator with dead time where tau is infinite."""

    rate: float  # [pv/mv/s]
    tau_s: float
    dead_time_s: float


@dataclass(frozen=True, slots=True, eq=False)
class StepResponses:
    """Changes of each controlled variable after a step of each MV, near the start of a plant.

    ``y[i, j, k]`` [pv/mv]: of CV i, k + 1 periods after a unit step of MV j. ``slope[i, j]`` [pv/mv a period]: of
    its last fifth, 0 where it has settled, or creeps on by little beside what it did before. It is 0 of a CV whose
    answer to the MV that moves it most, over the MVs' ranges, comes to rest.
    """

    y: Array  # (n_cv, n_mv, n)
    slope: Array  # (n_cv, n_mv)
    period_s: float
    spans: tuple[Array, Array]  # ranges of the CVs (n_cv,) and the MVs (n_mv,)

    @classmethod
    def near_start(cls, plant: Simulator) -> Self:
        """Central differences of runs with each MV a little above and below, one-sided at the end of a range.

        A model may rest where no MV gets: then the nearest ones are moved.
        They are as long as it takes to settle, or to rise or fall evenly, or as the plant's answers are known: a slow
        pole of a model, which its record leaves open, can turn them round later. LawError where a run is not finite.
        """
        x0, mv0 = plant.start
        low, high = (np.array([getattr(s, end) for s in plant.mv_signals]) for end in ("low", "high"))
        span, n_cv = np.diag(RESPONSE_STEP * (high - low)), len(plant.sp_signals)
        ends = [np.clip(np.clip(mv0, low, high) + sign * span, low, high) for sign in (1, -1)]
        size = np.diag(ends[0] - ends[1])
        mv = np.concatenate(ends)
        x, advance = np.tile(x0, (len(mv), 1)), plant.many(len(mv))
        rows: list[Array] = []
        longest = plant.foreseen or LONGEST_STEP_RUN
        n = min(SHORTEST_STEP_RUN, longest)
        while True:
            while len(rows) < n:
                x = advance(x, mv)
                rows.append(plant.measured(x)[:, :n_cv])
            up, down = np.split(np.array(rows), 2, axis=1)  # (n, n_mv, n_cv)
            y = ((up - down) / size[:, None]).transpose(2, 1, 0)
            if not np.all(np.isfinite(y)):
                raise LawError(f"a step response of plant {plant.name!r} is not finite within {n} periods of its start")
            slope = _slopes(y)
            if n >= longest or _known(y, slope):
                spans = (np.array([s.high - s.low for s in plant.sp_signals]), high - low)
                ramp = (np.abs(slope[-1]) * n >= RAMP_SLOPE * np.abs(y).max(axis=-1)) & ~_settled(y)
                strongest = np.abs(y[..., -1] * spans[1]).argmax(axis=1)
                integrates = np.take_along_axis(ramp, strongest[:, None], axis=1)
                return cls(y, np.where(ramp & integrates, slope[-1], 0.0), plant.period_s, spans)
            n *= 2

    @property
    def integrates(self) -> NDArray[np.bool_]:
        """The CVs (n_cv,) that do not come to rest after a step of an MV."""
        return np.asarray((self.slope != 0).any(axis=1))

    @property
    def gain(self) -> Array:
        """Steady gains (n_cv, n_mv) [pv/mv]; of an integrating CV the slopes [pv/mv a period]."""
        return np.where(self.integrates[:, None], self.slope, self.y[..., -1])

    @property
    def share(self) -> Array:
        """``gain`` in shares of the signals' ranges, (n_cv, n_mv)."""
        cv, mv = self.spans
        return self.gain * mv / cv[:, None]

    @property
    def settling(self) -> int:
        """Samples until the slowest response that comes to rest stays within 5 % of its end; 0 where none does.

        For one that creeps, until it goes on as it does over its last fifth.
        """
        n = self.y.shape[-1]
        creeps = np.where(_settled(self.y), 0.0, _slopes(self.y)[-1])
        rests = (self.y + creeps[..., None] * (n - 1 - np.arange(n)))[self.slope == 0]
        return int(settling_index(rests, SETTLED_BAND * np.abs(rests).max(axis=1)).max()) + 1 if len(rests) else 0

    def crossing(self, width: Array) -> int:
        """Samples in which the strongest MV, over its range, carries each integrating CV across ``width`` (n_cv,).

        No loop could be faster. 0 where no CV integrates.
        """
        fastest = (np.abs(self.slope) * self.spans[1]).max(axis=1)
        needed = np.where(self.integrates, width / np.where(fastest > 0, fastest, np.inf), 0.0)
        return int(np.ceil(needed.max()))

    def answers_after(self, cv: int, mv: int) -> int:
        """Samples from the step to the first one at which the CV has answered: 1 without a dead time.

        An answer is a change within a period of more than a tenth of the fastest, see ``first_answer_within``. It is 1
        of an MV that moves nothing.
        """
        y = self.y[cv, mv]
        return first_answer_within(y, RESPONSE_ROUNDING * float(np.abs(y).max())) or 1

    def starts_inverse(self, cv: int, mv: int) -> bool:
        """Whether the response first goes the other way, by more than a tenth of its end."""
        return starts_inverse(self.y[cv, mv] * np.sign(self.gain[cv, mv]))

    def process(self, cv: int, mv: int) -> FirstOrder:
        """The lag of ``two_point_lag``, or the ramp that an integrating response ends on, with its ``ramp_delay``.

        Raises LawError where the MV does not act on the CV.
        """
        y, h, slope = self.y[cv, mv], self.period_s, float(self.slope[cv, mv])
        end = float(y[-1])
        if slope:
            return FirstOrder(slope / h, inf, max(0.0, h * ramp_delay(len(y), end, slope)))
        if not abs(end) > 1e-9 * float(np.abs(self.y).max()):
            raise LawError("the MV does not act on the controlled variable at rest; check the pairing")
        tau, theta = two_point_lag(y / end, h)
        return FirstOrder(end / tau, tau, theta)


def _slopes(y: Array) -> Array:
    """Mean slopes (2, n_cv, n_mv) a period over the last but one and the last fifth of responses (n_cv, n_mv, n)."""
    n, fifth = y.shape[-1], y.shape[-1] // 5
    return np.stack([late_slope(y[..., : n - fifth], fifth), late_slope(y, fifth)])


def _settled(y: Array) -> NDArray[np.bool_]:
    return np.asarray(late_distance(y, y.shape[-1] // 5) <= STILL_RESPONSE * np.abs(y).max(axis=-1))


def _known(y: Array, slope: Array) -> bool:
    """Whether each response has settled, or goes on as evenly as it did before."""
    even = np.abs(slope[1] - slope[0]) <= EVEN * np.abs(slope[1])
    return bool((_settled(y) | even).all())
