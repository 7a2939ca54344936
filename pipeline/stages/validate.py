"""Stage validate: the exported files in closed loop, and the best of them shipped with its evidence."""

from __future__ import annotations

import shutil
import statistics
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.cases import CASES
from pipeline.config.params import CaseParams, ControllerParams, choose, parse, read_section
from pipeline.engine.command import run_stage
from pipeline.engine.parallel import parallel_map
from pipeline.errors import LawError
from pipeline.evaluation.case import Case
from pipeline.evaluation.law_evidence import lock_up_text
from pipeline.evaluation.trial import BASE, Metrics, Trial, step_us, try_file
from pipeline.export.controller_file import with_evidence
from pipeline.files import read_json, write_json
from pipeline.simulation.scenario import NOISE_SUFFIX
from pipeline.stages.paths import (
    ARTIFACTS,
    analysis_file,
    controller_file,
    design_folder,
    step_time_file,
    validation_folder,
)
from serving.controller import Controller

FIELDS = ("time_s", "sp", "pv", "mv", "info")  # of the trajectories that are kept


def validate(name: str) -> None:
    """Run every file of ``controllers.<name>`` over its plant; ship the best by the development sequences."""
    params = ControllerParams.read(name)
    choices = parse(CaseParams, read_section("cases", params.case), f"cases.{params.case}")
    case = choose(CASES, params.case, "case", f"controllers.{name}").with_held_out(choices.held_out_seeds)
    case.tests()  # before hours of closed loops: raises where there are none
    seeds = sorted(
        int(p.stem.removeprefix("seed")) for p in (design_folder(params.case, params.name) / BASE).glob("*.onnx")
    )
    if not seeds:
        raise LawError(f"controllers.{name} has no exported files; run its design stage first")
    forms = (BASE, *params.variants)
    work = [(form, seed, controller_file(params.case, params.name, form, seed)) for form in forms for seed in seeds]
    trials = parallel_map(partial(try_file, case, choices.noise_seed), work, f"validate {name}")
    base = [t for t in trials if t.form == BASE]
    # A candidate that locks up is out, whatever its mean; no scored test has a say.
    shipped = min(base, key=lambda t: (t.development_lock_ups, t.development))
    source = controller_file(params.case, params.name, BASE, shipped.seed)
    locked_up = _locked_up(base)
    if locked_up and not params.as_printed:
        raise LawError(
            f"controllers.{name} locked up on {lock_up_text(locked_up)}, so nothing is shipped; give the law other "
            "numbers or models, or mark the reproduction of a paper's law with `as_printed: true`"
        )
    folder = validation_folder(params.case, params.name)
    shutil.rmtree(folder, ignore_errors=True)
    designed = read_json(design_folder(params.case, params.name) / "metrics.json")
    analysis = {r["form"]: r["analysis"] for r in designed["controllers"] if _is_told(r, shipped.seed)}
    metrics = {
        "name": params.name,
        "law": params.law,
        "title": designed["title"],
        **_summary(params, base, trials, shipped),
        "as_printed": params.as_printed,
        "locked_up": locked_up,
        "analysis": analysis,
        "metric": case.metric,
    }
    write_json(folder / "metrics.json", metrics)
    took = step_us(Controller(source), next(iter(shipped.curves.values())))
    write_json(step_time_file(params.case, params.name), took)
    print(f"validate {name}: one step takes {took['p50']:.0f} us (median)", file=sys.stderr)
    curves = {f"{s}/{t.form}/{t.seed}": c for t in trials if t.seed == shipped.seed for s, c in t.curves.items()}
    arrays = {f"{key}/{field}": getattr(c, field) for key, c in curves.items() for field in FIELDS}
    np.savez_compressed(folder / "trajectories.npz", **arrays)
    _keep_analysis(params, shipped.seed, folder / "analysis.npz")
    evidence = _evidence(case, base, shipped)
    if BASE in analysis:
        evidence["analysis"] = analysis[BASE]["figures"]
    if locked_up:
        evidence |= {"locked_up": locked_up, "as_printed": True}
    with_evidence(source, ARTIFACTS / params.case / f"{params.name}.onnx", evidence)


def _locked_up(base: list[Trial]) -> dict[str, dict[str, int]]:
    """Test -> data seed -> closed loops that locked up, of those where any did."""
    tests = dict.fromkeys(test for t in base for test in t.locked_up)
    return {test: {str(t.seed): t.locked_up[test] for t in base if test in t.locked_up} for test in tests}


def _is_told(row: Mapping[str, Any], seed: int) -> bool:
    return row["seed"] == seed and "analysis" in row


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


def _summary(params: ControllerParams, base: list[Trial], trials: list[Trial], shipped: Trial) -> dict[str, Any]:
    clean = [name for name in base[0].metrics if not name.endswith(NOISE_SUFFIX)]
    forms = {t.form: [u for u in trials if u.form == t.form] for t in trials if t.form != BASE}
    return {
        "info": list(shipped.info),
        "variant_info": {form: list(rows[0].info) for form, rows in forms.items()},  # a setting may tell more
        "setting": {k: v for k, v in params.settings.items() if isinstance(v, (int, float, str))},
        "seeds": [t.seed for t in base],
        "shipped_seed": shipped.seed,
        "lock_ups": sum(t.lock_ups for t in base),
        "development_lock_ups": sum(t.development_lock_ups for t in base),
        "development": {str(t.seed): t.development for t in base},
        "scenarios": {name: _over_seeds({t.seed: t.metrics[name] for t in base}) for name in clean},
        "noise": {name: _over_seeds({t.seed: t.metrics[name + NOISE_SUFFIX] for t in base}) for name in clean},
        "sequences": {
            name: {seed: _over_seeds({t.seed: t.sequences[name][seed] for t in base})["median"] for seed in rows}
            for name, rows in base[0].sequences.items()
        },
        "variants": {
            form: {name: _over_seeds({t.seed: t.metrics[name] for t in rows}) for name in rows[0].metrics}
            for form, rows in forms.items()
        },
    }


def _over_seeds(rows: Mapping[int, Metrics]) -> dict[str, Any]:
    """Median and range of each figure over the data seeds, and each seed's own."""
    found: dict[str, Any] = {}
    for name, reduce in (("median", statistics.median), ("min", min), ("max", max)):
        found[name] = {key: float(reduce(row[key] for row in rows.values())) for key in next(iter(rows.values()))}
    return found | {"per_seed": {str(seed): row for seed, row in rows.items()}}


def _evidence(case: Case, base: list[Trial], shipped: Trial) -> dict[str, Any]:
    """What the shipped file says of itself: its own figures, and the median over the data seeds."""
    figures = {
        name: {**row, f"{case.metric}_median": statistics.median(t.metrics[name][case.metric] for t in base)}
        for name, row in shipped.metrics.items()
    }
    return {"seeds": len(base), "lock_ups": sum(t.lock_ups for t in base), "scenarios": figures}


if __name__ == "__main__":
    sys.exit(run_stage(validate, sys.argv, "CONTROLLER"))
