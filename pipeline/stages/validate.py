"""Stage validate: the exported files in closed loop, and the best of them shipped with its evidence."""

from __future__ import annotations

import shutil
import statistics
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.cases.operated_trials import try_operated
from loopwright.pipeline.config.params import (
    CaseParams,
    CertificateParams,
    ControllerParams,
    choose,
    parse,
    read_section,
    sections,
)
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.errors import LawError, PlantError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.certificate.plan import CertificatePlan
from loopwright.pipeline.evaluation.evidence import WITHHELD, Evidence
from loopwright.pipeline.evaluation.evidence_basis import Grounds
from loopwright.pipeline.evaluation.extrapolation import grounds_of, widest
from loopwright.pipeline.evaluation.law_evidence import (
    BASE,
    ColdStart,
    Form,
    FormAnalysis,
    LawEvidence,
    LawMetrics,
    OverSeeds,
    lock_up_text,
)
from loopwright.pipeline.evaluation.model_evidence import identified_part
from loopwright.pipeline.evaluation.open_loop import cold_start, errors_at_rest, first_answers, replay
from loopwright.pipeline.evaluation.poor_laws import why_poor
from loopwright.pipeline.evaluation.stress.batches import outcomes_of
from loopwright.pipeline.evaluation.stress.loops import Stress, opened
from loopwright.pipeline.evaluation.trials import Metrics, Trial, step_us, try_files
from loopwright.pipeline.export.controller_file import with_evidence, withhold
from loopwright.pipeline.files import read_json, write_json
from loopwright.pipeline.stages.paths import (
    ARTIFACTS,
    analysis_file,
    calm_file,
    controller_file,
    design_folder,
    model_folder,
    old_loop_file,
    step_time_file,
    validation_folder,
)
from loopwright.serving.certificate import CERTIFICATE, Certificate
from loopwright.serving.controller import Controller, runtime_version
from loopwright.serving.controller_file import controller_files

NOTHING = "so nothing is shipped"
REMEDY = "give the law other numbers or models, or mark the reproduction of a paper's law with `as_printed: true`"
OWN_REMEDY = (
    "say with --known what you know of gains and dead times (the report says what the record leaves open of them), or "
    "run the step test that `loopwright new` lists and give its rows too"
)
RIVAL = "it is the loop that the plant was run by before, and stands here to be compared with"
FIELDS = ("time_s", "sp", "pv", "mv", "info")  # of the trajectories that are kept


def validate(name: str) -> None:
    """Run every file of ``controllers.<name>`` over its plant; ship the best by the development sequences.

    A law that was not designed, because it does not suit the plant, leaves the reason.
    A law that locks up anywhere is not shipped, nor one that leaves its limits on a model of a record. On a plant's
    equations that is an error; where tests run on models, the case goes on without it, and its report says why.
    """
    params = ControllerParams.read(name)
    choices = parse(CaseParams, read_section("cases", params.case), f"cases.{params.case}")
    case = choose(all_cases(), params.case, "case", f"controllers.{name}").with_held_out(choices.held_out_seeds)
    case.tests()  # before hours of closed loops: raises where there are none
    folder = validation_folder(params.case, params.name)
    designed = read_json(design_folder(params.case, params.name) / "metrics.json")
    if why := designed.get("withheld"):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_json(folder / WITHHELD, {"why": why})
        write_json(step_time_file(params.case, params.name), {})
        withhold(ARTIFACTS / params.case / f"{params.name}.onnx", why)
        return
    seeds = sorted(
        int(p.stem.removeprefix("seed")) for p in controller_files(design_folder(params.case, params.name) / BASE)
    )
    if not seeds:
        raise LawError(f"controllers.{name} has no exported files; run its design stage first")
    forms = (BASE, *params.variants)
    work = [(form, seed, controller_file(params.case, params.name, form, seed)) for form in forms for seed in seeds]
    before = old_loop_file(params.case, params.name, seeds[0])
    work += [(BASE, seeds[0], before)] * before.exists()
    label = f"validate {name}: files in closed loop"
    trials = try_files(case, choices.noise_seed, work, label)
    old = trials.pop() if before.exists() else None
    at_rest = errors_at_rest(case) if case.on_models else {}
    files = {seed: controller_file(params.case, params.name, BASE, seed) for seed in seeds}
    cold = _started_cold(params, case, files.values())
    found = _judged(params, case, designed, trials, at_rest, old, cold)
    calm = {seed: calm_file(params.case, params.name, seed) for seed in seeds}
    if (why := found.metrics.why_withheld) and all(file.exists() for file in calm.values()):
        work = [(BASE, seed, file) for seed, file in calm.items()]
        again = try_files(case, choices.noise_seed, work, f"validate {name}: the same law with calmer numbers")
        again += [t for t in trials if t.form != BASE]
        cold = _started_cold(params, case, calm.values())
        calmer = _judged(params, case, _calmed(designed), again, at_rest, old, cold)
        if not calmer.metrics.why_withheld:
            why = found.metrics.poor.rpartition("; ")[0] or why  # the remedy has been found
            print(f"validate {name}: calmer numbers are shipped; with its own it {why}", file=sys.stderr)
            found, files = replace(calmer, metrics=replace(calmer.metrics, calmed=why)), calm
    trials, shipped, metrics = found.trials, found.shipped, found.metrics
    base, source, locked_up = found.base, files[shipped.seed], metrics.locked_up
    how = "locked up or left its limits" if case.on_models else "locked up"
    own = params.case in sections("plants")  # who runs one must not ship such a law, and gives no law other numbers
    withheld = f"controllers.{name} {how} on {lock_up_text(locked_up)}, {NOTHING}; {OWN_REMEDY if own else REMEDY}"
    refused = bool(metrics.why_withheld)
    if refused and not case.on_models:
        raise LawError(withheld)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    models = read_json(model_folder(params.case, params.model) / "metrics.json") if case.on_models else {}
    metrics = replace(metrics, replay=_replayed(case, models, source, folder / "replay.npz"))
    operated, loops = try_operated(
        case, choices.noise_seed, source, choices.operated, f"validate {name}: operators' changes"
    )
    if operated:
        metrics = replace(metrics, operated=operated)
        np.savez_compressed(folder / "operated.npz", **cast(dict[str, Any], loops))
    if metrics.poor:
        why, _, remedy = metrics.poor.rpartition("; ")
        withheld = f"controllers.{name} {why}, {NOTHING}; {remedy}"
    if not (refused or params.name == case.old_loop):
        certificate = _certified(case, choices.certificate, source, folder / "certificate_plan.json", name)
        metrics = replace(metrics, certificate=certificate)
    metrics.write(folder / "metrics.json")
    took = step_us(Controller(source), next(iter(shipped.curves.values())), case.plant.dv_nominal)
    write_json(step_time_file(params.case, params.name), took)
    print(f"validate {name}: one step takes {took['p50']:.0f} us (median)", file=sys.stderr)
    curves = {f"{s}/{t.form}/{t.seed}": c for t in trials if t.seed == shipped.seed for s, c in t.curves.items()}
    if shipped.cycling is not None:
        curves["cycling"] = shipped.cycling
    arrays = {f"{key}/{field}": getattr(c, field) for key, c in curves.items() for field in FIELDS}
    np.savez_compressed(folder / "trajectories.npz", **arrays)
    if not metrics.calmed:
        _keep_analysis(params, shipped.seed, folder / "analysis.npz")
    evidence = _evidence(case, base, shipped, grounds_of(case, models, {"": metrics.reached}))
    if (analysis := metrics.forms[BASE].analysis) is not None:
        evidence["analysis"] = analysis.figures
    evidence["dead_time_periods"] = first_answers(case, models)
    if metrics.swings:
        evidence["swings"] = metrics.swings
    if metrics.beyond_reach:
        evidence["beyond_reach"] = metrics.beyond_reach
    if metrics.calmed:
        evidence["calmed"] = metrics.calmed
    if metrics.cold_start is not None:
        evidence["cold_start"] = asdict(metrics.cold_start)
    if operated:
        evidence["operated"] = {test: result.figures() for test, result in operated.items()}
    if locked_up:
        evidence |= {"locked_up": locked_up, "as_printed": True}
    if metrics.certificate is not None:
        evidence[CERTIFICATE] = metrics.certificate.to_dict()
    target = ARTIFACTS / params.case / f"{params.name}.onnx"
    if params.name == case.old_loop:
        withhold(target, RIVAL)
    elif refused:
        print(f"validate {name}: {withheld}", file=sys.stderr)
        withhold(target, withheld)
    else:
        with_evidence(source, target, evidence)


@dataclass(frozen=True, slots=True)
class JudgedTrials:
    """The trials of a law's files, the one that is shipped, unless its figures withhold it, and these figures."""

    trials: list[Trial]
    shipped: Trial
    metrics: LawMetrics

    @property
    def base(self) -> list[Trial]:
        """The trials of the shipped form, one a data seed."""
        return [t for t in self.trials if t.form == BASE]


def _judged(
    params: ControllerParams,
    case: Case,
    designed: Mapping[str, Any],
    trials: list[Trial],
    at_rest: Mapping[str, float],
    old: Trial | None,
    cold: ColdStart | None,
) -> JudgedTrials:
    """The figures of the trials; of a case on models also why the law is not shipped although it locked up nowhere."""
    # A candidate that locks up is out, whatever its mean; no scored test has a say.
    shipped = min((t for t in trials if t.form == BASE), key=lambda t: (t.development_lock_ups, t.development))
    metrics = replace(_metrics(params, case, designed, trials, shipped), at_rest=at_rest, cold_start=cold)
    if case.on_models and not metrics.why_withheld and params.name != case.old_loop:
        metrics = replace(metrics, poor=_why_poor(case, metrics, old))
    return JudgedTrials(trials, shipped, metrics)


def _calmed(designed: Mapping[str, Any]) -> dict[str, Any]:
    """metrics.json of the design stage with the analyses of the calmer numbers in the place of the law's own."""
    rows = designed["controllers"]
    return {**designed, "controllers": [{**r, "analysis": None, **r["calmed"]} if "calmed" in r else r for r in rows]}


def _why_poor(case: Case, metrics: LawMetrics, old: Trial | None) -> str:
    """Why a law that locked up nowhere is not shipped, see ``why_poor``; ``old`` is the trial of the old loop."""
    laws = {metrics.name: metrics}
    if old is not None:
        tests = {test: _over_seeds({old.seed: row}) for test, row in old.metrics.items()}
        form = Form({}, old.info, tests)
        laws[case.old_loop] = LawMetrics(
            case.old_loop, case.old_loop, case.metric, (old.seed,), old.seed, {BASE: form}, old.lock_ups
        )
    found = Evidence(case, {}, {name: LawEvidence(law, Path()) for name, law in laws.items()}, {})
    return why_poor(found, metrics.name)


def _of_tests(base: list[Trial], what: Literal["locked_up", "swings", "beyond_reach"]) -> dict[str, dict[str, int]]:
    """Test -> data seed -> closed loops that locked up or swing to the end, or holds beyond reach, if there are any."""
    counts: dict[int, dict[str, int]] = {t.seed: getattr(t, what) for t in base}
    tests = dict.fromkeys(test for of in counts.values() for test in of)
    return {test: {str(seed): of[test] for seed, of in counts.items() if test in of} for test in tests}


def _replayed(case: Case, models: Mapping[str, Any], file: Path, path: Path) -> dict[str, dict[str, float]]:
    """Figures of the file over the last rows of the plant's record, their curves kept; none without a record.

    ``models`` is metrics.json of the law's model set, which says in which row of the record an MV acts.
    """
    if case.replayed is None:
        return {}
    record, ahead = case.replayed
    structure = identified_part({"": models}).get("structure") or {}
    found = replay(Controller(file), record, case.plant.signals, ahead, same_row=bool(structure.get("same_row")))
    np.savez_compressed(path, **cast(dict[str, Any], found.arrays()))
    return found.figures(case.plant.signals.mv)


def _started_cold(params: ControllerParams, case: Case, files: Iterable[Path]) -> ColdStart | None:
    """The MVs that files ask for at rests of the plant's record; None of a case that has no record.

    Set points beyond a soft limit are no rests of a law: it leaves them.
    """
    if not case.on_models:
        return None
    signals, (least, most) = case.plant.signals, (params.settings.get(name) or () for name in ("cv_low", "cv_high"))
    cut = (
        replace(s, low=max(s.low, -np.inf if low is None else low), high=min(s.high, np.inf if high is None else high))
        for s, low, high in zip_longest(signals.sp, least, most)
    )
    return cold_start([Controller(file) for file in files], case.recorded_rests, replace(signals, sp=tuple(cut)))


def _keep_analysis(params: ControllerParams, seed: int, path: Path) -> None:
    """Put the arrays of every form's analysis into one file, as <form>/<name>."""
    arrays: dict[str, Any] = {}
    for form in (BASE, *params.variants):
        source = analysis_file(params.case, params.name, form, seed)
        if source.exists():
            with np.load(source, allow_pickle=False) as file:
                arrays |= {f"{form}/{name}": file[name] for name in file.files}
    if arrays:
        np.savez_compressed(path, **arrays)


def _metrics(
    params: ControllerParams, case: Case, designed: Mapping[str, Any], trials: list[Trial], shipped: Trial
) -> LawMetrics:
    """Figures of the trials that are kept; ``designed`` is metrics.json of the design stage."""
    base = [t for t in trials if t.form == BASE]
    analyses = {row["form"]: row.get("analysis") for row in designed["controllers"] if row["seed"] == shipped.seed}

    def form(name: str, settings: Mapping[str, Any]) -> Form:
        rows = [t for t in trials if t.form == name]
        analysis = parse(FormAnalysis, analyses[name], f"analysis of {name}") if analyses.get(name) else None
        tests = {test: _over_seeds({t.seed: t.metrics[test] for t in rows}) for test in rows[0].metrics}
        return Form(settings, rows[0].info, tests, analysis)

    return LawMetrics(
        name=params.name,
        title=designed["title"],
        metric=case.metric,
        seeds=tuple(t.seed for t in base),
        shipped_seed=shipped.seed,
        forms={name: form(name, settings) for name, settings in {BASE: params.settings, **params.variants}.items()},
        lock_ups=sum(t.lock_ups for t in base),
        development_lock_ups=sum(t.development_lock_ups for t in base),
        development={str(t.seed): t.development for t in base},
        development_travel={str(t.seed): t.development_travel for t in base},
        locked_up=_of_tests(base, "locked_up"),
        as_printed=params.as_printed,
        sequences={
            name: {seed: _over_seeds({t.seed: t.sequences[name][seed] for t in base}).median for seed in rows}
            for name, rows in base[0].sequences.items()
        },
        reached=widest(t.reached for t in base),
        swings=_of_tests(base, "swings"),
        cycles=shipped.cycles,
        beyond_reach=_of_tests(base, "beyond_reach"),
    )


def _over_seeds(rows: Mapping[int, Metrics]) -> OverSeeds:
    """Median and range of each figure over the data seeds, and each seed's own."""
    names = next(iter(rows.values()))
    median, low, high = (
        {name: float(reduce(row[name] for row in rows.values())) for name in names}
        for reduce in (statistics.median, min, max)
    )
    return OverSeeds(median, low, high, {str(seed): row for seed, row in rows.items()})


def _certified(case: Case, asked: CertificateParams, file: Path, written: Path, name: str) -> Certificate | None:
    """The certificate of a file, whose plan is ``written`` before its first loop runs.

    None where none is asked for, or no other plant can be drawn.
    """
    if not asked.loops:
        return None
    controller, content = opened(file)
    try:
        plan = CertificatePlan(controller.law_sha256, case, asked)
    except PlantError as error:
        print(f"validate {name}: no certificate: {error}", file=sys.stderr)
        return None
    write_json(written, plan.record())
    outcomes = outcomes_of(Stress(plan.drawing(), content), asked.loops, label=f"validate {name}: certificate")
    found = plan.certificate(outcomes, f"onnxruntime {runtime_version()}")
    print(f"validate {name}: {found.sentence}", file=sys.stderr)
    return found


def _evidence(case: Case, base: list[Trial], shipped: Trial, grounds: Grounds | None) -> dict[str, Any]:
    """Evidence in the shipped file's manifest: its own figures, and the median over the data seeds."""
    figures = {
        name: {**row, f"{case.metric}_median": statistics.median(t.metrics[name][case.metric] for t in base)}
        for name, row in shipped.metrics.items()
    }
    of = {} if grounds is None else {"plant": case.stand_in, "on": grounds.to_dict()}
    names = dict.fromkeys(name for row in figures.values() for name in row)
    units = {n: unit for n in names if (unit := case.metrics[n.removesuffix("_median")].unit_of(case.cv_unit))}
    units |= {"overshoot": "of the step"} if "overshoot" in names else {}
    return {"seeds": len(base), "lock_ups": sum(t.lock_ups for t in base), **of, "units": units, "scenarios": figures}


if __name__ == "__main__":
    sys.exit(run_stage(validate, sys.argv, "CONTROLLER"))
