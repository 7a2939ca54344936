"""A person's own plant as a case: known by its record, and validated on models of that record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import cycle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from loopwright.pipeline.cases.operating_range import ANSWERS_A_SET_POINT
from loopwright.pipeline.cases.own_ensemble import OwnEnsemble
from loopwright.pipeline.cases.own_entries import OLD_LOOP, kept_ranges, sign_held
from loopwright.pipeline.cases.own_model import MODEL_SET, GoneWrong, OwnPlant, Untrained, errors_of
from loopwright.pipeline.cases.own_tests import (
    LEAST_DAILY_ROWS,
    course,
    day,
    held_load,
    level_of,
    load_size,
    spread,
    whole_load,
    windows,
)
from loopwright.pipeline.config.known import together
from loopwright.pipeline.config.params import sections_of
from loopwright.pipeline.config.plants import MvParams, PlantParams, SignalParams
from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.evaluation.closed_loop import RANGE_BAND, closed_loop_metrics
from loopwright.pipeline.evaluation.knowing_control import gets_there
from loopwright.pipeline.evaluation.metric import METRICS, Metric
from loopwright.pipeline.metrics import mae
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario
from loopwright.serving.manifest import Signal

LOAD_AT = 5  # sample at which a load or a step of a measured disturbance begins
SPOILT = "spoilt"  # the test on models gone wrong
LOADED = "load"  # the test with loads that nobody measures
DAILY = "daily"  # the test with the record's own set points and loads
MEASURED = "measured"  # the test with steps of the measured disturbances
ERROR_SHARES = (1.0, 0.5, 0.25, 0.125)  # of the errors of a plant gone wrong
PERCENT = "% of range"
GATE = {"held_out": 0.5, "held_out_noise": 0.2, LOADED: 0.15, "spoilt": 0.15}
GATE_WITH_MEASURED = {"held_out": 0.5, "held_out_noise": 0.2, LOADED: 0.1, MEASURED: 0.1, "spoilt": 0.1}


LEAST_ASKED = 0.01
"""Share of a range that set points go at least, where errors are shares of it: none is divided by nothing."""


class OwnCase(OwnEnsemble):
    """Tests of an own plant: on models of its record that had no part in tuning, and on such models spoilt.

    Set points are what the model of each test can hold within the range that the record visited (``OperatingRange``).
    Errors of several CVs count in % of their ranges. The subclass of a plant states its signals, see ``own_case``.
    """

    development_seeds: ClassVar[tuple[int, ...]] = (1, 2, 3, 4)
    development_noise: ClassVar[bool] = True
    development_geometric: ClassVar[bool] = True
    gate: ClassVar[Mapping[str, float]] = GATE
    on_models: ClassVar[bool] = True
    data_seeds: ClassVar[int] = 1
    unforeseen: ClassVar[bool] = True
    gone_wrong: ClassVar[tuple[str, ...]] = (SPOILT,)
    test_words: ClassVar[Mapping[str, str]] = {DAILY: "daily work"}

    @property
    def noise_std(self) -> Array:
        """Measurement noise as the law's model estimates it, shape (n_pv,)."""
        return self._nominal.noise_std

    @property
    def noise_level(self) -> float:
        """The noise in the unit of the case's metric: of several CVs the mean of their shares of the ranges [%]."""
        noise = self.noise_std[: len(self.signals.sp)]
        return float(noise[0]) if len(noise) == 1 else float(np.mean(100 * noise / _spans(self.signals.sp)))

    @property
    def cv_unit(self) -> str:
        """The unit of the controlled variable; of several their errors are put together in shares of their ranges."""
        return self.signals.sp[0].unit if len(self.signals.sp) == 1 else PERCENT

    @property
    def travel_in_shares(self) -> bool:
        """Whether the MVs' travel counts in % of their ranges: where the errors do, and where the MVs' units differ."""
        return len(self.signals.sp) > 1 or super().travel_in_shares

    @property
    def settling_s(self) -> float:
        """A set point lasts so many times as long, within limits."""
        return self.hold / ANSWERS_A_SET_POINT * self.signals.period_s

    @cached_property
    def asked(self) -> Array:
        """How far the set points of test ``held_out`` go, (n_cv,), and at least ``LEAST_ASKED`` of the ranges."""
        went = np.ptp(np.concatenate([test.sp for test in self._held_out]), axis=0)
        return np.asarray(np.maximum(went, LEAST_ASKED * _spans(self.signals.sp)))

    @cached_property
    def spans(self) -> Array:
        """The same, or so much that an error of ``RANGE_BAND`` of it is the noise: the range says nothing of a loop."""
        return np.maximum(self.asked, self.noise_std[: len(self.asked)] / RANGE_BAND)

    @property
    def hold(self) -> int:
        """Samples of a set point."""
        return self.reach.hold

    def score(self, test: Scenario, pv: Array, mv: Array) -> dict[str, float]:
        """Figures of one closed loop; of several CVs in % of their ranges, and the MAE of each in its own unit."""
        signals = self.signals.sp
        n = len(signals)
        if n == 1:
            return super().score(test, pv, mv)
        spans = _spans(signals)
        shares = (100 * test.sp / spans, 100 * pv[:, :n] / spans, self.mv_shares(mv))
        small = 100 * self.spans / spans
        figures = closed_loop_metrics(*shares, test.hold, self.signals.period_s, small, test.late_from)
        return figures | {mae_of(s): mae(test.sp[:, i], pv[:, i]) for i, s in enumerate(signals)}

    def _test(
        self,
        name: str,
        title: str,
        sp: Array,
        plant: IdentifiedPlant,
        seed: int | None,
        changed: Mapping[str, float],
        dv: Array | None = None,
    ) -> Scenario:
        # A load begins after some samples: a law that begins with it could take it for a part of its start.
        late: Array = (np.arange(len(sp)) >= LOAD_AT).astype(np.float64)
        changes = {k: v * late if k.startswith("load_") else np.full(len(sp), float(v)) for k, v in changed.items()}
        x0, mv0 = plant.start
        return Scenario(
            name, title, sp, x0, mv0, changes, self.hold if seed is not None else 0, seed, plant=plant, dv=dv
        )

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        """Set points on the other models; the same on spoilt ones; loads; and steps of the measured disturbances.

        There is a load on each CV, upwards and downwards, which no controller sees, where MVs can hold it.
        Each measured disturbance that moves in the record steps upwards and downwards too.
        """
        return dict(self._scenarios)

    @property
    def _pairs(self) -> list[tuple[int, OwnPlant]]:
        """Each held-out seed with its plant, these by turns."""
        return list(zip(self.held_out_seeds, cycle(self.members), strict=False))

    @cached_property
    def _held_out(self) -> tuple[Scenario, ...]:
        title = "Set points, on models identified from the record"
        drawn = zip(self._pairs, self._drawn, strict=True)
        return tuple(self._test("held_out", title, sp, p, s, {}) for (s, p), (sp, _) in drawn)

    @cached_property
    def _drawn(self) -> list[tuple[Array, bool]]:
        """Set points of each pair, and whether its plant rests at all of them, within the ranges that laws keep."""
        return [self.reach.drawn(p, s) for s, p in self._pairs]

    @cached_property
    def _scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        members, pairs = self.members, self._pairs
        errors = [wrong.as_likely for wrong in errors_of(self._nominal)]
        # Each kind meets another model in the next round: with as many kinds as models it would meet one alone.
        rounds = [(i + i // len(errors)) % len(members) for i in range(len(pairs))]
        spoilt = [
            self._spoilt(members[at], s, of) for at, (s, _), of in zip(rounds, pairs, cycle(errors), strict=False)
        ]
        upwards = [(p, up) for (_, p), up in zip(pairs, cycle((True, False)), strict=False)]
        less = sorted({share for _, share in spoilt if share < 1})
        title = f"Set points, on such models gone wrong: {'; or '.join(map(str, errors))}"
        if less:
            count = sum(share < 1 for _, share in spoilt)
            title += (
                f"; in {count} of {len(pairs)}, where no control gets to the set points or the model runs away, by "
                f"{_shares(less)} of that"
            )
        return {
            "held_out": self._held_out,
            SPOILT: tuple(replace(test, title=title) for test, _ in spoilt),
            **self._loads(upwards),
            **self._measured(upwards),
            **self._daily(members),
        }

    def _spoilt(self, plant: OwnPlant, seed: int, wrong: GoneWrong) -> tuple[Scenario, float]:
        """The test on a plant gone wrong, and the share of the errors: the largest that can be controlled.

        The plant then rests at each set point, does not run away under an MV at its end, and a control that knows it
        gets there in each hold. Where it does so with none of ``ERROR_SHARES`` the errors are not to blame, and stay
        whole.
        """
        whole: Scenario | None = None
        for share in ERROR_SHARES:
            of = wrong.lessened(share).parameters
            sp, rests = self.reach.drawn(plant, seed, plant.parameters(of))
            test = replace(self._test("spoilt", "", sp, plant, seed, of), kind=wrong.kind)
            whole = whole or test
            if rests and self.reach.stays(plant, plant.parameters(of)) and gets_there(plant, test, self.asked):
                return test, share
        assert whole is not None
        return whole, 1.0

    def _daily(self, members: Sequence[OwnPlant]) -> dict[str, tuple[Scenario, ...]]:
        """The test with set points and loads of the record, on each plant in turn; empty without long windows."""
        sp, found, recorded = self.set_points, [], []
        parts = [] if sp is None else spread(windows(self.record, sp, self.hold))
        for plant, rows in zip(cycle(members), parts, strict=False):
            one = None if sp is None else day(plant, self.record, sp, rows, same_row=self.same_row)
            if one is None:
                continue
            loads = {f"load_{s.name}": one.load[:, i] for i, s in enumerate(plant.pv_signals)}
            test = Scenario(DAILY, "", one.sp, one.x0, one.mv0, loads, plant=plant, replayed=True, dv=one.dv)
            found.append(test)
            recorded.append(self.score(test, one.pv, one.mv)[self.metric])
        if not found:
            return {}
        old = f"{np.mean(recorded):.3g} {METRICS[self.metric].unit_of(self.cv_unit)}".rstrip()
        title = (
            f"Daily work: set points and loads of {sum(map(len, (t.sp for t in found)))} rows of the record, noise and "
            f"all; in the record itself the {METRICS[self.metric].short} was {old}"
        )
        return {DAILY: tuple(replace(test, title=title) for test in found)}

    def _loads(self, pairs: Sequence[tuple[OwnPlant, bool]]) -> dict[str, tuple[Scenario, ...]]:
        """The test with a load on each CV, on plants, upwards or not; without those that the MVs cannot hold."""
        found, shares = [], []
        for j, cv in enumerate(self.signals.sp):
            for plant, upwards in pairs:
                if (size := held_load(self.reach, plant, j, upwards)) is not None:
                    shares.append(size / whole_load(self.reach, plant, j, upwards))
                    changed = {f"load_{cv.name}": size}
                    found.append(self._test(LOADED, "", self._resting_at(plant), plant, None, changed))
        least = f", which is at least {100 * min(shares):.2g} % of it" if shares and min(shares) < 1 else ""
        found = [replace(test, title=f"{self._load_title}{least}") for test in found]
        return {LOADED: tuple(found)} if found else {}

    @property
    def _load_title(self) -> str:
        cvs = self.signals.sp
        sizes = [f"{cv.name} by {load_size(self.reach, j):.3g} {_shown(cv)}".rstrip() for j, cv in enumerate(cvs)]
        each = ", each in turn" if cvs[1:] else ""
        return f"A load that moves {' or '.join(sizes)} if no controller acts{each}; or as much as the MVs can hold"

    @cached_property
    def weights(self) -> Mapping[str, float]:
        """The weights of the gate; without a load that can be held, the weight of that test goes to the others."""
        tests = self.scenarios()
        kept = {name: weight for name, weight in self.gate.items() if name.removesuffix(NOISE_SUFFIX) in tests}
        if len(kept) == len(self.gate):
            return self.gate
        return {name: round(weight / sum(kept.values()), 4) for name, weight in kept.items()}

    @cached_property
    def lacking(self) -> tuple[str, ...]:
        """Loads that no MV can hold; and daily work that no row, or none in one piece, shows."""
        tests = self.scenarios()
        wanted = len(self.signals.sp) * len(self.held_out_seeds)
        left = len(tests.get(LOADED, ()))
        why = "from where the plant rests, the MVs within their ranges cannot hold any load of this kind"
        found = []
        if not left:
            found.append(f"There is no test with loads: {why}. Its weight goes to the other tests.")
        elif left < wanted:
            found.append(f"{wanted - left} of {wanted} tests with loads are left out: {why}.")
        if self.kept_ranges and not all(rests for _, rests in self._drawn):
            found.append(
                f"Some set points are those at which a plant stands already, or ask for rests beyond the ranges of "
                f"{', '.join(self.kept_ranges)}: no other rest within these was found."
            )
        if DAILY not in tests and self.set_points is not None:
            found.append(
                f"There is no test of daily work: it replays {max(LEAST_DAILY_ROWS, self.hold)} rows or more in one "
                "piece, all loops in automatic, and the record has none, or a model does not stay finite over them."
            )
        return tuple(found)

    def _resting_at(self, plant: OwnPlant) -> Array:
        """Set points (2 hold, n_cv) where a plant rests."""
        return np.tile(plant.measure(plant.start[0])[: len(self.signals.sp)], (2 * self.hold, 1))

    def _measured(self, pairs: Sequence[tuple[OwnPlant, bool]]) -> dict[str, tuple[Scenario, ...]]:
        """The test with steps of each measured disturbance, on plants, upwards or not; empty where there is none."""
        dvs, samples = self.signals.dv, 2 * self.hold
        title = f"A step of {dvs[0].name}" if len(dvs) == 1 else "A step of a measured disturbance, each in turn"
        found, moved = [], []
        for j in range(len(dvs)):
            for plant, upwards in pairs:
                level = level_of(plant, self.record, j, upwards)
                dv = course(plant.dv_nominal, j, level, samples, LOAD_AT)
                test = self._test(MEASURED, f"{title}, and back", self._resting_at(plant), plant, None, {}, dv)
                found.append(replace(test, hold=self.hold))  # each of its moves settles for itself
                moved.append(level != plant.dv_nominal[j])
        # One at rest stands for all where the record has none that moves: the gate counts on the test.
        kept = [test for test, moves in zip(found, moved, strict=True) if moves] or found[:1]
        return {MEASURED: tuple(kept)} if kept else {}

    def development(self) -> tuple[Scenario, ...]:
        """Sequences on the law's own model as it is, and the first of them with errors too.

        A law that knows the model has no rival there. With errors a law's error is several times as large: in a plain
        mean the plant of the highest gain decided alone, which the plant of the record hardly ever is.
        """
        plant, first = self._nominal, self.development_seeds[:1]
        drawn = [(s, dict[str, float]()) for s in self.development_seeds]
        drawn += [(s, dict(wrong.parameters)) for s in first for wrong in errors_of(plant)]
        return tuple(
            self._test("development", "Development", self.reach.set_points(plant, s, plant.parameters(e)), plant, s, e)
            for s, e in drawn
        )


def own_case(name: str, base: type[OwnCase] = OwnCase, **further: Any) -> Case:
    """The case of ``plants.<name>`` of params.yaml; ``base`` with ``further`` attributes is its class."""
    params = PlantParams.read(name)
    pv, mv, dv = (tuple(map(_signal, group)) for group in (params.pv, params.mv, params.dv))
    recorded = Signals(params.period_s, pv[: params.n_controlled], pv, dv, mv)
    signals = replace(recorded, mv=tuple(_commanded(m, params.period_s) for m in params.mv))
    models, title = Path("work") / name / "models" / MODEL_SET / "seed0", name.replace("_", " ").capitalize()
    described = {f"{group}_signals": getattr(signals, group) for group in ("sp", "pv", "mv", "dv")}
    described |= {"name": name, "title": title, "period_s": signals.period_s, "needs": models}
    own: dict[str, Any] = {
        "name": name,
        "title": title,
        "signals": signals,
        "record_signals": recorded,
        "plant_class": type("OwnPlant", (Untrained,), described),
        "models": models,
        "data": params.data,
        "known": together(params.known),
        "held": sign_held(name, params),
        "kept_ranges": kept_ranges(name, params),
        "read_every": tuple(s.every for s in params.pv) if any(s.every > 1 for s in params.pv) else (),
        "own_metrics": tuple(Metric(mae_of(s), f"MAE {s.name}", unit=s.unit) for s in signals.sp[1:] and signals.sp),
        "__module__": base.__module__,
        **({"gate": GATE_WITH_MEASURED} if dv else {}),
        **(
            {"old_loop": OLD_LOOP, "baseline": OLD_LOOP}
            if f"{name}-{OLD_LOOP}" in sections_of("controllers", name)
            else {}
        ),
    }
    return type("OwnPlantCase", (base,), own | further)((9001, 9002, 9003))


def mae_of(cv: Signal) -> str:
    """Name of the figure of one CV among several."""
    return f"mae_{cv.name}"


def _shares(shares: Sequence[float]) -> str:
    """Shares in words."""
    return " or ".join(f"{100 * share:.2g} %" for share in shares)


def _shown(cv: Signal) -> str:
    """The unit of a CV as a person reads it; empty for a plain number."""
    return METRICS["mae"].unit_of(cv.unit)


def _spans(signals: Sequence[Signal]) -> Array:
    """Widths (n,) of the signals' ranges."""
    return np.array([s.high - s.low for s in signals])


def _signal(params: SignalParams | MvParams) -> Signal:
    return Signal(params.name, params.unit, params.low, params.high)


def _commanded(mv: MvParams, period_s: float) -> Signal:
    """The MV as laws command it: its range, and its largest change a period."""
    per_min = mv.max_move_per_min
    return Signal(mv.name, mv.unit, *mv.command, max_move=None if per_min is None else per_min * period_s / 60)
