"""A miniature of what the stages leave behind: work/, artifacts/ and dvc.lock, with made-up figures.

Not a test: the fixture factory of test_tracking and test_report. Nothing here was simulated; a
response is a first-order lag towards the set point, a figure follows from a "quality" per law.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from onnx import TensorProto, helper, numpy_helper

from loopwright.pipeline.cases import CASES, beside
from loopwright.pipeline.cases.batch_reactor.case import CALMED
from loopwright.pipeline.cases.batch_reactor.case import PLAIN as WITHOUT
from loopwright.pipeline.evaluation import law_evidence
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.validation import VALIDATION_SCHEMA, Validation
from loopwright.pipeline.evaluation.verdicts import PLAIN, Claims
from loopwright.pipeline.export.controller_file import file_bytes, write_sidecar
from loopwright.pipeline.report.page import write_report
from loopwright.pipeline.report.verdicts import judge, validation
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario
from loopwright.serving.manifest import Manifest

SEEDS = (0, 1, 2)
GAINS = ("kc", "tau_i_s", "tau_d_s", "penalty", "linearization_error")


@dataclass(frozen=True)
class Miniature:
    """Which case is made up, and how good each of its laws is."""

    case: str
    quality: Mapping[str, float]  # of each law: its error as a multiple of the bound's
    bound: Mapping[str, float]  # of each test, in the case's metric
    setting: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    variants: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)  # law -> name -> setting
    offline: Mapping[str, float] = field(default_factory=dict)
    adaptive: tuple[str, ...] = ()  # laws with ``GAINS`` in their info

    @cached_property
    def of(self) -> Case:
        """The case; its tests, whose steady states take seconds, are made once."""
        case = CASES[self.case]
        found = case.scenarios()
        case = case.with_held_out(case.held_out_seeds)
        object.__setattr__(case, "scenarios", lambda: found)
        return case

    @cached_property
    def tests(self) -> Mapping[str, Scenario]:
        """The first sequence of each test."""
        return {name: scenarios[0] for name, scenarios in self.of.scenarios().items()}


BACK = {"correction": "back_calculation"}
THIOSULFATE = Miniature(
    "thiosulfate_cstr",
    {"inc": 2.7, "incad": 1.8, "incadec": 3.9, "pid": 1.35, "inverse_dob": 1.12, "forward_dob": 1.16},
    {"sp_a": 0.064, "sp_b": 0.0073, "tin": 0.0002, "ua": 0.0004, "ua_gradual": 0.0001, "held_out": 0.036},
    {"incad": {"r": 1.5}, "incadec": {"r": 5.5, "correction": "as_printed"}},
    {
        "incad": {f"r={r:g}": {"r": r} for r in (2.5, 3.5, 4.5, 10)},
        "incadec": {"r=10": {"r": 10}, "r=5.5, back": BACK, "r=10, back": {"r": 10, **BACK}},
    },
    {"sp_a": 0.0635, "sp_b": 0.0072},
)
PH = Miniature(
    "ph_neutralization",
    {"linearized_pid": 1.3, "gauss_newton_pid": 1.01, "recursive_pid": 1.25, "self_tuning_pid": 1.6, "pid": 1.4},
    {"set_point": 6.04, "disturbance": 0.144, "held_out": 8.0, "buffer": 7.0, "base": 0.01},
    {"linearized_pid": {"penalty": 1.0}, "recursive_pid": {"penalty": 1.0}, "pid": {"tuning": "optimized"}},
    {
        "linearized_pid": {"penalty=20": {"penalty": 20.0}, "adaptive": {"adaptive": True}},
        "recursive_pid": {"penalty=5": {"penalty": 5.0}},
        "pid": {"tuning=itae, sampling=1": {"tuning": "itae", "sampling": 1.0}},
    },
    adaptive=("linearized_pid", "gauss_newton_pid", "recursive_pid"),
)
BATCH = Miniature(
    "batch_reactor",
    {"linearized_pid": 1.004, "gauss_newton_pid": 1.001, "recursive_pid": 1.002, "pid": 1.01},
    {"trajectory": 13_252.0, "fouling": 14_181.0, "held_out": 8000.0},
    {},
    {"linearized_pid": {"calmed": CALMED.setting, "without_recipe": WITHOUT.setting}},
    adaptive=("linearized_pid", "recursive_pid"),
)
CASE, QUALITY = THIOSULFATE.case, THIOSULFATE.quality


def write_json(path: Path, tree: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(tree))


def figures(error: float, metric: str = "mae") -> dict[str, float]:
    mae = (error / 150) ** 0.5 if metric == "sse" else error
    late = {"sse_late": error / 1000} if error > 1000 else {}
    return {
        "mae": mae,
        "sse": mae**2 * 150,
        **late,
        "ise": mae**2 * 50,
        "masse": mae / 100,
        "max_asse": mae / 50,
        "overshoot": mae,
        "settling": 8.0,
        "mv_travel": 3000.0,
        metric: error,
    }


def spread(error: float, metric: str = "mae") -> dict[str, Any]:
    per_seed = {str(s): figures(error * (1 + 0.02 * (s - 1)), metric) for s in SEEDS}
    ends = {"min": figures(error * 0.98, metric), "max": figures(error * 1.02, metric)}
    return {"median": figures(error, metric), **ends, "per_seed": per_seed}


def trajectory(case: Case, scenario: Scenario, quality: float, adaptive: bool = False) -> dict[str, np.ndarray]:
    """A lag towards the set point; a second measured state follows; gains that move with the error."""
    plant = case.plant
    n, low, high = scenario.samples, plant.mv_signals[0].low, plant.mv_signals[0].high
    cv = np.empty(n)
    now = float(plant.measure(scenario.x0)[0])
    for k in range(n):
        cv[k] = now
        now += (float(scenario.sp[k, 0]) - now) * 0.5 / quality
    pv = np.stack([cv, 300 + 60 * (1 - cv)], axis=1)[:, : len(plant.pv_signals)]
    error = scenario.sp[:, 0] - cv
    mv = [(low + high) / 2 + (high - low) / 4 * np.tanh(error)]
    mv += [np.where(error > 0, s.low, s.high) for s in plant.mv_signals[1:]]
    found = {"time_s": np.arange(n) * plant.period_s, "sp": scenario.sp, "pv": pv, "mv": np.stack(mv, axis=1)}
    if adaptive:
        kc, tau_i = 30 / (1 + np.abs(error)), 40 + 3000 * np.tanh(error**2)
        found["info"] = np.stack([kc, tau_i, 20 + 5 * error, 1 + 40 * np.abs(error), np.abs(error) / 10], axis=1)
    return found


def write_controller(path: Path, law: str, gain: float, mini: Miniature = THIOSULFATE) -> None:
    """A proportional law as ONNX, with the manifest beside it."""
    sizes = (("sp", 1), ("pv", len(mini.of.plant.pv_signals)))
    ins = [helper.make_tensor_value_info(n, TensorProto.DOUBLE, [k]) for n, k in sizes]
    outs = [helper.make_tensor_value_info("mv", TensorProto.DOUBLE, [1])]
    constants = [
        numpy_helper.from_array(np.array([gain]), "gain"),
        numpy_helper.from_array(np.array([0]), "first"),
    ]
    nodes = [
        helper.make_node("Gather", ["pv", "first"], ["cv"]),
        helper.make_node("Sub", ["sp", "cv"], ["error"]),
        helper.make_node("Mul", ["error", "gain"], ["mv"]),
    ]
    graph = helper.make_graph(nodes, "law", ins, outs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    plant = mini.of.plant
    manifest = Manifest(
        case=mini.case,
        law=law,
        period_s=plant.period_s,
        sp=tuple(plant.pv_signals[:1]),
        pv=tuple(plant.pv_signals),
        dv=(),
        mv=tuple(plant.mv_signals[:1]),
        n_state=0,
        info=(),
        inputs=("sp", "pv"),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(file_bytes(model.SerializeToString(), manifest))
    write_sidecar(path, manifest)


def write_models(root: Path) -> None:
    folder = root / "work" / CASE / "models" / "one_step"
    seeds = {
        str(s): {
            "rmse": 18.0 + s,
            "r2": 0.98,
            "centres": 724 + s,
            "regions": {"hot": {"rmse": 3.0}, "middle": {"rmse": 70.0 + s}, "cold": {"rmse": 45.0}},
            "history": [30.0, 22.0, 18.0 + s],
        }
        for s in SEEDS
    }
    part = {"kind": "rbf", "task": "inverse", "horizon": 1, "unit": "K", "per_seed": seeds, "median": seeds["1"]}
    write_json(folder / "metrics.json", {"model": "one_step", "parts": {"inverse": part}})
    rows = []
    for c in range(4, 101, 8):
        rmse = 60 * np.exp(-c / 20) + 18 + 0.05 * abs(c - 84)
        score = {"rmse": rmse, "r2": 0.97, "regions": {"hot": rmse / 5, "middle": rmse * 4}}
        rows.append({"partitions": c, "centres": int(c**1.4), "train": score, "validation": score})
    write_json(folder / "sweep.json", {"chosen": 84, "unit": "K", "rows": rows})
    actual = np.random.default_rng(0).uniform(0, 500, 200)
    np.savez(folder / "predictions.npz", time_s=np.arange(200) * 0.5, actual=actual, predicted=actual * 0.97 + 5)


def write_nnarx_models(root: Path, mini: Miniature = PH) -> None:
    """A set of NNARX whose size was searched, and the identification example with its curves."""
    folder = root / "work" / mini.case / "models"
    sizes = [(1, 1, 10, 0.05), (2, 2, 6, 0.0062), (2, 2, 10, 0.0041), (3, 3, 10, 0.004)]

    def row(seed: int, size: tuple[int, int, int, float]) -> dict[str, Any]:
        n_y, n_u, width, free = size
        count, chosen = width * (n_y + n_u + 2) + 1, size == sizes[2 + (seed == 2)]
        errors = {"rmse": free / 3, "free_run_rmse": free * (1 + 0.1 * seed)}
        return {"n_y": n_y, "n_u": n_u, "hidden": [width], "parameters": count, **errors, "chosen": chosen}

    seeds = {
        str(s): {"rmse": 0.0013, "free_run_rmse": 0.0041, "r2": 0.9999, "candidates": [row(s, size) for size in sizes]}
        for s in SEEDS
    }
    part = {"kind": "nnarx", "per_seed": seeds, "median": {"rmse": 0.0013, "free_run_rmse": 0.0041, "r2": 0.9999}}
    write_json(folder / "nnarx" / "metrics.json", {"model": "nnarx", "parts": {"nnarx": part}})
    sse = {"nnarx": 0.055, "linearized": 0.6, "recursive_0.8": 2.6, "recursive_0.5": 5.0}
    one_step = {k: {"median": v, "min": v * 0.9, "max": v * 1.1} for k, v in sse.items()}
    part = {"kind": "identification_example", "per_seed": {"0": {"one_step": one_step}}, "median": {}}
    name = "identification_example"
    write_json(folder / name / "metrics.json", {"model": name, "parts": {"example": part}})
    measured = np.sin(np.arange(100) * 2 * np.pi / 25)
    curves = {k: measured + np.sqrt(v / 50) * np.cos(np.arange(100)) for k, v in sse.items()}
    np.savez(folder / name / "predictions.npz", time_s=np.arange(100.0), measured=measured, **curves)


def write_validation(
    root: Path, law: str, quality: float, lock_ups: int = 0, gain: float = 100.0, mini: Miniature = THIOSULFATE
) -> None:
    """What validate leaves of one law."""
    folder = root / "work" / mini.case / "validation" / law
    case, metric = mini.of, mini.of.metric
    tests = mini.tests
    errors = {name: bound * quality for name, bound in mini.bound.items()}
    variants, info = mini.variants.get(law, {}), list(GAINS) if law in mini.adaptive else []
    shipped = {name: spread(error, metric) for name, error in errors.items()}
    noisy = {name + NOISE_SUFFIX: spread(error * 1.1 + 1e-4, metric) for name, error in errors.items()}
    forms = {"base": {"setting": mini.setting.get(law, {}), "info": info, "tests": shipped | noisy}}
    for i, (name, setting) in enumerate(variants.items()):
        worse = {test: spread(error * (1.2 + 0.1 * i), metric) for test, error in errors.items()}
        forms[name] = {"setting": setting, "info": info, "tests": worse}
    metrics: dict[str, Any] = {
        "schema": law_evidence.METRICS_SCHEMA,
        "name": law,
        "title": law.upper(),
        "metric": metric,
        "seeds": list(SEEDS),
        "shipped_seed": 0,
        "lock_ups": lock_ups,
        "locked_up": {"sp_a": {"0": lock_ups}} if lock_ups else {},
        "as_printed": bool(lock_ups),
        "forms": forms,
    }
    write_json(folder / "metrics.json", metrics)
    write_json(root / "timing" / mini.case / f"{law}-step.json", {"p50": 25.0, "p99": 60.0})
    loops = {**tests, **{name + NOISE_SUFFIX: test for name, test in tests.items()}}
    loops |= case.unscored()
    arrays = {}
    for i, variant in enumerate(("base", *variants)):
        for name, scenario in loops.items():
            for key, values in trajectory(case, scenario, quality * (1 + 0.3 * i), bool(info)).items():
                arrays[f"{name}/{variant}/0/{key}"] = values
    np.savez_compressed(folder / "trajectories.npz", **arrays)
    write_controller(root / "artifacts" / mini.case / f"{law}.onnx", law, gain, mini)


def bounds(mini: Miniature = THIOSULFATE) -> dict[str, Any]:
    """The stored bounds; they have no squared error after a recipe's start."""
    rows: dict[str, Any] = {name: {"nmpc": figures(error, mini.of.metric)} for name, error in mini.bound.items()}
    for name, error in mini.offline.items():
        rows[name]["offline"] = figures(error, mini.of.metric)
    return rows


def evidence(scores: dict[str, float], lock_ups: dict[str, int] | None = None, gate_id: str = "g1") -> dict[str, Any]:
    """A validation.json as the report writes it, small."""
    laws = {
        law: {"score": score, "lock_ups": (lock_ups or {}).get(law, 0), "ratios": {"sp_a": score}}
        for law, score in scores.items()
    }
    table = {law: {**figures(0.064 * s), "mae_min": 0.06, "mae_max": 0.2, "seeds": 3} for law, s in scores.items()}
    what = {"id": gate_id, "weights": {"sp_a": 1.0}, "floor": 0.0, "floors": {"sp_a": 5e-4}}
    titles = {"case": "Thiosulfate CSTR", "laws": {"pid": "PID"}, "scenarios": {"sp_a": "Set points"}}
    return {
        "schema": VALIDATION_SCHEMA,
        "case": CASE,
        "metric": "mae",
        "best": None,
        "main": "sp_a",
        "scenarios": {"sp_a": table, "sp_a" + NOISE_SUFFIX: table},
        "bounds": {"sp_a": {"nmpc": figures(0.064)}},
        "gate": {**what, "baseline": "pid", "baseline_name": "PID", "laws": laws},
        "laws": {law: {"seeds": 3, "lock_ups": row["lock_ups"], "step_us": 20.0} for law, row in laws.items()},
        "requirements": [],
        "claims": [],
        "paper": [],
        "titles": {**titles, "metric": "mean absolute error", "metric_short": "MAE", "figures": {}},
    }


def _dvc_hash(path: Path) -> str:
    if path.is_file():
        return hashlib.md5(path.read_bytes()).hexdigest()
    rows = [{"md5": _dvc_hash(p), "relpath": p.relative_to(path).as_posix()} for p in path.rglob("*") if p.is_file()]
    listing = json.dumps(sorted(rows, key=lambda r: r["relpath"]), sort_keys=True)
    return hashlib.md5(listing.encode()).hexdigest() + ".dir"


def write_lock(root: Path, laws: dict[str, dict[str, Any]]) -> None:
    """dvc.lock over what lies in ``root``; ``laws`` maps each law to its params."""
    base = f"work/{CASE}"
    records, model = f"{base}/records/steps", f"{base}/models/one_step"

    def row(cmd: str, deps: list[str], params: dict[str, Any], outs: list[str]) -> dict[str, Any]:
        def listed(paths: list[str]) -> list[dict[str, str]]:
            return [{"path": p, "hash": "md5", "md5": _dvc_hash(root / p)} for p in paths]

        return {"cmd": cmd, "deps": listed(deps), "params": {"params.yaml": params}, "outs": listed(outs)}

    stages = {
        f"excite@{CASE}-steps": row("excite", [], {f"records.{CASE}-steps": {"samples": 100, "seeds": [0]}}, [records]),
        f"fit@{CASE}-one_step": row("fit", [records], {f"models.{CASE}-one_step": {"kind": "rbf", "c": 88}}, [model]),
    }
    for law, params in laws.items():
        outs = [f"{base}/validation/{law}", f"artifacts/{CASE}/{law}.onnx", f"artifacts/{CASE}/{law}.json"]
        deps = [] if law == "pid" else [model]
        stages[f"validate@{CASE}-{law}"] = row("validate", deps, {f"controllers.{CASE}-{law}": params}, outs)
    (root / "dvc.lock").write_text(yaml.safe_dump({"schema": "2.0", "stages": stages}, sort_keys=False))


def write_case(root: Path, quality: Mapping[str, float] | None = None, mini: Miniature = THIOSULFATE) -> None:
    """The whole miniature, without the report's outputs."""
    records = root / "work" / mini.case / "records" / "steps"
    records.mkdir(parents=True)
    (records / "seed0.csv").write_text("run,time_s\n0,0.0\n")
    write_models(root) if mini is THIOSULFATE else write_nnarx_models(root, mini)
    for law, value in (quality or mini.quality).items():
        write_validation(root, law, value, mini=mini)


def claims_of(case: str) -> Claims:
    """What is known of the case with this name."""
    claims: Claims = beside(CASES[case], "paper", "CLAIMS", PLAIN) if case in CASES else PLAIN
    return claims


def report(evidence: Evidence, out: Path) -> None:
    """The report with what is known of the case, as its stage writes it."""
    name = evidence.case.name
    pictures = beside(CASES[name], "pictures", "PICTURES", ()) if name in CASES else ()
    write_report(evidence, claims_of(name), pictures, out)


def for_programs(evidence: Evidence) -> Validation:
    """validation.json with what is known of the case."""
    return validation(evidence, judge(evidence, claims_of(evidence.case.name)))
