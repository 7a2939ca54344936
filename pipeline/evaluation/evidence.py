"""All closed-loop figures of a case in one place."""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from loopwright.pipeline.errors import PipelineError, ReportError
from loopwright.pipeline.evaluation.case import Case, Curve
from loopwright.pipeline.evaluation.evidence_basis import Grounds
from loopwright.pipeline.evaluation.extrapolation import grounds_of
from loopwright.pipeline.evaluation.law_evidence import (
    BASE,
    Array,
    Form,
    LawEvidence,
    LawMetrics,
    Loop,
    arrays,
    without_noise,
)
from loopwright.pipeline.evaluation.metric import gate_ratio, ratio_to_bound
from loopwright.pipeline.evaluation.model_evidence import model_figure
from loopwright.pipeline.evaluation.typed_json import read_mapping
from loopwright.pipeline.evaluation.validation import RelativeTo
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario

Bounds = Mapping[str, Mapping[str, Mapping[str, float]]]
WITHHELD = "withheld.json"
"""In the place of a law's metrics.json: why it was not designed for the plant."""
# errors over the lowest one, up to which laws are as good: seeds of the data make as much of a difference
ALIKE_ERRORS = 1.01


class NotMeasuredError(PipelineError):
    """A figure that a check or a picture needs was not measured."""

    def __init__(self, words: str = "not measured") -> None:
        super().__init__(words)


@dataclass(frozen=True)
class Evidence:
    """The case, its bounds, and the measured figures of its laws and models.

    Without a named metric, a figure is in the case's metric, ``Case.metric``. ``model_folder`` = work/<case>/models
    holds the predictions of the model sets. ``own_data``: models are trained on a user's data, not on the case's
    experiments. ``withheld`` says of laws that do not suit the plant why.
    """

    case: Case
    bounds: Bounds
    laws: Mapping[str, LawEvidence]
    models: Mapping[str, Mapping[str, Any]]
    model_folder: Path = Path()
    own_data: bool = False
    withheld: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def load(
        cls,
        case: Case,
        bounds: Bounds,
        work: Path,
        timing: Path,
        laws: Collection[str] | None = None,
        models_of: Collection[str] | None = None,
        own_data: bool = False,
    ) -> Self:
        """The results in ``work`` = work/<case> for the named laws and model sets in their order (None: all).

        ``timing`` = timing/<case> holds the times of a step; a law without a file there was not timed.

        The names leave out old folders of laws and sets that params.yaml no longer lists.
        Raises ReportError if no law was validated, nor withheld: a report without laws still shows the model.
        """
        validation, models = work / "validation", work / "models"
        validated = sorted(p.parent.name for p in validation.glob("*/metrics.json"))
        names = validated if laws is None else [n for n in laws if n in validated]
        reasons = {p.parent.name: str(read_mapping(p)["why"]) for p in sorted(validation.glob(f"*/{WITHHELD}"))}
        withheld = {n: why for n, why in reasons.items() if laws is None or n in laws}
        if not names and not withheld:
            raise ReportError(f"{validation} holds no law's metrics.json; run `dvc repro`")
        evidence = {}
        for name in names:
            folder, took = validation / name, timing / f"{name}-step.json"
            metrics = LawMetrics.read(folder / "metrics.json")
            step_us = read_mapping(took).get("p50") if took.exists() else None
            evidence[name] = LawEvidence(metrics, folder / "trajectories.npz", step_us)
        sets = {p.parent.name: p for p in sorted(models.glob("*/metrics.json"))}
        model_sets = {n: read_mapping(p) for n, p in sets.items() if models_of is None or n in models_of}
        return cls(case, bounds, evidence, model_sets, models, own_data, withheld)

    @cached_property
    def grounds(self) -> Grounds | None:
        """The basis of tests on identified models; None for a case that is tested on its plant's equations."""
        return grounds_of(
            self.case,
            next(iter(self.models.values()), {}),
            {n: self.laws[n].metrics.reached for n in self.laws if not self._withheld(n)}
            or {n: m.metrics.reached for n, m in self.laws.items()},
        )

    @cached_property
    def tests(self) -> Mapping[str, tuple[Scenario, ...]]:
        """The case's tests, cached: each call of ``scenarios`` computes the steady states again."""
        return self.case.scenarios()

    @property
    def daily(self) -> tuple[str, ...]:
        """Tests that replay the plant's record."""
        return tuple(name for name, tests in self.tests.items() if tests[0].replayed)

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
        """All metrics of the validated laws, in their order."""
        tests = (test for law in self.laws.values() for test in law.metrics.forms[BASE].tests.values())
        return tuple(dict.fromkeys(name for test in tests for name in test.median))

    @property
    def main_test(self) -> str:
        """The test that weighs most in the gate."""
        weights = self.case.weights
        return max(weights, key=lambda name: weights[name])

    def late_from(self, scenario: str) -> int:
        """The first sample of the late figures, with noise or without; 0: the test has none."""
        tests = self.tests.get(scenario.removesuffix(NOISE_SUFFIX), ())
        return tests[0].late_from if tests else 0

    def late_s(self, scenario: str) -> float:
        """The same in seconds; 0 also where the case's metric has no late figure."""
        return self.late_from(scenario) * self.case.plant.period_s if self.case.criterion.late else 0.0

    @property
    def main_title(self) -> str:
        """Title of the test that weighs most."""
        return self.scenarios[self.main_test.removesuffix(NOISE_SUFFIX)]

    def figure(
        self,
        law: str,
        scenario: str,
        metric: str | None = None,
        setting: Mapping[str, Any] | None = None,
        how: str = "median",
    ) -> float | None:
        """One figure over the data seeds (median, min or max); None where it was not measured.

        Without a scenario, ``law`` names a model set and ``metric`` a path in its figures, or ``law``
        names a law and ``metric`` a figure of its analysis, which has a median only.
        """
        metric, form = metric or self.case.metric, self.form(Curve(law, setting or {}))
        if not scenario and (law not in self.laws or law in self.models):
            return model_figure(self.models.get(law, {}), metric, how)
        if form is None:
            return None
        if not scenario:
            return form.analysis.figures.get(metric) if form.analysis is not None and how == "median" else None
        rows: Mapping[str, float] = getattr(form.tests[scenario], how) if scenario in form.tests else {}
        return rows.get(metric)

    def measured(self, curve: Curve | str, scenario: str, metric: str | None = None) -> float:
        """The median ``figure`` of a form of a law, or of a model set; raises NotMeasuredError without one."""
        curve = Curve(curve) if isinstance(curve, str) else curve
        value = self.figure(curve.law, scenario, metric, curve.setting)
        if value is None:
            raise NotMeasuredError
        return value

    def form(self, curve: Curve) -> Form | None:
        """The form of a law behind a curve of a figure; None where it was not validated."""
        law = self.laws.get(curve.law)
        return None if law is None else law.form(curve.setting)

    def bound(self, scenario: str, metric: str | None = None, kind: str = "nmpc") -> float | None:
        """A bound's figure; None where none was computed."""
        value = self.bounds.get(scenario, {}).get(kind, {}).get(metric or self.case.metric)
        return None if value is None else float(value)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the controlled variable's measurement noise, in the unit of the laws' errors."""
        return self.case.noise_level

    @cached_property
    def floors(self) -> dict[str, float]:
        """For each scenario the error that noise can hide, in the case's metric."""
        floor = self.case.criterion.floor
        if floor is None:
            raise ReportError(f"case {self.case.name!r} is compared by {self.case.metric!r}, a metric without a floor")
        samples = {name: statistics.fmean(test.samples for test in tests) for name, tests in self.tests.items()}
        return {name: floor.error(self.noise, n) for name, n in samples.items()}

    def floor(self, scenario: str) -> float:
        """Error below which a loop of this test, with noise or without, is as good as perfect."""
        return self.floors[scenario.removesuffix(NOISE_SUFFIX)]

    def at_rest(self, scenario: str) -> float | None:
        """The error of a test with the MVs left where they stand; None where that was not measured."""
        known = (law.metrics.at_rest.get(scenario.removesuffix(NOISE_SUFFIX)) for law in self.laws.values())
        return next((error for error in known if error is not None), None)

    def ratio(self, law: str, scenario: str, kind: str = "nmpc") -> float | None:
        """Error of the law over that of the bound; None also where the bound lies below ``floor``."""
        own, bound = self.figure(law, scenario), self.bound(scenario, None, kind)
        return None if own is None or bound is None else ratio_to_bound(own, bound, self.floor(scenario))

    @property
    def simulated(self) -> bool:
        """Whether the tests run on a person's own simulator."""
        return self.case.on_models and self.case.stand_in == "simulator"

    def gate_ratio(self, law: str, scenario: str) -> float | None:
        """Error over ``reference``, both at least ``floor``; None where one of them was not measured."""
        own, other = self.figure(law, scenario), self.reference(scenario)
        return None if own is None or other is None else gate_ratio(own, other, self.floor(scenario))

    @property
    def relative_to(self) -> RelativeTo:
        """The reference of gate scores: on a simulator, which has no NMPC, the baseline, or else the noise."""
        if not self.simulated:
            return "nmpc"
        return "baseline" if self.case.baseline in self.laws else "floor"

    def reference(self, scenario: str) -> float | None:
        """The error that counts as 1 in the gate score."""
        if self.relative_to == "floor":
            return self.floor(scenario) or None
        return self.bound(scenario) if self.relative_to == "nmpc" else self.figure(self.case.baseline, scenario)

    @property
    def no_baseline(self) -> str:
        """Why an own plant has no baseline to beat, in words; empty where it has one, and for other cases."""
        name = self.case.baseline
        if not self.case.on_models:
            return ""
        if name not in self.laws:
            return self.withheld.get(name, f"params.yaml has no controller {name!r} for this plant")
        return f"it {self.laws[name].why_withheld}" if self._withheld(name) else ""

    def score(self, law: str) -> float | None:
        """Gate score: weighted mean of ``gate_ratio`` over the gate's scenarios; lower is better."""
        gate = self.case.weights
        ratios = {s: r for s in gate if (r := self.gate_ratio(law, s)) is not None}
        if not ratios or len(ratios) < len(gate):
            return None
        return sum(gate[s] * r for s, r in ratios.items()) / sum(gate.values())

    @cached_property
    def best(self) -> str | None:
        """The law with the lowest error on the development sequences; no scored test is used.

        Errors up to ``ALIKE_ERRORS`` times the lowest do not say which law is better: data seeds differ by as much. The
        best of such laws is the one whose MVs travel least there. A law that locked up on one of them, or that is not
        shipped, is left out. So is one that does not beat the loop that the plant was run by before, there, in each
        test and where the record is replayed. Where the tests run on models, a law that swings to the end in any of
        them without noise comes behind those that do not: its plant may be one of these models, and then it is worse
        than any figure says. This much of a say the scored tests have. Noise moves any loop, one that does not swing by
        itself too. Without development figures the gate score decides.
        """
        scores = self._calm
        alike = [n for n in scores if scores[n] <= ALIKE_ERRORS * min(scores.values())]
        return min(alike, key=lambda n: (self.laws[n].development_travel, scores[n]), default=None)

    @cached_property
    def _calm(self) -> dict[str, float]:
        """The candidates that swing in no test without noise; all of them where each does."""
        if not self.case.on_models:
            return self._candidates
        calm = {n: e for n, e in self._candidates.items() if not without_noise(self.laws[n].metrics.swings)}
        return calm or self._candidates

    @cached_property
    def _candidates(self) -> dict[str, float]:
        """The laws that may be the best, with their errors over the development sequences."""
        errors = {n: law.development for n, law in self.laws.items() if not self._withheld(n)}
        if all(error is None for error in errors.values()):
            errors = {n: self.score(n) for n, law in self.laws.items() if not (law.lock_ups or self._withheld(n))}
        scores = {n: e for n, e in errors.items() if e is not None}
        limit = scores.pop(self.case.old_loop, math.inf)
        return {n: e for n, e in scores.items() if e < limit and not self.worse_than_before(n)}

    def beside_before(self, law: str) -> dict[str, tuple[float, float]]:
        """Tests of the gate, and replays of the record -> errors of the law and of the old loop, where both are known.

        Errors that noise can hide count as equal to it. Empty where there is no old loop, or it got stuck.
        """
        if not self.old_loop or law == self.old_loop or self._withheld(self.old_loop):
            return {}
        tests = (*self.case.weights, *self.daily)
        figures = {test: (self.figure(law, test), self.figure(self.old_loop, test), self.floor(test)) for test in tests}
        return {
            test: (max(own, floor), max(old, floor))
            for test, (own, old, floor) in figures.items()
            if own is not None and old is not None
        }

    def worse_than_before(self, law: str) -> tuple[str, ...]:
        """The tests of ``beside_before`` in which the law has the larger error."""
        return tuple(test for test, (own, old) in self.beside_before(law).items() if own > old)

    @property
    def old_loop(self) -> str:
        """The law that the plant was run by before, with its figures here; empty where none is known."""
        return self.case.old_loop if self.case.old_loop in self.laws else ""

    def _withheld(self, law: str) -> bool:
        return self.case.on_models and self.laws[law].withheld

    def _beats_old_loop(self, errors: Mapping[str, float]) -> str:
        own, old = (f"{errors[law]:.3g} {self.case.unit}".rstrip() for law in (str(self.best), self.old_loop))
        return f"{self._development} is {own}, the old loop's {old}"

    @property
    def _development(self) -> str:
        """The figure ``LawEvidence.development``, in words."""
        of = "the geometric mean of " if self.case.development_geometric else ""
        return f"{of}its {self.case.criterion.short} over the development sequences"

    @property
    def why_best(self) -> str:
        """Why the best law is the best, in words; empty without one."""
        shown = {n: law for n, law in self.laws.items() if not self._withheld(n)}
        errors = {n: law.development for n, law in shown.items() if law.development is not None}
        if self.best is None:
            return ""
        if set(errors) - {self.best} == {self.old_loop}:
            return f"no other law of ours is shipped, and {self._beats_old_loop(errors)}"
        if set(errors) == {self.best}:
            return "no other law is shipped"
        if not errors:
            return "it has the lowest gate score of the laws that did not lock up"
        others = ", ".join(f"{n} {e:.4g}" for n, e in errors.items() if n != self.best)
        beside = f" (others: {others})" if others else ""
        lowest = errors[self.best] <= min(self._calm.values())
        place = (
            "is the lowest" if lowest else f"is within {ALIKE_ERRORS - 1:.0%} of the lowest, and its MVs travel least"
        )
        if behind := [n for n in self._candidates if n not in self._calm]:
            swinging = ", ".join(behind)
            place += f", of the laws that do not swing to the end on a model without noise (those that do: {swinging})"
        return f"{self._development}, which are not scored, {place}: " + (
            f"{errors[self.best]:.4g} {self.case.unit}".rstrip() + beside
        )

    def loop(self, curve: Curve, scenario: str) -> Loop | None:
        """The trajectory behind a curve of a figure; None where none was stored."""
        law = self.laws.get(curve.law)
        return None if law is None else law.loop(scenario, curve.setting)

    def info(self, curve: Curve, scenario: str, *names: str) -> tuple[Loop, dict[str, Array]]:
        """The trajectory behind a curve, and these columns of the controller's info, (n,) each; or NotMeasuredError."""
        loop, form = self.loop(curve, scenario), self.form(curve)
        if loop is None or form is None or "info" not in loop or not set(names) <= set(form.info):
            raise NotMeasuredError
        return loop, {name: loop["info"][:, form.info.index(name)] for name in names}

    def analysis_arrays(self, curve: Curve) -> Loop:
        """Arrays of a form's analysis by name; empty where none were kept."""
        law = self.laws.get(curve.law)
        return {} if law is None else law.analysis_arrays(curve.setting)

    def part(self, model_set: str, part: str) -> Mapping[str, Any]:
        """The figures of one part of a model set, medians over the data seeds; empty where there are none."""
        figures = (self.models.get(model_set, {}).get("parts") or {}).get(part) or {}
        return figures.get("median") or {}

    def predictions(self, model_set: str) -> Loop:
        """Arrays that the fit of a model set stored with its figures; empty if there are none."""
        return arrays(self.model_folder / model_set / "predictions.npz")
