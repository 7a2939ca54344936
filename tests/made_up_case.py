"""A miniature of what the stages leave behind: work/, artifacts/ and dvc.lock, with made-up figures.

Not a test: the fixture factory of test_tracking and test_report. Nothing here was simulated; a
response is a first-order lag towards the set point, a figure follows from a "quality" per law.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from onnx import TensorProto, helper

from pipeline.cases import CASES, NOISE_SUFFIX

CASE = "thiosulfate_cstr"
QUALITY = {"inc": 2.7, "incad": 1.8, "incadec": 3.9, "pid": 1.35, "inverse_dob": 1.12, "forward_dob": 1.16}
"""Of each law: MAE as a multiple of the bound's."""
BOUND = {"sp_a": 0.064, "sp_b": 0.0073, "tin": 0.0002, "ua": 0.0004, "ua_gradual": 0.0001, "held_out": 0.036}
SETTING = {"incad": {"r": 1.5}, "incadec": {"r": 5.5, "correction": "as_printed"}}
VARIANTS = {"incad": ("r=2.5", "r=3.5", "r=4.5", "r=10"), "incadec": ("r=10", "r=5.5, back", "r=10, back")}
SEEDS = (0, 1, 2)


def write_json(path: Path, tree: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(tree))


def figures(mae: float) -> dict[str, float]:
    return {
        "mae": mae,
        "ise": mae**2 * 50,
        "masse": mae / 100,
        "max_asse": mae / 50,
        "overshoot": mae,
        "settling": 8.0,
        "mv_travel": 3000.0,
    }


def spread(mae: float) -> dict[str, Any]:
    per_seed = {str(s): figures(mae * (1 + 0.02 * (s - 1))) for s in SEEDS}
    return {"median": figures(mae), "min": figures(mae * 0.98), "max": figures(mae * 1.02), "per_seed": per_seed}


def trajectory(scenario: Any, quality: float) -> dict[str, np.ndarray]:
    n = scenario.samples
    pv = np.empty((n, 2))
    ca = float(scenario.x0[0])
    for k in range(n):
        pv[k] = ca, 300 + 60 * (1 - ca)
        ca += (float(scenario.sp[k, 0]) - ca) * 0.5 / quality
    return {"time_s": np.arange(n) * 0.5, "sp": scenario.sp, "pv": pv, "mv": 250 + 200 * (scenario.sp - pv[:, :1])}


def write_controller(path: Path, law: str, gain: float) -> None:
    """A proportional law as ONNX, with the manifest beside it."""
    ins = [helper.make_tensor_value_info(n, TensorProto.DOUBLE, [k]) for n, k in (("sp", 1), ("pv", 2))]
    outs = [helper.make_tensor_value_info("mv", TensorProto.DOUBLE, [1])]
    constants = [
        helper.make_tensor("gain", TensorProto.DOUBLE, [1], [gain]),
        helper.make_tensor("first", TensorProto.INT64, [1], [0]),
    ]
    nodes = [
        helper.make_node("Gather", ["pv", "first"], ["cv"]),
        helper.make_node("Sub", ["sp", "cv"], ["error"]),
        helper.make_node("Mul", ["error", "gain"], ["mv"]),
    ]
    graph = helper.make_graph(nodes, "law", ins, outs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    manifest = {"schema": 1, "case": CASE, "law": law, "period_s": 0.5, "provenance": {}, "evidence": {}}
    helper.set_model_props(model, {"loopwright.manifest": json.dumps(manifest)})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(model.SerializeToString())
    write_json(path.with_suffix(".json"), manifest)


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
        rows.append({"partitions": c, "centres": int(c**1.4), "train": score, "validation": score, "seconds": 1.0})
    write_json(folder / "sweep.json", {"chosen": 84, "unit": "K", "rows": rows})
    actual = np.random.default_rng(0).uniform(0, 500, 200)
    np.savez(folder / "predictions.npz", time_s=np.arange(200) * 0.5, actual=actual, predicted=actual * 0.97 + 5)


def write_validation(root: Path, law: str, quality: float, lock_ups: int = 0, gain: float = 100.0) -> None:
    """What validate leaves of one law."""
    folder = root / "work" / CASE / "validation" / law
    case = CASES[CASE]
    tests = {name: scenarios[0] for name, scenarios in case.scenarios().items()}
    maes = {name: bound * quality for name, bound in BOUND.items()}
    metrics: dict[str, Any] = {
        "law": law,
        "title": law.upper(),
        "seeds": list(SEEDS),
        "shipped_seed": 0,
        "lock_ups": lock_ups,
        "setting": SETTING.get(law, {}),
        "scenarios": {name: spread(mae) for name, mae in maes.items()},
        "noise": {name: spread(mae * 1.1 + 1e-4) for name, mae in maes.items()},
        "variants": {
            v: {name: spread(mae * (1.2 + 0.1 * i)) for name, mae in maes.items()}
            for i, v in enumerate(VARIANTS.get(law, ()))
        },
        "step_us": {"p50": 25.0, "p99": 60.0},
    }
    write_json(folder / "metrics.json", metrics)
    arrays = {}
    loops = {**tests, "sp_a_hold160": tests["sp_a"].with_hold(160)}
    for i, variant in enumerate(("base", "noise", *VARIANTS.get(law, ()))):
        for name, scenario in loops.items():
            for field, values in trajectory(scenario, quality * (1 + 0.3 * i)).items():
                arrays[f"{name}/{variant}/0/{field}"] = values
    np.savez_compressed(folder / "trajectories.npz", **arrays)
    write_controller(root / "artifacts" / CASE / f"{law}.onnx", law, gain)


def bounds() -> dict[str, Any]:
    """What the oracle's script stored."""
    rows: dict[str, Any] = {name: {"nmpc": figures(mae)} for name, mae in BOUND.items()}
    rows["sp_a"]["offline"], rows["sp_b"]["offline"] = figures(0.0635), figures(0.0072)
    return rows


def evidence(scores: dict[str, float], lock_ups: dict[str, int] | None = None, gate_id: str = "g1") -> dict[str, Any]:
    """A validation.json as the report writes it, small."""
    laws = {
        law: {"score": score, "lock_ups": (lock_ups or {}).get(law, 0), "ratios": {"sp_a": score}}
        for law, score in scores.items()
    }
    table = {law: {**figures(0.064 * s), "mae_min": 0.06, "mae_max": 0.2, "seeds": 3} for law, s in scores.items()}
    return {
        "case": CASE,
        "scenarios": {"sp_a": table, "sp_a" + NOISE_SUFFIX: table},
        "bounds": {"sp_a": {"nmpc": figures(0.064)}},
        "gate": {"id": gate_id, "weights": {"sp_a": 1.0}, "laws": laws},
        "titles": {"case": "Thiosulfate CSTR", "laws": {"pid": "PID"}, "scenarios": {"sp_a": "Set points"}},
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


def write_case(root: Path, quality: dict[str, float] = QUALITY) -> None:
    """The whole miniature, without the report's outputs."""
    records = root / "work" / CASE / "records" / "steps"
    records.mkdir(parents=True)
    (records / "seed0.csv").write_text("run,time_s\n0,0.0\n")
    write_models(root)
    for law, value in quality.items():
        write_validation(root, law, value)
