"""The laws of a case, read from its validation.json, for the overview and the terminal."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from loopwright.pipeline.evaluation.evidence_basis import Grounds
from loopwright.pipeline.evaluation.law_evidence import lock_up_text
from loopwright.pipeline.evaluation.metric import TRAVEL, gate_ratio, ratio_to_bound
from loopwright.pipeline.evaluation.operated import words_of
from loopwright.pipeline.evaluation.validation import FILE, CheckedStatement, Validation
from loopwright.pipeline.files import read_json
from loopwright.pipeline.simulation import NOISE_SUFFIX


@dataclass(frozen=True, slots=True)
class LawStanding:
    """One law on the test that weighs most in its case, in the case's metric."""

    law: str
    title: str
    best: bool  # of its case, by the development sequences
    figure: float | None  # median over the data seeds
    low: float | None
    high: float | None
    seeds: int | None
    lock_ups: int | None
    ratio: float | None  # ``CaseStanding.times``, or to the noise floor if the bound is less: ``CaseStanding.hidden``
    step_us: float | None
    bytes: int | None  # size of the controller file
    travel: float | None = None  # of the MVs on ``CaseStanding.travel_test``
    swings: str = ""  # the tests in which a closed loop swings to the end
    operated: str = ""  # the worst of its tests in which operators change more than set points


@dataclass(frozen=True, slots=True)
class CaseStanding:
    """A case: its laws, the best figure first, and the verdicts about its paper."""

    case: str
    folder: Path
    title: str
    metric: str  # as it stands in a table
    metric_long: str
    unit: str  # of the metric
    test: str
    test_title: str
    bound: float | None  # of the perfect-model NMPC
    hidden: bool  # the bound is below the noise floor, which replaces it in the ratios
    laws: tuple[LawStanding, ...]
    requirements: tuple[CheckedStatement, ...]
    claims: tuple[CheckedStatement, ...]
    reproduced: tuple[int, int]  # figures of the paper's tables: number reproduced, number measured
    grounds: Grounds | None = None  # what tests on models of the plant's record rest on
    times: str = "× NMPC"  # what ratios are to
    travel: str = ""  # of the MVs, words and unit; empty where its unit is not known
    travel_test: str = ""  # the main test, with noise where it has any: a valve sees it, and it tells bold laws apart
    travel_bound: float | None = None  # of the perfect-model NMPC
    old_loop: str = ""  # the law that the plant was run by before
    over_old_loop: Mapping[str, float] = field(default_factory=dict)  # test -> 1 - best law's figure / old loop's

    @classmethod
    def read(cls, folder: Path) -> Self:
        """The standing in ``folder``/validation.json; sizes are those of the controller files beside it.

        Raises PipelineError where it cannot be read.
        """
        return cls.of(Validation.read(folder / FILE), folder)

    @classmethod
    def of(cls, validation: Validation, folder: Path) -> Self:
        """The standing in a validation, whose controller files lie in ``folder``."""
        test = validation.main
        bare = test.removesuffix(NOISE_SUFFIX)
        bound, floor = validation.bound(test), validation.floor(bare)
        laws = [_law(validation, law, folder) for law in validation.laws]
        judged = [row.holds for row in validation.paper if row.holds is not None]
        return cls(
            case=validation.case,
            folder=folder,
            title=validation.titles.case,
            metric=validation.titles.metric_short,
            metric_long=validation.titles.metric,
            unit=validation.titles.unit,
            test=test,
            test_title=validation.titles.scenarios.get(bare, bare) + (" with noise" if test != bare else ""),
            bound=bound,
            hidden=bound is not None and bound < floor,
            laws=tuple(sorted(laws, key=lambda law: math.inf if law.figure is None else law.figure)),
            requirements=validation.requirements,
            claims=validation.claims,
            reproduced=(sum(judged), len(judged)),
            grounds=validation.grounds,
            times=validation.gate.times,
            travel=validation.travel_words,
            travel_test=_travel_test(validation),
            travel_bound=validation.bounds.get(_travel_test(validation), {}).get("nmpc", {}).get(TRAVEL),
            old_loop=validation.old_loop,
            over_old_loop=_over_old_loop(validation),
        )

    @property
    def best(self) -> LawStanding | None:
        """The best law of the case."""
        return next((law for law in self.laws if law.best), None)


def withheld_in(folder: Path) -> dict[str, str]:
    """Law -> why its newest validation ships nothing, of those in ``folder`` = artifacts/<case>."""
    reasons = {p.stem: read_json(p).get("withheld") for p in sorted(folder.glob("*.json")) if p.name != FILE}
    return {law: str(why) for law, why in reasons.items() if why}


def because(why: str, *, several: bool = False) -> str:
    """A stored reason as the end of a sentence, ``because ...``: without the law's name, which stands before it.

    ``several`` laws share it.
    """
    words = re.sub(r"^law '[^']+' is withheld: ", "", why)
    words = re.sub(r"^controllers\.\S+ (.*?), so nothing is shipped", f"{'each' if several else 'it'} \\1", words)
    return f"because {words.rstrip('. ')}."


def by_reason(withheld: Mapping[str, str]) -> dict[str, str]:
    """Laws that share a reason, ``a, b``, -> the reason as the end of a sentence, as ``because`` has it."""
    laws: dict[str, list[str]] = {}
    for law, why in withheld.items():
        laws.setdefault(because(why), []).append(law)
    return {", ".join(names): because(withheld[names[0]], several=len(names) > 1) for names in laws.values()}


def tally(rows: tuple[CheckedStatement, ...]) -> tuple[int, int]:
    """How many hold, of those that were measured."""
    verdicts = [row.holds for row in rows if row.holds is not None]
    return sum(verdicts), len(verdicts)


def _over_old_loop(validation: Validation) -> dict[str, float]:
    """Test without noise -> share by which the best law's figure is below the old loop's, of tests that have both."""
    shares = {}
    for test, rows in validation.scenarios.items():
        own, old = (rows.get(law or "", {}).get(validation.metric) for law in (validation.best, validation.old_loop))
        if own is not None and old and not test.endswith(NOISE_SUFFIX):
            shares[test] = 1 - own / old
    return shares


def _ratio(validation: Validation, own: float | None) -> float | None:
    """An error on the main test over what the gate divides by; None where one of them is missing."""
    test, gate = validation.main, validation.gate
    bound, floor = validation.bound(test), validation.floor(test.removesuffix(NOISE_SUFFIX))
    if gate.relative_to != "nmpc":
        baseline = validation.scenarios.get(test, {}).get(gate.baseline, {}).get(validation.metric)
        other = baseline if gate.relative_to == "baseline" else floor or None
        return None if own is None or other is None else gate_ratio(own, other, floor)
    if own is None or bound is None:
        return None
    # A bound below the noise floor: the ratio to the floor, at least 1.
    return gate_ratio(own, bound, floor) if bound < floor else ratio_to_bound(own, bound, floor)


def _travel_test(validation: Validation) -> str:
    """The main test with noise; as it is where it has none."""
    noisy = validation.main.removesuffix(NOISE_SUFFIX) + NOISE_SUFFIX
    return noisy if noisy in validation.scenarios else validation.main


def _law(validation: Validation, law: str, folder: Path) -> LawStanding:
    test, metric, result = validation.main, validation.metric, validation.laws[law]
    row = validation.scenarios.get(test, {}).get(law, {})
    file = folder / f"{law}.onnx"
    return LawStanding(
        law=law,
        title=validation.titles.laws.get(law, law),
        best=law == validation.best,
        figure=row.get(metric),
        low=row.get(f"{metric}_min"),
        high=row.get(f"{metric}_max"),
        seeds=result.seeds,
        lock_ups=result.lock_ups,
        ratio=_ratio(validation, row.get(metric)),
        step_us=result.step_us,
        bytes=file.stat().st_size if file.exists() else None,
        travel=validation.scenarios.get(_travel_test(validation), {}).get(law, {}).get(TRAVEL)
        if validation.travel_words
        else None,
        swings=lock_up_text(result.swings),
        operated=words_of(result.operated),
    )
