"""Tests that show what a law with ``operate`` is for, made for an own plant, and those of params.yaml."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle

import numpy as np

from loopwright.pipeline.cases.operating_range import SCALES, VISITED_CV, held_at
from loopwright.pipeline.cases.operator_asks import asked_at, problem_of
from loopwright.pipeline.cases.own_model import OwnPlant
from loopwright.pipeline.cases.own_plant import LOAD_AT, OwnCase
from loopwright.pipeline.cases.own_tests import load_size, whole_load
from loopwright.pipeline.config.operator_tests import AT, OperatedTestParams, Timed
from loopwright.pipeline.errors import ParamsError, nearest
from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.evaluation.operated import OperatedLimits
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.simulation.operator_changes import OperatorChange
from loopwright.pipeline.simulation.rests import courses
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving.manifest import OF_GROUP, OperateEntry, Signal

CHANGE_AT = LOAD_AT  # sample at which operators change something: the law has begun by then
LEAST_SAMPLES = 300  # of a test with costs or resting values, which move MVs slowly: 100 to 200 samples and a rest
HALF_WIDTH = 0.1  # of the range that the record visited: half of a range that is narrowed ...
NOISES_WIDE = 4.0  # ... or so many standard deviations of the noise, where more: the law keeps five of its estimate in
ROOM_TO_EARN = 0.25  # of the range that the record visited, to each side of where the plant rests: room for costs
PUSHED = 2.0  # loads of ``load_size`` that push a PV; its range is one of them wide to each side
AT_ODDS = 0.5  # of an MV's room, to the end that is farther: what the first range asks of the only MV in use
CLEARLY_ODD = 3.0  # half widths by which the second range is then left, at least
REST_WAY = 0.3  # of the way to the end of the ranges: where resting values hold the PVs


@dataclass(frozen=True, slots=True, eq=False)
class OperatedTest:
    """A test by its sequences, each on a plant of its own, with its limits."""

    sequences: tuple[Scenario, ...]
    limits: OperatedLimits


def operated_tests(
    case: Case, entries: Sequence[OperateEntry], own: Mapping[str, OperatedTestParams]
) -> dict[str, OperatedTest]:
    """The tests of a law with these entries of ``operate``; empty for a law without.

    An own plant has tests of its own accord: of a range, of MVs taken out, of costs, of a load, of ranges at odds and
    of resting values. A test of params.yaml with such a name takes its place. ParamsError names what is wrong with one.
    """
    if not entries:
        return {}
    found: dict[str, OperatedTest] = {}
    if isinstance(case, OwnCase):
        made = _Made(case, entries)
        for name, sequences in made.tests().items():
            if sequences:
                found[name] = OperatedTest(sequences, OperatedLimits())
    for name, params in own.items():
        limits = OperatedLimits()
        limits = replace(limits, most_outside=_share(params.most_outside, limits.most_outside))
        limits = replace(limits, least_gain=_share(params.least_gain, limits.least_gain))
        found[name] = OperatedTest(_of_params(case, entries, name, params), limits)
    return found


def _share(percent: float | None, default: float) -> float:
    return default if percent is None else percent / 100


# ------------------------------------------------------------------------------------------------ tests of params.yaml
def check_operated(case: Case, own: Mapping[str, OperatedTestParams]) -> None:
    """ParamsError for a test of params.yaml that names a signal which the plant has not, before any law is designed."""
    if not own:
        return
    pv, mv = (case.plant_class.pv_signals, case.plant_class.mv_signals)
    known = [f"{s.name}.{what}" for s in pv for what in sorted(OF_GROUP["cv"])]
    known += [f"{s.name}.{what}" for s in mv for what in sorted(OF_GROUP["mv"])] + sorted(OF_GROUP["law"])
    for test, params in own.items():
        groups = (
            ("operate", params.operate, known, "entry of operate"),
            ("set_points", params.set_points, [s.name for s in case.plant_class.sp_signals], "set point"),
            ("measured", params.measured, [s.name for s in case.plant_class.dv_signals], "disturbance"),
        )
        for group, rows, names, what in groups:
            for name in (key for row in rows for key in row if key != AT and key not in names):
                raise ParamsError(
                    f"cases.{case.name}.operated.{test}.{group}: there is no {what} {name!r}{nearest(name, names)}"
                )


def _of_params(
    case: Case, entries: Sequence[OperateEntry], name: str, params: OperatedTestParams
) -> tuple[Scenario, ...]:
    """A test of params.yaml on each model of an own plant's record, or on a case's plant."""
    where, period = f"cases.{case.name}.operated.{name}", case.plant.period_s
    n = math.ceil(params.duration_s / period - 1e-9)
    plants: tuple[Simulator, ...] = case.members if isinstance(case, OwnCase) else (case.plant,)
    found = []
    for plant in plants:
        x0, mv0 = plant.start
        sp = np.tile(plant.measure(x0)[: len(plant.sp_signals)], (n, 1))
        _fill(sp, params.set_points, [s.name for s in plant.sp_signals], period, f"{where}.set_points", "set point")
        dv = np.tile(plant.dv_nominal, (n, 1))
        _fill(dv, params.measured, [s.name for s in plant.dv_signals], period, f"{where}.measured", "disturbance")
        names = list(plant.parameter_names())
        p = np.tile(plant.parameters(), (n, 1))
        _fill(p, params.changes, names, period, f"{where}.changes", "parameter of the plant")
        moved = {key: p[:, i] for i, key in enumerate(names) if any(key in row for row in params.changes)}
        operate = tuple(
            OperatorChange(min(round(row[AT] / period), n - 1), {k: v for k, v in row.items() if k != AT})
            for row in params.operate
        )
        title = params.title or name.replace("_", " ").capitalize()
        test = Scenario(name, title, sp, x0, mv0, moved, plant=plant, dv=dv, operate=operate)
        test.operated(entries)  # raises where a change cannot be
        found.append(test)
    return tuple(found)


def _fill(table: Array, changes: Timed, names: Sequence[str], period_s: float, where: str, what: str) -> None:
    """Put timed changes by name into a table (n, len(names)); ParamsError for an unknown name."""
    for row in sorted(changes, key=lambda one: one[AT]):
        for name, value in row.items():
            if name == AT:
                continue
            if name not in names:
                raise ParamsError(f"{where}: there is no {what} {name!r}{nearest(name, names)}")
            table[round(row[AT] / period_s) :, names.index(name)] = value


# ------------------------------------------------------------------------------------------ tests that own plants have
class _Made:
    """The tests that an own plant has of its own accord, from the models of its record."""

    def __init__(self, case: OwnCase, entries: Sequence[OperateEntry]) -> None:
        self.case, self.entries, self.reach = case, tuple(entries), case.reach
        self.places = {e.name: e for e in entries}
        self.mvs = case.plant.mv_signals
        outputs = len(case.plant.pv_signals)
        self.pvs = [s for s in case.plant.pv_signals if f"{s.name}.low" in self.places]
        visited = np.quantile(case.record.pv[:, :outputs], VISITED_CV, axis=0)
        self.visited = visited[1] - visited[0]
        self.least_half = NOISES_WIDE * case.noise_std[:outputs]
        self.half = np.maximum(HALF_WIDTH * self.visited, self.least_half)

    def tests(self) -> dict[str, tuple[Scenario, ...]]:
        """Name -> the test on each model; those that a plant does not allow are left out."""
        plants = self.case.members
        turns = list(zip(range(max(len(self.mvs), len(plants))), cycle(plants), strict=False))
        found: dict[str, Sequence[Scenario | None]] = {
            "narrowed": [self.narrowed(p, seed) for seed, p in zip(self.case.held_out_seeds, plants, strict=False)],
            "taken_out": [self.taken_out(p, self.case.held_out_seeds[0], j % len(self.mvs)) for j, p in turns],
            "costs": [self.costs(p) for p in plants],
            "pushed": [self.pushed(p) for p in plants],
            "at_odds": [self.at_odds(p) for p in plants],
            "resting": [self.resting(p) for p in plants],
        }
        return {name: tuple(test for test in tests if test is not None) for name, tests in found.items()}

    # ---------------------------------------------------------------------------------------------- the six tests
    def narrowed(self, plant: OwnPlant, seed: int) -> Scenario | None:
        """Ranges in place of set points, which shut the present values out; a steady state keeps them all."""
        y0 = plant.measure(plant.start[0])
        levels = self.reach.set_points(plant, seed)[:: self.reach.hold]
        n_cv = levels.shape[1]
        far = np.max(np.abs(levels - y0[:n_cv]) / self.visited[:n_cv], axis=1)
        for k in np.argsort(-far):
            middle = np.concatenate([levels[k], y0[n_cv:]])
            values = self._ranges(range(n_cv), middle, self.half)
            names = ", ".join(s.name for s in self.pvs[:n_cv])
            title = f"Ranges in place of set points, away from where the plant is: {names}"
            test = self._test("narrowed", title, plant, [(CHANGE_AT, values)], 2 * self.reach.hold)
            if self._kept(test):
                return test
        return None

    def taken_out(self, plant: OwnPlant, seed: int, mv: int) -> Scenario:
        """An MV is taken out at rest, set points move while it is out, and it comes back."""
        hold, name = self.reach.hold, self.mvs[mv].name
        moved = self.reach.set_points(plant, seed)[:: self.reach.hold]
        y0 = plant.measure(plant.start[0])[: moved.shape[1]]
        sp = np.tile(y0, (3 * hold, 1))
        sp[hold // 2 :] = moved[int(np.argmax(np.max(np.abs(moved - y0) / self.visited[: len(y0)], axis=1)))]
        changes = [(CHANGE_AT, {f"{name}.use": 0.0}), (hold, {f"{name}.use": 1.0})]
        title = f"MVs taken out, each in turn, set points moved, and back: {', '.join(s.name for s in self.mvs)}"
        return self._test("taken_out", title, plant, changes, 3 * hold, sp)

    def costs(self, plant: OwnPlant) -> Scenario:
        """A cost on each MV, as much for a range of each; the PVs have room within ranges."""
        y0 = plant.measure(plant.start[0])
        values = self._ranges(range(len(self.pvs)), y0, np.maximum(ROOM_TO_EARN * self.visited, self.half))
        values |= {f"{s.name}.cost": self._cost(s) for s in self.mvs}
        title = f"Costs put in, {self._cost_words}; process variables have ranges in place of set points"
        n = max(3 * self.reach.hold, LEAST_SAMPLES)
        return self._test("costs", title, plant, [(CHANGE_AT, values)], n)

    @property
    def _cost_words(self) -> str:
        each = [f"{self._cost(s):g} for {s.name}" for s in self.mvs]
        return f"{', '.join(each)}, per unit and period"

    @staticmethod
    def _cost(mv: Signal) -> float:
        """The cost of a unit of an MV: all of its range costs 100 a period."""
        return float(f"{100 / (mv.high - mv.low):.3g}")

    def pushed(self, plant: OwnPlant) -> Scenario | None:
        """A load that nobody measures pushes a PV out of its range; one without a set point, if there is one."""
        n_cv, n_y = len(self.case.signals.sp), len(self.pvs)
        i = n_cv if n_y > n_cv else 0
        name, size = self.pvs[i].name, load_size(self.reach, i)
        y0, n = plant.measure(plant.start[0]), 2 * self.reach.hold
        values = self._ranges([i], y0, np.full(n_y, size))
        late = (np.arange(n) >= self.reach.hold // 2).astype(np.float64)
        whole = PUSHED * whole_load(self.reach, plant, i)
        for scale in SCALES:
            load = {f"load_{name}": scale * whole * late}
            title = f"A load that nobody measures pushes {name} towards the end of its range"
            test = self._test("pushed", title, plant, [(CHANGE_AT, values)], n, loads=load)
            if self._kept(test):
                return test
        return None

    def at_odds(self, plant: OwnPlant) -> Scenario | None:
        """One MV is left in use, and two PVs have ranges that it cannot keep both; the first has the higher rank."""
        (x, mv0), n = plant.start, 2 * self.reach.hold
        settling = [i for i in range(len(self.pvs)) if i not in self.reach.integrates]
        y0, best = plant.measure(x), None
        down, up = self._room(y0)
        for j, s in enumerate(self.mvs):
            room = s.high - mv0[j] if s.high - mv0[j] > mv0[j] - s.low else s.low - mv0[j]
            moved = np.array(mv0, dtype=np.float64)
            moved[j] += AT_ODDS * room
            # The range of the first rank must begin before the other end of what operators allow by default.
            way = np.clip(courses(plant, x, moved[None], n)[0, -1] - y0, -down, up)
            for a in settling:
                for b in settling:
                    clear = min(abs(way[a]) / self.least_half[a], abs(way[b]) / self.least_half[b])
                    if a != b and (best is None or clear > best[0]):
                        best = clear, j, a, b, way
        if best is None or best[0] < CLEARLY_ODD:
            return None
        _, j, a, b, way = best
        first, last = self.pvs[a], self.pvs[b]
        ends = {"low": y0[a] + way[a]} if way[a] > 0 else {"high": y0[a] + way[a]}
        values = {f"{s.name}.track": 0.0 for s in self.case.signals.sp}
        values |= {f"{s.name}.use": 0.0 for k, s in enumerate(self.mvs) if k != j}
        values |= {f"{first.name}.{end}": self._within(first.name, end, float(of)) for end, of in ends.items()}
        values |= {f"{first.name}.rank": 1.0, f"{last.name}.rank": 4.0}
        values |= self._ranges([b], y0, self.least_half)
        title = f"Two ranges at odds, {self.mvs[j].name} alone in use: {first.name} of rank 1, {last.name} of rank 4"
        return self._test("at_odds", title, plant, [(CHANGE_AT, values)], n)

    def resting(self, plant: OwnPlant) -> Scenario | None:
        """Every MV has a resting value; the PVs have ranges in place of set points, within which they rest then."""
        (x, mv0), n_cv = plant.start, len(self.case.signals.sp)
        y0 = plant.measure(x)
        half = np.maximum(ROOM_TO_EARN * self.visited, self.half)
        for scale in SCALES:
            found = held_at(plant, (x, mv0), (y0 + scale * REST_WAY * half)[:n_cv], self.mvs)
            if found is None:
                continue
            values = self._ranges(range(n_cv), y0, half)
            for s, rest in zip(self.mvs, found[1], strict=True):
                values |= {f"{s.name}.rest": self._within(s.name, "rest", float(rest)), f"{s.name}.rest_use": 1.0}
            title = "Resting values of the MVs; process variables have ranges in place of set points"
            n = max(3 * self.reach.hold, LEAST_SAMPLES)
            test = self._test("resting", title, plant, [(CHANGE_AT, values)], n)
            if self._kept(test):
                return test
        return None

    # ------------------------------------------------------------------------------------------------ their parts
    def _ranges(self, which: Sequence[int], middle: Array, half: Array) -> dict[str, float]:
        """Ranges of some PVs about their middles (n_y,) by half widths (n_y,) [pv], within the engineered ones."""
        values = {}
        for i in which:
            name = self.pvs[i].name
            values[f"{name}.track"] = 0.0
            values[f"{name}.low"] = self._within(name, "low", float(middle[i] - half[i]))
            values[f"{name}.high"] = self._within(name, "high", float(middle[i] + half[i]))
        return values

    def _room(self, y: Array) -> tuple[Array, Array]:
        """How far PVs (n_y,) may go down and up from ``y`` and be a range's width from the ends of their defaults."""
        low, high = (np.array([self.places[f"{s.name}.{end}"].default for s in self.pvs]) for end in ("low", "high"))
        width = 2 * self.least_half
        return np.maximum(y - low - width, 0.0), np.maximum(high - width - y, 0.0)

    def _within(self, signal: str, what: str, value: float) -> float:
        """A value within its engineered range, in digits that a person would set."""
        entry = self.places[f"{signal}.{what}"]
        return float(np.clip(float(f"{value:.5g}"), entry.low, entry.high))

    def _test(
        self,
        name: str,
        title: str,
        plant: OwnPlant,
        changes: Sequence[tuple[int, Mapping[str, float]]],
        n: int,
        sp: Array | None = None,
        loads: Mapping[str, Array] | None = None,
    ) -> Scenario:
        x0, mv0 = plant.start
        rest = np.tile(plant.measure(x0)[: len(plant.sp_signals)], (n, 1))
        operate = tuple(OperatorChange(at, values) for at, values in changes)
        courses_of = rest if sp is None else sp
        return Scenario(name, title, courses_of, x0, mv0, loads or {}, plant=plant, operate=operate)

    def _kept(self, test: Scenario) -> bool:
        """Whether a steady state of the plant keeps all ranges of the end of a test."""
        course, plant = test.operated(self.entries), test.plant
        assert course is not None
        assert isinstance(plant, OwnPlant)
        found = problem_of(plant).best(
            asked_at(course, plant), test.sp[-1], test.parameters(plant)[-1], plant.dv_nominal, (test.x0, test.mv0)
        )
        return found is not None and not np.any(found.outside)
