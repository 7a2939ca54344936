"""The part of a plant's range that its record visited, and the set points and holds of tests that follow from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.steady_state import RESTING
from loopwright.pipeline.dynamics.step_response import SETTLED_BAND, UNSETTLED_CV, late_change, settling_index
from loopwright.pipeline.evaluation.case import Array
from loopwright.pipeline.evaluation.one_side import LATER_WAY, LATER_WAY_VISITED
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.rests import BALANCED, answered, balanced, courses, inside, settled
from loopwright.serving.manifest import Signal

VISITED_MV, VISITED_CV = (0.1, 0.9), (0.01, 0.99)  # quantiles of the record between which tests move
LEAST_VISITED = 0.05  # of an MV's commanded range, where that cuts the visited one
TEST_LEVELS = 6  # set points of a sequence
LEAST_TIMED_ANSWER = 0.2  # of a CV's largest answer to an MV: a smaller one says nothing about how long it takes
# a set point lasts so many times as long as an answer; the fewest and most samples
ANSWERS_A_SET_POINT, HOLD_SAMPLES = 3, (30, 400)
SCALES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.3, 0.2, 0.1)  # of the distance of drawn MVs from their medians
INWARD = (1.0, 0.75, 0.5, 0.25, 0.0)  # of the way from the visited range's middle to its end: where a rest is tried


@dataclass(frozen=True, eq=False)
class OperatingRange:
    """Set points that can be held jointly, and how long they are held, from a model of the plant and its record.

    A CV that settles under constant MVs takes the set points of rests under MVs drawn over the visited range; MVs
    whose rests leave the visited range of a CV are drawn nearer to their medians. A CV that never settles (an
    integrator) takes set points drawn over its own visited range, under MVs that balance it; and so do all CVs where
    even the medians' rest leaves the visited range. No set point leaves it: one that no MV was found for is cut to it.

    ``ranges``, PV -> (lowest, highest), are to be kept beside the set points: no rest beyond one of them is drawn, but
    where none within is found at all.
    """

    model: IdentifiedPlant
    record: Record
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @cached_property
    def mv(self) -> Array:
        """Lowest, median and highest visited MVs within the ranges of the model's, shape (3, n_mv)."""
        return visited_mv(self.record, self.model.mv_signals)

    @cached_property
    def cv(self) -> Array:
        """Lowest, median and highest visited CVs within the ranges of their set points, shape (3, n_cv)."""
        signals, (low, high) = self.model.sp_signals, VISITED_CV
        found = np.quantile(self.record.pv[:, : len(signals)], (low, 0.5, high), axis=0)
        return np.clip(found, [s.low for s in signals], [s.high for s in signals])

    @cached_property
    def answers(self) -> Array:
        """Differences (n_mv, RESTING + 1, n_cv) of the model's courses under the highest and the lowest of each MV."""
        return self._courses[0] - self._courses[1]

    @cached_property
    def _courses(self) -> Array:
        low, middle, high = self.mv
        ends = [np.where(np.eye(len(middle), dtype=bool), end, middle) for end in (high, low)]
        found = courses(self.model, self.model.start[0], np.vstack(ends), RESTING)[..., : len(self.model.sp_signals)]
        return found.reshape(2, len(middle), *found.shape[1:])

    @cached_property
    def integrates(self) -> tuple[int, ...]:
        """Places of the CVs that do not settle under constant MVs."""
        late = np.abs(late_change(np.moveaxis(self._courses, 2, -1), RESTING // 4 - 1)).max(axis=(0, 1))
        return tuple(int(i) for i in np.flatnonzero(late > UNSETTLED_CV * (self.cv[2] - self.cv[0])))

    @cached_property
    def hold(self) -> int:
        """Samples of a set point: three times what the slowest CV needs, and within ``HOLD_SAMPLES``.

        A CV that settles needs the time to ``SETTLED_BAND`` of its largest answers. One that does not settle needs
        the time in which the strongest MV, over all of its range, carries it across its visited range: no loop could be
        faster.
        """
        size, needed = np.abs(self.answers), [1]
        whole = np.array([s.high - s.low for s in self.model.mv_signals]) / (self.mv[2] - self.mv[0])
        for i in range(size.shape[2]):
            of = size[:, :, i]
            if i in self.integrates:
                crossed = of * whole[:, None] >= self.cv[2, i] - self.cv[0, i]
                needed.append(int(np.where(crossed.any(axis=1), crossed.argmax(axis=1), RESTING).min()))
                continue
            most = of.max(axis=1)
            settled_after = settling_index(self.answers[:, :, i], SETTLED_BAND * most)
            needed += settled_after[most >= LEAST_TIMED_ANSWER * of.max()].tolist()
        return int(np.clip(ANSWERS_A_SET_POINT * max(needed), *HOLD_SAMPLES))

    @cached_property
    def halfway(self) -> int:
        """Samples in which the strongest MV has moved the slowest CV half as far as it will, or as was visited."""
        size, width = np.abs(self.answers), self.cv[2] - self.cv[0]
        way = 0.5 * np.minimum(size.max(axis=1), width)  # (n_mv, n_cv)
        first = [int((size[j, :, i] >= way[j, i]).argmax()) for i, j in enumerate(way.argmax(axis=0))]
        return max(1, *first)

    def rest(self, plant: IdentifiedPlant) -> tuple[Array, Array] | None:
        """(state (n_x,), mv (n_mv,)) where a plant rests, if its own start is none within the record.

        Integrating CVs are balanced at their medians. Where the start leaves the visited range of another CV, all CVs
        are, at the nearest visited values: a test that begins outside would ask a model what its record never showed.
        None where the start serves, or no such rest is found.
        """
        (x, mv), found = plant.start, None
        if self.integrates:
            levels = self.cv[1, list(self.integrates)]
            at, acting, away = balanced(plant, x, mv, levels, self.integrates)
            found = (at, acting) if away < BALANCED else None
        cvs = plant.measure(x if found is None else found[0])[: self.cv.shape[1]]
        slack = BALANCED * (self.cv[2] - self.cv[0])
        if inside(cvs[None], self.cv[0] - slack, self.cv[2] + slack)[0]:
            return found
        for share in INWARD:
            levels = self.cv[1] + share * (np.clip(cvs, self.cv[0], self.cv[2]) - self.cv[1])
            if (held := held_at(plant, (x, mv), levels, self.model.mv_signals)) is not None:
                return held
        return found

    def set_points(self, plant: Simulator, seed: int, p: Array | None = None) -> Array:
        """Set points (TEST_LEVELS * hold, n_cv) that a plant can hold under its parameters p (n_p,), each held."""
        return self.drawn(plant, seed, p)[0]

    def drawn(self, plant: Simulator, seed: int, p: Array | None = None) -> tuple[Array, bool]:
        """(``set_points``, whether the plant rests at each: else where it starts stands in for one)."""
        levels, found = self._levels(plant, seed, p)
        if self.ranges and not found.any():
            levels, _ = replace(self, ranges={})._levels(plant, seed, p)
        return np.repeat(np.clip(levels, self.cv[0], self.cv[2]), self.hold, axis=0), bool(found.all())

    def _levels(self, plant: Simulator, seed: int, p: Array | None) -> tuple[Array, NDArray[np.bool_]]:
        """CVs (TEST_LEVELS, n_cv), and at which of them (TEST_LEVELS,) the plant rests."""
        rng = np.random.default_rng(seed)
        draws = rng.uniform(self.mv[0], self.mv[2], (TEST_LEVELS, self.mv.shape[1]))
        if self.integrates:
            return self._balances(plant, draws, rng, p)
        levels, good = self._rests(plant, draws, p)
        wanted = rng.uniform(self.cv[0], self.cv[2], levels.shape)
        for k in np.flatnonzero(~good):
            held = self._held(plant, wanted[k], p)
            good[k] = held is not None
            levels[k] = self._begin(plant) if held is None else held
        return levels, good

    def stays(self, plant: IdentifiedPlant, p: Array) -> bool:
        """Whether a plant with the parameters p (n_p,) stays where it answers to, under each MV at its ends.

        An error of the gain takes a model beyond its record, where it may run away from what it had reached. It may go
        on by ``LATER_WAY`` of the visited range, and ``LATER_WAY_VISITED`` times as far as without the errors: a slow
        one does.
        """
        span = self.cv[2] - self.cv[0]
        further, usual = (self._goes_on(plant, of) for of in (p, plant.parameters()))
        return bool(np.all(further <= np.maximum(LATER_WAY * span, LATER_WAY_VISITED * usual)))

    def _goes_on(self, plant: IdentifiedPlant, p: Array) -> Array:
        """How far the CVs (n_cv,) move at most after their answers to each MV at an end of its range."""
        x, mv = plant.start
        ends = [np.where(np.eye(len(mv), dtype=bool), [getattr(s, end) for s in plant.mv_signals], mv)
                for end in ("low", "high")]  # fmt: skip
        mvs = np.vstack(ends)
        answer = RESTING if plant.foreseen is None else plant.foreseen + plant.most_dead_time
        known, rests = answered(plant, x, mvs, answer, p)
        return np.asarray(np.abs(rests - known)[:, : self.cv.shape[1]].max(axis=0))

    def _begin(self, plant: Simulator) -> Array:
        """CVs (n_cv,) where a plant starts, within the visited range."""
        return np.clip(plant.measure(plant.start[0])[: self.cv.shape[1]], self.cv[0], self.cv[2])

    def _rests(self, plant: Simulator, draws: Array, p: Array | None) -> tuple[Array, NDArray[np.bool_]]:
        """CVs (TEST_LEVELS, n_cv) of rests within the visited range, of each draw the farthest from the medians.

        And which (TEST_LEVELS,) there are: of the others no rest on the way to the medians lies within.
        """
        scaled = self.mv[1] + np.array(SCALES)[:, None, None] * (draws - self.mv[1])
        x = settled(plant, plant.start[0], scaled.reshape(-1, draws.shape[1]), p)
        pvs = plant.measured(x).reshape(*scaled.shape[:2], -1)
        cvs = pvs[..., : self.cv.shape[1]]
        good = inside(cvs, self.cv[0], self.cv[2]) & self._kept(plant, pvs)
        return np.asarray(cvs[good.argmax(axis=0), np.arange(len(draws))]), np.asarray(good.any(axis=0))

    def _kept(self, plant: Simulator, pvs: Array) -> NDArray[np.bool_]:
        """The rows of a plant's PVs (..., n_pv) that lie within ``ranges``."""
        ends = [self.ranges.get(s.name, (-np.inf, np.inf)) for s in plant.pv_signals]
        return inside(pvs, *np.array(ends).T)

    def _held(self, plant: Simulator, wanted: Array, p: Array | None) -> Array | None:
        """CVs (n_cv,) of a rest on the way from where the plant starts to ``wanted`` (n_cv,); None without one."""
        start = self._begin(plant)
        for scale in SCALES:
            levels = start + scale * (wanted - start)
            held = held_at(plant, plant.start, levels, self.model.mv_signals, p)
            if held is not None and self._kept(plant, plant.measure(held[0])):
                return levels
        return None

    def _balances(
        self, plant: Simulator, draws: Array, rng: np.random.Generator, p: Array | None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """CVs (TEST_LEVELS, n_cv) of rests, with levels drawn for those that integrate; and which of them are rests."""
        which, (start, mv0) = list(self.integrates), plant.start
        wanted = rng.uniform(self.cv[0, which], self.cv[2, which], (len(draws), len(which)))
        found, rests = np.tile(plant.measure(start)[: self.cv.shape[1]], (len(draws), 1)), np.ones(len(draws), bool)
        for k, (draw, levels) in enumerate(zip(draws, wanted, strict=True)):
            found[k, which] = levels
            for scale in SCALES:
                x, mv, away = balanced(plant, start, mv0 + scale * (draw - self.mv[1]), levels, which, p)
                pvs = plant.measure(x)
                cvs = pvs[: self.cv.shape[1]]
                good = inside(cvs, self.cv[0], self.cv[2]) & self._kept(plant, pvs)
                if away < BALANCED and good and can_command(self.model.mv_signals, mv):
                    found[k] = cvs
                    break
            else:
                rests[k] = False
        return found, rests


def can_command(mvs: Sequence[Signal], values: Array, room: float = 0.0) -> bool:
    """Whether MVs (n_mv,) lie within their ranges, less a share ``room`` at both ends."""
    low, high = (np.array([getattr(s, end) for s in mvs]) for end in ("low", "high"))
    return bool(inside(values[None], low + room * (high - low), high - room * (high - low))[0])


def held_at(
    plant: Simulator,
    begin: tuple[Array, Array],
    levels: Array,
    mvs: Sequence[Signal],
    p: Array | None = None,
    room: float = 0.0,
) -> tuple[Array, Array] | None:
    """(state (n_x,), mv (n_mv,)) of a rest near ``begin`` with all CVs at ``levels`` (n_cv,), under MVs within ``mvs``.

    ``room`` is the share of their ranges that they leave at both ends. None where there is no such rest.
    """
    x, acting, away = balanced(plant, *begin, levels, range(len(levels)), p)
    return (x, acting) if away < BALANCED and can_command(mvs, acting, room) else None


def visited_mv(record: Record, mvs: Sequence[Signal]) -> Array:
    """Lowest, median and highest MVs (3, n_mv) of a record, within the ranges that ``mvs`` may be commanded over.

    Where the median lies outside such a range or at its end, the middle of what was visited within takes its place:
    a loop that begins at an end has no room on one side. Where next to nothing was visited within, the whole range
    counts.
    """
    low, high = VISITED_MV
    whole = np.asarray(np.quantile(record.mv, (low, 0.5, high), axis=0))
    found = np.clip(whole, [s.low for s in mvs], [s.high for s in mvs])
    span = np.array([s.high - s.low for s in mvs])
    cut = np.any(found != whole, axis=0)
    narrow = cut & (found[2] - found[0] < LEAST_VISITED * span)
    found = np.where(narrow, [[s.low for s in mvs], [s.middle for s in mvs], [s.high for s in mvs]], found)
    at_end = cut & ~((found[0] < found[1]) & (found[1] < found[2]))
    found[1] = np.where(at_end, 0.5 * (found[0] + found[2]), found[1])
    return found
