"""Stage validate: the exported files in closed loop, and the best of them shipped with its evidence."""

from __future__ import annotations

import shutil
import statistics
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from pipeline.cases import CASES, NOISE_SUFFIX, Case, Scenario
from pipeline.command import run_stage
from pipeline.errors import LawError
from pipeline.export import with_evidence
from pipeline.metrics import closed_loop_metrics, locked_up
from pipeline.parallel import parallel_map
from pipeline.params import CaseParams, ControllerParams, choose, parse, read_section
from pipeline.plants.base import Array
from pipeline.simulate import Trajectory, simulate_closed
from pipeline.stages import ARTIFACTS, BASE, controller_file, design_folder, read_json, validation_folder, write_json
from serving.controller import Controller
from serving.errors import LoopwrightError

Metrics = dict[str, float]
ROUNDS = 8  # of timing a step


@dataclass(frozen=True)
class Trial:
    """One file's closed loops: figures by scenario (noisy ones under their own names), curves, faults."""

    form: str
    seed: int
    metrics: dict[str, Metrics]
    sequences: dict[str, dict[str, Metrics]]  # of the tests with several sequences, by their seeds
    development: float  # mean MAE over the development sequences
    development_lock_ups: int
    lock_ups: int  # in all closed loops, those of the development included
    curves: dict[str, Trajectory]
    step_us: dict[str, float]


def validate(name: str) -> None:
    """Run every file of ``controllers.<name>`` over its plant; ship the best by the development sequences."""
    params = ControllerParams.read(name)
    choices = parse(CaseParams, read_section("cases", params.case), f"cases.{params.case}")
    case = choose(CASES, params.case, "case", f"controllers.{name}").with_held_out(choices.held_out_seeds)
    seeds = sorted(
        int(p.stem.removeprefix("seed")) for p in (design_folder(params.case, params.law) / BASE).glob("*.onnx")
    )
    if not seeds:
        raise LawError(f"controllers.{name} has no exported files; run its design stage first")
    work = [(form, seed) for form in (BASE, *params.variants) for seed in seeds]
    trials = parallel_map(partial(_trial, case, params.law, choices.noise_seed), work, f"validate {name}")
    base = [t for t in trials if t.form == BASE]
    # A candidate that locks up is out, whatever its mean; no scored test has a say.
    shipped = min(base, key=lambda t: (t.development_lock_ups, t.development))
    folder = validation_folder(params.case, params.law)
    shutil.rmtree(folder, ignore_errors=True)
    title = read_json(design_folder(params.case, params.law) / "metrics.json")["title"]
    write_json(folder / "metrics.json", {"law": params.law, "title": title, **_summary(params, base, trials, shipped)})
    curves = {f"{s}/{t.form}/{t.seed}": c for t in trials if t.seed == shipped.seed for s, c in t.curves.items()}
    fields = {f"{key}/{f}": getattr(c, f) for key, c in curves.items() for f in ("time_s", "sp", "pv", "mv")}
    np.savez_compressed(folder / "trajectories.npz", **fields)
    source = controller_file(params.case, params.law, BASE, shipped.seed)
    with_evidence(source, ARTIFACTS / params.case / f"{params.law}.onnx", _evidence(base, shipped))


def _trial(case: Case, law: str, noise_seed: int, item: tuple[str, int]) -> Trial:
    form, seed = item
    controller = Controller(controller_file(case.name, law, form, seed))
    loop = partial(_loop, controller, case)
    metrics: dict[str, Metrics] = {}
    sequences: dict[str, dict[str, Metrics]] = {}
    curves: dict[str, Trajectory] = {}
    lock_ups = 0
    for name, tests in case.scenarios().items():
        if form != BASE and len(tests) > 1:
            continue  # variants are there for the paper's tables, which have no random sequences
        for suffix, noise in (("", None), (NOISE_SUFFIX, case.noise_std)):
            if suffix and form != BASE:
                continue
            loops = [loop(test, noise, noise_seed + i) for i, test in enumerate(tests)]
            rows = [_score(case, test, found) for test, found in zip(tests, loops, strict=True)]
            metrics[name + suffix] = _mean(rows)
            curves[name + suffix] = loops[0]
            lock_ups += sum(_stuck(case, test, found) for test, found in zip(tests, loops, strict=True))
            if len(tests) > 1 and not suffix:
                sequences[name] = {str(test.seed): row for test, row in zip(tests, rows, strict=True)}
    development, scored = [], lock_ups
    if form == BASE:
        for test in case.development():
            found = loop(test, None, 0)
            development.append(_score(case, test, found)["mae"])
            lock_ups += _stuck(case, test, found)
    for figure in case.figures:
        if figure.hold and figure.scenario:
            (test,) = case.scenarios()[figure.scenario]
            curves[f"{figure.scenario}_hold{figure.hold}"] = loop(test.with_hold(figure.hold), None, 0)
    mean = statistics.fmean(development) if development else float("nan")
    step_us = _step_us(controller, next(iter(curves.values())))
    return Trial(form, seed, metrics, sequences, mean, lock_ups - scored, lock_ups, curves, step_us)


def _loop(controller: Controller, case: Case, test: Scenario, noise: Array | None, seed: int) -> Trajectory:
    """One closed loop, with one more entry of info: whether the controller refused the step.

    The MV is then kept, as the real loop's HOLD keeps it.
    """
    state = controller.cold_state()
    n_info = len(controller.manifest.info)

    def step(sp: Array, pv: Array, mv_applied: Array) -> tuple[Array, Array]:
        nonlocal state
        try:
            mv, state, info = controller.step(sp=sp, pv=pv, mv_applied=mv_applied, state=state)
        except LoopwrightError:
            state = controller.cold_state()
            return mv_applied, np.append(np.zeros(n_info), 1.0)
        return mv, np.append(info, 0.0)

    return simulate_closed(case.plant, step, test, noise=noise, seed=seed)


def _score(case: Case, test: Scenario, loop: Trajectory) -> Metrics:
    sp = case.plant.sp_signals[0]
    return closed_loop_metrics(loop.sp, loop.pv, loop.mv, test.hold, case.plant.period_s, sp.high - sp.low)


def _stuck(case: Case, test: Scenario, loop: Trajectory) -> bool:
    """Locked up at an end of the MV, or with a step that the controller refused."""
    mv = case.plant.mv_signals[0]
    stuck = locked_up(loop.sp[:, 0], loop.pv[:, 0], loop.mv[:, 0], test.hold, low=mv.low, high=mv.high)
    return stuck or bool(loop.info[:, -1].any())


def _mean(rows: Iterable[Metrics]) -> Metrics:
    """Mean over the sequences of a test; of the largest steady error, the largest."""
    table = list(rows)
    found = {key: statistics.fmean(row[key] for row in table) for key in table[0]}
    return found | {"max_asse": max(row["max_asse"] for row in table)}


def _step_us(controller: Controller, loop: Trajectory) -> dict[str, float]:
    """Time of one step along a loop [us], all checks included: of several rounds the quietest.

    Other processes run beside this one; a round that they disturb says nothing of the controller.
    """
    rounds = np.empty((ROUNDS, len(loop.sp) - 1))
    for taken in rounds:
        state = controller.cold_state()
        for k in range(1, len(loop.sp)):
            begun = time.perf_counter()
            state = controller.step(sp=loop.sp[k], pv=loop.pv[k], mv_applied=loop.mv[k - 1], state=state).state
            taken[k - 1] = 1e6 * (time.perf_counter() - begun)
    p50, p99 = np.quantile(rounds, [0.5, 0.99], axis=1)
    best = int(np.argmin(p50))
    return {"p50": float(p50[best]), "p99": float(p99[best])}


def _summary(params: ControllerParams, base: list[Trial], trials: list[Trial], shipped: Trial) -> dict[str, Any]:
    clean = [name for name in base[0].metrics if not name.endswith(NOISE_SUFFIX)]
    forms = {t.form: [u for u in trials if u.form == t.form] for t in trials if t.form != BASE}
    return {
        "setting": {k: v for k, v in params.settings.items() if isinstance(v, (int, float, str))},
        "seeds": [t.seed for t in base],
        "shipped_seed": shipped.seed,
        "lock_ups": sum(t.lock_ups for t in base),
        "development_lock_ups": sum(t.development_lock_ups for t in base),
        "development": {str(t.seed): t.development for t in base},
        "step_us": shipped.step_us,
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


def _evidence(base: list[Trial], shipped: Trial) -> dict[str, Any]:
    """What the shipped file says of itself: its own figures, and the median over the data seeds."""
    figures = {
        name: {**row, "mae_median": statistics.median(t.metrics[name]["mae"] for t in base)}
        for name, row in shipped.metrics.items()
    }
    return {"seeds": len(base), "lock_ups": sum(t.lock_ups for t in base), "scenarios": figures}


if __name__ == "__main__":
    sys.exit(run_stage(validate, sys.argv, "CONTROLLER"))
