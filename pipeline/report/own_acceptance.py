"""Requirements on the controllers of an own plant, laws on plants gone wrong, and reasons against a shipped one."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.cases.own_model import LATE, GoneWrong
from loopwright.pipeline.evaluation.closed_loop import UNREACHED_ERROR
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import ColdStart, lock_up_text
from loopwright.pipeline.evaluation.metric import NO_UNIT
from loopwright.pipeline.evaluation.model_evidence import IDENTIFIED
from loopwright.pipeline.evaluation.open_loop import COLD_STEPS
from loopwright.pipeline.evaluation.poor_laws import COLD_NEAR, rest_words, worst_cycle
from loopwright.pipeline.evaluation.proof import known_rows, statements
from loopwright.pipeline.evaluation.validation import CheckedStatement
from loopwright.pipeline.historian.settling import in_words
from loopwright.pipeline.historian.step_test import ALONE, HOLD_SETTLINGS, LARGEST_AMPLITUDE, RANDOM_MOVES
from loopwright.pipeline.pictures.drawing import axis_label
from loopwright.pipeline.pictures.numbers import number, times
from loopwright.pipeline.pictures.words import law_name, scenario_name
from loopwright.pipeline.report.identified_model import say_dead_times
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX


@dataclass(frozen=True, slots=True)
class Worse:
    """A test in which a law's error is above the limit that the baseline's sets."""

    test: str
    own: float  # in the case's metric
    limit: float

    @property
    def factor(self) -> float:
        """How many times the limit the error is; infinite where nothing may be missed."""
        return self.own / self.limit if self.limit > 0 else float("inf")


def limit_of(evidence: Evidence, test: str) -> float | None:
    """The baseline's error in a test, at least what noise can hide; None where there is no baseline to beat."""
    case = evidence.case
    if case.baseline not in evidence.laws or evidence.no_baseline:
        return None
    other = evidence.figure(case.baseline, test)
    return None if other is None else max(other, evidence.floor(test))


def worse_tests(evidence: Evidence, law: str) -> list[Worse]:
    """Tests of the gate in which an own plant's law is worse than its baseline, the worst first."""
    if not evidence.case.on_models or law == evidence.case.baseline:
        return []
    found = []
    for test in (*evidence.case.weights, *evidence.daily):
        own, limit = evidence.figure(law, test), limit_of(evidence, test)
        if own is not None and limit is not None and own > limit:
            found.append(Worse(test, own, limit))
    return sorted(found, key=lambda one: -one.factor)


def shipped_laws(evidence: Evidence) -> list[str]:
    """Laws whose file is shipped."""
    laws = {n: law for n, law in evidence.laws.items() if n != evidence.old_loop}
    return [n for n, law in laws.items() if not (evidence.case.on_models and law.withheld)]


def worst_test(evidence: Evidence, law: str) -> str | None:
    """The test whose picture says most against an own plant's law: where it is worst, or swings; None without one.

    A limit cycle has a picture of its own.
    """
    if not evidence.case.on_models:
        return None
    worse = worse_tests(evidence, law)
    swinging = [t for t in evidence.laws[law].metrics.swings if t.removesuffix(NOISE_SUFFIX) in evidence.tests]
    if worse or evidence.laws[law].metrics.cycles:
        return worse[0].test if worse else None
    return next(iter(swinging), None)


def against(evidence: Evidence) -> list[dict[str, str]]:
    """A row for each shipped law that something speaks against: its name, and clauses."""
    rows, case = [], evidence.case
    for law in shipped_laws(evidence):
        clauses = []
        if worse := worse_tests(evidence, law):
            each = ", ".join(_words(evidence, law, one) for one in worse)
            clauses.append(f"has a higher {case.criterion.short} than the {law_name(case.baseline)} in {each}")
        if swings := evidence.laws[law].metrics.swings:
            worst = worst_cycle(evidence, law)
            most = f": at worst {evidence.laws[law].metrics.cycles[worst].words} in {worst}" if worst else ""
            clauses.append(f"swings to the end in {lock_up_text(swings)}{most}")
        if why := evidence.laws[law].metrics.calmed:
            clauses.append(f"has calmer numbers than its tuning found, with which it {why}")
        if clauses:
            rows.append({"law": law, "words": "; it ".join(clauses)})
    return rows


def beyond_reach(evidence: Evidence) -> list[str]:
    """A sentence for each shipped law that had holds whose set point nothing gets to, which are no lock-ups."""
    found = {law: evidence.laws[law].metrics.beyond_reach for law in shipped_laws(evidence)}
    return [
        f"Holds of {law} at an end of the MVs count as no lock-up in {lock_up_text(tests)}: "
        "no control gets to their set point in time, or none that keeps the ranges."
        for law, tests in found.items()
        if tests
    ]


def _words(evidence: Evidence, law: str, one: Worse) -> str:
    unit = f" {evidence.case.unit}".rstrip()
    remedy = _remedy(evidence, law, one.test)
    return f"{one.test} (× {one.factor:.3g}: {number(one.own)}{unit} against {number(one.limit)}{unit}{remedy})"


def _remedy(evidence: Evidence, law: str, test: str) -> str:
    """The remedy for a law in a test on plants gone wrong, after a semicolon; empty where none is known."""
    wrong = test.removesuffix(NOISE_SUFFIX) in evidence.case.gone_wrong
    words = dead_time_to_state(evidence, law) if wrong else ""
    return f"; {words}" if words else ""


UNMEASURED = "not measured"


def own_acceptance(evidence: Evidence) -> list[CheckedStatement]:
    """The record proves the model, no law locks up, and each begins at a rest of the record with its MV.

    The best one settles, overshoots little on each kind of plant, stays in range, bears noise and beats the PID.
    Every limit is a figure of the evidence, or the one by which a lock-up is told; its row says why.
    """
    on_models = evidence.case.stand_in == IDENTIFIED  # a simulator tells a wrong model itself
    proof = (*(statements(evidence.models) if on_models else ()), *known_rows(evidence.models))
    rows = [*proof, *(_lock_ups(n, evidence) for n in evidence.laws), *_cold_starts(evidence)]
    if evidence.best is None:
        return rows
    rows += [
        _settles(evidence, evidence.best),
        *_overshoots(evidence, evidence.best),
        _in_range(evidence, evidence.best),
    ]
    if noise := _bears_noise(evidence, evidence.best):
        rows.append(noise)
    baseline = evidence.case.baseline
    if evidence.best != baseline and baseline in evidence.laws and not evidence.no_baseline:
        rows += [*_beside(evidence, evidence.best, baseline), _score(evidence, evidence.best, baseline)]
    return rows


def step_test_to_run(evidence: Evidence) -> str:
    """The remedy where laws were tested and none is shipped: the step test for a better model; else empty.

    It is the one that `loopwright new` listed, where it doubted the record. Laws that were not designed, because the
    record does not prove the model, have it among their reasons.
    """
    case = evidence.case
    if case.settling_s is None or not evidence.laws or shipped_laws(evidence):
        return ""
    old = "Keep the old loop until then. " if evidence.old_loop else ""
    rows = f"Give its rows with the old ones: loopwright new {case.name} OLD NEW --replace."
    if evidence.grounds is not None and evidence.grounds.doubt:
        return f"{old}A step test gives a better model: run that of step_test.csv, which `loopwright new` wrote. {rows}"
    units = {s.name: "" if s.unit in NO_UNIT else f" {s.unit.replace('deg', '°')}" for s in case.record_signals.mv}
    steps = [
        f"{s.name} by {number(LARGEST_AMPLITUDE * (s.high - s.low))}{units[s.name]}" for s in case.record_signals.mv
    ]
    alone, least, most = (share * case.settling_s for share in (ALONE, min(HOLD_SETTLINGS), max(HOLD_SETTLINGS)))
    whole = 3 * len(steps) * alone + RANDOM_MOVES * sum(HOLD_SETTLINGS) / len(HOLD_SETTLINGS) * case.settling_s
    each, them = (", each alone", "all of them") if steps[1:] else ("", "it")
    return (
        f"{old}A step test gives a better model: move in manual {', '.join(steps)} to each side, or as much more as "
        f"the plant bears{each}: up, down and back, each held for {in_words(alone)}. Then move {them} {RANDOM_MOVES} "
        f"times at random within that, held for {in_words(least)} to {in_words(most)}; {in_words(whole)} in all. {rows}"
    )


def _lock_ups(name: str, evidence: Evidence) -> CheckedStatement:
    law = evidence.laws[name]
    where = lock_up_text(law.metrics.locked_up)
    return CheckedStatement(f"{name}, lock-ups over all tests", "0", str(law.lock_ups), law.lock_ups == 0, where)


def _cold_starts(evidence: Evidence) -> Iterator[CheckedStatement]:
    """A cold start at a rest of the record asks for its MV: a row for each law of ours, none without such a rest."""
    for name, law in evidence.laws.items():
        found = law.metrics.cold_start
        if found is None or not found.rests or name == evidence.old_loop:
            continue
        yield CheckedStatement(
            f"{name}, cold start at a rest of the record asks for its MV: largest distance",
            f"≤ {COLD_NEAR:g} % of the MV's range",
            _cold_words(found),
            not found.refused and (found.farthest or 0.0) <= COLD_NEAR,
            f"farthest at {rest_words(found)}" if found.at else "",
        )


COLD_DIGITS = 3  # decimal places of a distance in %: the rest is rounding of the file


def _cold_words(found: ColdStart) -> str:
    refused = f"refused at {found.refused} of {found.rests} rests"
    if found.first is None or found.later is None:
        return refused
    first, later, quarter = (
        f"{round(of or 0.0, COLD_DIGITS):.2g} %" for of in (found.first, found.later, found.quarter)
    )
    words = f"{first} at the first of {COLD_STEPS} steps, {later} later; {quarter} at most at a quarter of the "
    words += f"{found.rests} rests"
    return f"{words}; {refused}" if found.refused else words


def cold_starts(evidence: Evidence) -> list[str]:
    """A sentence on each law of ours: what it asks for where it is started cold at rests of the record."""
    starts = {n: law.metrics.cold_start for n, law in evidence.laws.items() if n != evidence.old_loop}
    known = {name: of for name, of in starts.items() if of is not None}
    if known and not any(of.rests for of in known.values()):
        return [
            "No law could be started cold at a rest of the record: MVs and measured disturbances never stay until the "
            "process variables have settled, an MV has a few allowed values, or all rests lie outside of the ranges of "
            "set points and MVs."
        ]
    return [
        f"{name} was started cold at rests of the record, with the record's MVs applied. The largest distance of an MV "
        f"that it asks for from the record's is, in shares of its range: {_cold_words(of)}."
        for name, of in known.items()
        if of.rests
    ]


def _settles(evidence: Evidence, law: str) -> CheckedStatement:
    """The largest error at the end of a hold, in the test where it is largest."""
    cvs, asked = evidence.case.plant_class.sp_signals, evidence.case.asked
    # Of several CVs it is the largest in % of ranges: whose it is, is not kept, so the one counts that is moved least.
    limit = UNREACHED_ERROR * float(asked[0] if len(cvs) == 1 else np.min(100 * asked / [s.high - s.low for s in cvs]))
    found = {name: evidence.figure(law, name, "max_asse") for name in evidence.scenarios if name not in evidence.daily}
    ends = {name: value for name, value in found.items() if value is not None}
    worst = max(ends, key=lambda name: ends[name], default=None)
    return CheckedStatement(
        f"{law}, largest error at the end of a set point or a disturbance, tests without noise",
        f"≤ {_with_unit(evidence, limit)}",
        UNMEASURED if worst is None else f"{_with_unit(evidence, ends[worst])} in test {worst}",
        None if worst is None else ends[worst] <= limit,
        f"{100 * UNREACHED_ERROR:g} % of what set points go from one to another: a loop with more has not reached them",
    )


MOST_OVERSHOOT = 0.25  # of a step, where the plant is not quite the model: from there on operators take a loop off


def _overshoots(evidence: Evidence, law: str) -> Iterator[CheckedStatement]:
    """The mean overshoot of set-point steps, in the test where it is largest; none where it was not measured."""
    names = [name for name in evidence.scenarios if name not in evidence.daily]
    known = {name: over for name in names if (over := evidence.figure(law, name, "overshoot")) is not None}
    if not known:
        return
    worst = max(known, key=lambda name: known[name])
    bold = known[worst] > MOST_OVERSHOOT
    yield CheckedStatement(
        f"{law}, mean overshoot of set-point steps, tests without noise, models gone wrong too",
        f"≤ {100 * MOST_OVERSHOOT:.0f} % of the step",
        f"{100 * known[worst]:.2g} % in test {worst}",
        not bold,
        "a smaller speed of the law, or a largest move of its MV, makes it calmer" if bold else "",
    )


def _in_range(evidence: Evidence, law: str) -> CheckedStatement:
    """Where each PV went, beside its range."""
    pvs, reached = evidence.case.plant_class.pv_signals, evidence.laws[law].metrics.reached
    known = [(s, *reached[s.name]) for s in pvs if s.name in reached]

    def words(name: str, unit: str, low: float, high: float) -> str:
        return axis_label(f"{name} {number(low, 4)} … {number(high, 4)}", unit)

    return CheckedStatement(
        f"{law}, lowest and highest process variable, tests without noise, models gone wrong apart",
        "within " + ", ".join(words(s.name, s.unit, s.low, s.high) for s in pvs),
        ", ".join(words(s.name, s.unit, low, high) for s, low, high in known) or UNMEASURED,
        all(s.low <= low and high <= s.high for s, low, high in known) if known else None,
        "the range of each variable in params.yaml, often that of its transmitter: no limit of operation",
    )


def _bears_noise(evidence: Evidence, law: str) -> CheckedStatement | None:
    """The main test with noise; None where it has none."""
    test = evidence.main_test.removesuffix(NOISE_SUFFIX)
    quiet, noisy = (evidence.figure(law, name) for name in (test, test + NOISE_SUFFIX))
    if quiet is None or noisy is None:
        return None
    floor = evidence.floor(test)
    limit = quiet + floor
    return CheckedStatement(
        _what(evidence, law, test + NOISE_SUFFIX),
        f"{evidence.case.criterion.short} ≤ {number(quiet)} + {number(floor)} = {_with_unit(evidence, limit)}",
        _with_unit(evidence, noisy),
        noisy <= limit,
        "without noise it is the first figure, and the second is the noise: more would be noise that the law amplifies",
    )


def _beside(evidence: Evidence, law: str, baseline: str) -> Iterator[CheckedStatement]:
    """No worse than the baseline in each test of the gate."""
    for test in (*evidence.case.weights, *evidence.daily):
        own, other, floor = evidence.figure(law, test), evidence.figure(baseline, test), evidence.floor(test)
        limit = limit_of(evidence, test)
        if own is None or other is None or limit is None:
            continue
        pid, least = law_name(baseline), _with_unit(evidence, floor)
        hidden = f"the {pid} has {_with_unit(evidence, other)}; errors that noise can hide, up to {least}, are equal"
        yield CheckedStatement(
            f"{_what(evidence, law, test)}, beside the {pid}",
            f"{evidence.case.criterion.short} ≤ {_with_unit(evidence, limit)}",
            _with_unit(evidence, own),
            own <= limit,
            hidden if other < floor else "" if own <= limit else _remedy(evidence, law, test).removeprefix("; "),
        )


def _score(evidence: Evidence, law: str, baseline: str) -> CheckedStatement:
    """The gate score beside the baseline's: the errors over the bound's, where there is a bound."""
    own, other = evidence.score(law), evidence.score(baseline)
    known = own is not None and other is not None
    bound = {"nmpc": "the perfect-model NMPC's", "baseline": f"the {law_name(baseline)}'s"}
    return CheckedStatement(
        f"{law}, error over {bound.get(evidence.relative_to, 'what noise can hide')}, all tests by their weights",
        UNMEASURED if other is None else f"≤ {times(other)}, the {law_name(baseline)}'s",
        UNMEASURED if own is None else times(own),
        own <= other if known else None,  # type: ignore[operator]
        "the gate score, by which the registry's champion must beat the baseline",
    )


def _what(evidence: Evidence, law: str, test: str) -> str:
    return f"{law}, {scenario_name(test, evidence.case.recipe, evidence.case.test_words)}"


def _with_unit(evidence: Evidence, value: float) -> str:
    return f"{number(value)} {evidence.case.unit}".rstrip()


# -------------------------------------------------------------------------------- laws on each kind of plant gone wrong
# Growth of a law's error on the late plants over that on the worst others, from which on the dead time is to blame. On
# one kind the growth differed by a tenth between the sequences of examples/own_plant: half as much again is no chance.
LATE_ALONE_FACTOR = 1.5


@dataclass(frozen=True, slots=True)
class WrongRow:
    """A kind of plant gone wrong, in words, and each law's mean error on it, in the case's metric.

    ``grown``: how many times the law's error on the same sequences of the models as they are, where both are known.
    """

    test: str
    kind: str
    words: str
    errors: Mapping[str, float]
    grown: Mapping[str, float]


def wrong_rows(evidence: Evidence) -> list[WrongRow]:
    """A row for each kind of plant gone wrong; none where its laws have no figures of single sequences."""
    rows = []
    for name in evidence.case.gone_wrong:
        tests = evidence.tests.get(name, ())
        for kind in dict.fromkeys(test.kind for test in tests if test.kind):
            those = [test for test in tests if test.kind == kind]
            seeds = [str(test.seed) for test in those]
            errors = {law: error for law in evidence.laws if (error := _mean(evidence, law, name, seeds)) is not None}
            before = {law: _mean(evidence, law, "held_out", seeds) for law in errors}
            grown = {law: error / own for law, error in errors.items() if (own := before[law])}
            words = " or ".join(dict.fromkeys(str(GoneWrong.on(test)) for test in those))
            if errors:
                rows.append(WrongRow(name, kind, words, errors, grown))
    return rows


def _mean(evidence: Evidence, law: str, test: str, seeds: list[str]) -> float | None:
    """A law's mean error over sequences of a test; None where one of them has none."""
    found = evidence.laws[law].metrics.sequences.get(test, {})
    errors = [found.get(seed, {}).get(evidence.case.metric) for seed in seeds]
    known = [float(error) for error in errors if error is not None]
    return statistics.fmean(known) if known and len(known) == len(errors) else None


def late_factor(evidence: Evidence, law: str) -> float | None:
    """How many times as much a law's error grows on the late plants as on the worst others; None where one is unknown.

    The record leaves the dead time open where there are late plants at all.
    """
    grown = {row.kind: row.grown[law] for row in wrong_rows(evidence) if law in row.grown}
    late, others = grown.pop(LATE, None), max(grown.values(), default=None)
    return late / others if late is not None and others else None


def dead_time_to_state(evidence: Evidence, law: str) -> str:
    """The remedy for a law whose error the dead time alone makes, which the record leaves open; empty for any other."""
    factor = late_factor(evidence, law)
    if factor is None or factor < LATE_ALONE_FACTOR:
        return ""
    return f"the dead time alone makes {law}'s error here, and the record leaves it open: {say_dead_times(evidence)}"
