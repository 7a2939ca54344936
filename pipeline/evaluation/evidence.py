"""All closed-loop figures of a case in one place, and how to ask for one."""

from __future__ import annotations

import statistics
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from pipeline.evaluation.case import Case, Curve
from pipeline.evaluation.law_evidence import LawEvidence, Loop, ReportError, read_metrics
from pipeline.evaluation.model_evidence import model_figure
from pipeline.pictures.words import scenario_name
from pipeline.simulation.scenario import NOISE_SUFFIX, Scenario

Bounds = Mapping[str, Mapping[str, Mapping[str, float]]]


@dataclass(frozen=True)
class Evidence:
    """The case, its bounds, and what the stages measured of its laws and models.

    Where no metric is named, a figure is in the case's own, ``Case.metric``.
    """

    case: Case
    bounds: Bounds
    laws: Mapping[str, LawEvidence]
    models: Mapping[str, Mapping[str, Any]]
    own_data: bool = False  # models were learnt from a person's data, not from the case's experiments

    @classmethod
    def load(
        cls,
        case: Case,
        bounds: Bounds,
        work: Path,
        laws: Collection[str] | None = None,
        models_of: Collection[str] | None = None,
        own_data: bool = False,
        timing: Path | None = None,
    ) -> Self:
        """What lies under ``work`` = work/<case>, of the named laws and model sets in their order (None: all).

        ``timing`` = timing/<case> holds the times of a step; a law without a file there was not timed.

        A law or set that params.yaml no longer lists leaves its folder behind; it is no evidence any more.
        Raises ReportError where no law was validated.
        """
        validation, models = work / "validation", work / "models"
        names = sorted(p.parent.name for p in validation.glob("*/metrics.json"))
        if laws is not None:
            names = [n for n in laws if n in names]
        if not names:
            raise ReportError(f"{validation} holds no law's metrics.json; run `dvc repro`")
        return cls(
            case,
            bounds,
            {
                n: LawEvidence(
                    n,
                    read_metrics(validation / n / "metrics.json"),
                    validation / n / "trajectories.npz",
                    {} if timing is None else _step_time(timing / f"{n}-step.json"),
                )
                for n in names
            },
            {
                p.parent.name: read_metrics(p)
                for p in sorted(models.glob("*/metrics.json"))
                if models_of is None or p.parent.name in models_of
            },
            own_data,
        )

    @cached_property
    def tests(self) -> Mapping[str, tuple[Scenario, ...]]:
        """The case's tests; it makes them anew each time it is asked, steady states and all."""
        return self.case.scenarios()

    @cached_property
    def scenarios(self) -> dict[str, str]:
        """Title of each scenario, without those with noise."""
        return {name: self._title(tests) for name, tests in self.tests.items()}

    def _title(self, tests: tuple[Scenario, ...]) -> str:
        titles = {test.title for test in tests}
        if len(tests) == 1:
            return titles.pop()
        if len(titles) == 1:  # one test, repeated with other random numbers
            return f"{titles.pop()}, {len(tests)} draws"
        return f"{len(tests)} {'held-out recipes' if self.case.recipe else 'held-out sequences of random set points'}"

    @cached_property
    def metrics(self) -> tuple[str, ...]:
        """Every metric that validate gave of some law, in its order."""
        found: dict[str, None] = {}
        for law in self.laws.values():
            for block in law.metrics["scenarios"].values():
                found.update(dict.fromkeys(block["median"]))
        return tuple(found)

    @property
    def main_test(self) -> str:
        """The test that weighs most in the gate."""
        return max(self.case.gate, key=lambda name: self.case.gate[name])

    def late_from(self, scenario: str) -> int:
        """The sample from which the test, with noise or without, is scored a second time; 0: it is not."""
        tests = self.tests.get(scenario.removesuffix(NOISE_SUFFIX), ())
        return tests[0].late_from if tests else 0

    def late_s(self, scenario: str) -> float:
        """The same in seconds."""
        return self.late_from(scenario) * self.case.plant.period_s

    @property
    def main_title(self) -> str:
        """Title of the test that weighs most."""
        return self.scenarios[self.main_test.removesuffix(NOISE_SUFFIX)]

    @property
    def main_words(self) -> tuple[str, str]:
        """What a picture of the main test shows, and what the test is to somebody who doubts a tuning."""
        name, recipe = self.main_test, self.case.recipe
        if len(self.tests[name.removesuffix(NOISE_SUFFIX)]) == 1:
            return (scenario_name(name, recipe, self.case.test_words),) * 2
        if recipe:
            return "a held-out recipe", "recipes that nothing was tuned on"
        return "a held-out sequence", "set points that nothing was tuned on"

    def figure(
        self,
        law: str,
        scenario: str,
        metric: str | None = None,
        setting: Mapping[str, Any] | None = None,
        how: str = "median",
    ) -> float | None:
        """One figure over the data seeds (median, min or max); None where it was not measured.

        Without a scenario ``law`` names a model set and ``metric`` a path of its figures, or a law
        and a figure of its analysis, which is one and has no range.
        """
        metric = metric or self.case.metric
        if not scenario and law in self.laws and law not in self.models:
            said = (self.laws[law].analysis(setting or {}).get("figures") or {}).get(metric)
            return None if said is None or how != "median" else float(said)
        if not scenario:
            return model_figure(self.models.get(law, {}), metric, how)
        if law not in self.laws:
            return None
        block = self.laws[law].block(scenario, setting or {})
        value = ((block or {}).get(how) or {}).get(metric)
        return None if value is None else float(value)

    def bound(self, scenario: str, metric: str | None = None, kind: str = "nmpc") -> float | None:
        """A bound's figure; None where none was computed."""
        value = self.bounds.get(scenario, {}).get(kind, {}).get(metric or self.case.metric)
        return None if value is None else float(value)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the controlled variable's measurement noise."""
        return float(self.case.noise[self.case.plant_class.sp_signals[0].name])

    @cached_property
    def floors(self) -> dict[str, float]:
        """Of each scenario the error that noise would hide: its deviation, or its variance times the samples.

        An NMPC that is told of a disturbance before it acts leaves an error of 1e-11: no yardstick.
        Nor is one that can stay on its reference throughout, and there good loops stay well within
        the noise. What n noisy samples still tell apart is then the yardstick, s (2/n)^(1/4): an
        error whose square is the deviation of their mean square.
        """
        if self.case.metric == "mae":
            return dict.fromkeys(self.scenarios, self.noise)
        samples = {name: statistics.fmean(test.samples for test in tests) for name, tests in self.tests.items()}
        if self.case.metric == "tracking":
            return {name: self.noise * (2 / n) ** 0.25 for name, n in samples.items()}
        return {name: self.noise**2 * n for name, n in samples.items()}

    def floor(self, scenario: str) -> float:
        """Error below which a loop of this test, with noise or without, is as good as perfect."""
        return self.floors[scenario.removesuffix(NOISE_SUFFIX)]

    def ratio(self, law: str, scenario: str, kind: str = "nmpc") -> float | None:
        """Error of the law over that of the bound; None also where the bound lies below ``floor``."""
        own, bound = self.figure(law, scenario), self.bound(scenario, None, kind)
        return None if own is None or bound is None or bound < self.floor(scenario) else own / bound

    def gate_ratio(self, law: str, scenario: str) -> float | None:
        """Error over the NMPC's, both at least ``floor``: 1 is the bound, or an error that noise would hide."""
        own, bound, floor = self.figure(law, scenario), self.bound(scenario), self.floor(scenario)
        return None if own is None or bound is None else max(own, floor) / max(bound, floor)

    def score(self, law: str) -> float | None:
        """Gate score: weighted mean of ``gate_ratio`` over the gate's scenarios; lower is better, 1 the bound."""
        ratios = {s: self.gate_ratio(law, s) for s in self.case.gate}
        known = {s: r for s, r in ratios.items() if r is not None}
        if not known or len(known) < len(ratios):
            return None
        return sum(self.case.gate[s] * r for s, r in known.items()) / sum(self.case.gate.values())

    @cached_property
    def best(self) -> str | None:
        """The law with the lowest error over the development sequences, no scored test asked.

        A law that locked up on one of them is out. Where no development was measured: by the gate score.
        """
        errors = {n: law.development for n, law in self.laws.items()}
        if all(error is None for error in errors.values()):
            errors = {n: self.score(n) for n, law in self.laws.items() if law.lock_ups == 0}
        known = {n: e for n, e in errors.items() if e is not None}
        return min(known, key=lambda n: known[n], default=None)

    def loop(self, curve: Curve, scenario: str, hold: int | None = None) -> Loop | None:
        """The trajectory behind a curve of a figure; None where none was stored."""
        law = self.laws.get(curve.law)
        return None if law is None else law.loop(scenario + (f"_hold{hold}" if hold else ""), curve.setting)


def _step_time(path: Path) -> dict[str, float]:
    return {key: float(value) for key, value in read_metrics(path).items()} if path.exists() else {}
