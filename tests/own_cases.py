"""Own plants with models made by hand, in the present folder. Not a test."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from identified_models import scaled_model

from loopwright.pipeline.cases.own_plant import OwnCase, own_case
from loopwright.pipeline.laws import ControlLaw
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory, simulate_closed
from loopwright.serving.manifest import Signal

GAINS = np.array([[2.0, -0.8], [0.6, 1.5]])
POLES = (np.array([0.9, 0.8]), np.array([0.88, 0.82]), np.array([0.91, 0.78]))
RATE = 0.06  # of the level, a period at full MV


def section(n_y: int, n_mv: int, **more: Any) -> dict[str, Any]:
    pv = [{"name": f"y{i}", "unit": "m", "low": -3.0, "high": 3.0} for i in range(n_y)]
    mv = [{"name": f"u{i}", "unit": "V", "low": -1.0, "high": 1.0} for i in range(n_mv)]
    return {"period_s": 1.0, "pv": pv, "mv": mv, "dv": [], "data": "data/it/record.parquet", "source": [], **more}


def case_of(
    entry: dict[str, Any], models: list[Any], pv: np.ndarray, mv: np.ndarray, dv: np.ndarray | None = None
) -> OwnCase:
    """The case in the present folder with a record and models, the first of them the law's."""
    Path("params.yaml").write_text(yaml.safe_dump({"plants": {"it": entry}, "cases": {}}))
    groups = {k: tuple(Signal(**s) for s in entry[k]) for k in ("pv", "mv", "dv")}
    signals = Signals(1.0, groups["pv"], groups["pv"], groups["dv"], groups["mv"])
    Path("data/it").mkdir(parents=True, exist_ok=True)
    Record.of(signals, pv, mv, dv=dv).write(Path(entry["data"]))
    folder = Path("work/it/models/identified/seed0")
    folder.mkdir(parents=True, exist_ok=True)
    for name, model in zip(("identified", "plant1", "plant2"), models, strict=True):
        model.save(folder / f"{name}.npz")
    case = own_case("it")
    assert isinstance(case, OwnCase)
    return case


def two_lags() -> OwnCase:
    """Two lags that both MVs move."""
    rng = np.random.default_rng(0)
    mv = np.repeat(rng.uniform(-0.6, 0.6, (40, 2)), 25, axis=0)
    y = np.zeros((len(mv), 2))
    for k in range(len(mv) - 1):
        y[k + 1] = y[k] + (1 - POLES[0]) * (GAINS @ mv[k] - y[k])
    rest = np.eye(2, 5)
    models = [scaled_model(2, 2, 0, 2, a=np.diag(p), b=(1 - p)[:, None] * GAINS, rest=rest) for p in POLES]
    return case_of(section(2, 2), models, y, mv)


def filled_level() -> OwnCase:
    """A level that the valve fills through a lag, and that does not stand still at the valve's median."""
    rng, mv, y = np.random.default_rng(0), np.zeros((900, 1)), np.zeros((900, 1))
    a, b, c = np.array([[1.0, RATE], [0.0, 0.5]]), np.array([[0.0], [0.5]]), np.array([-0.2 * RATE, 0.0])
    x = np.zeros(2)
    for k in range(900):
        y[k] = x[0]
        if k % 15 == 0:
            mv[k:] = np.clip(0.2 - 0.5 * x[0] + rng.uniform(-0.7, 0.9), -1, 1)
        x = a @ x + b @ mv[k] + c
    rest = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    models = [scaled_model(1, 1, 0, 2, a=a, b=b * s, c=c, rest=rest) for s in (1.0, 0.9, 1.1)]
    return case_of(section(1, 1), models, y, mv)


def loop_of(law: ControlLaw, test: Scenario) -> Trajectory:
    """A law in closed loop over the plant of a test without measured disturbances."""
    state = torch.zeros(law.n_state, dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.float64)

    @torch.no_grad()
    def step(sp: np.ndarray, pv: np.ndarray, mv: np.ndarray) -> tuple[np.ndarray, list[float]]:
        nonlocal state
        out, state, _ = law(*(torch.from_numpy(v) for v in (sp, pv)), none, torch.from_numpy(mv), state)
        return out.numpy(), []

    assert test.plant is not None
    return simulate_closed(test.plant, step, test)


def controllers_of_a_lag(
    controllers: dict[str, dict[str, Any]],
    gain: float = 2.0,
    moved: tuple[float, float] = (-0.6, 0.6),
    noise: float = 0.01,
    rows_a_hold: int = 10,
) -> OwnCase:
    """A lag in params.yaml, with a record, models that need no training, and these controllers of it.

    The record's MV was ``moved`` between two values and held for ``rows_a_hold``; ``noise`` is what the models say of
    the measurement.
    """
    poles = (0.6, 0.55, 0.65)
    mv = np.repeat(np.random.default_rng(0).uniform(*moved, (40, 1)), rows_a_hold, axis=0)
    y = np.full((len(mv), 1), gain * mv[0])
    for k in range(len(mv) - 1):
        y[k + 1] = poles[0] * y[k] + (1 - poles[0]) * gain * mv[k]
    common = {"rest": np.eye(1, 3), "noise": np.array([noise])}
    lags = [scaled_model(1, 1, 0, 1, a=np.array([[p]]), b=np.array([[gain * (1 - p)]]), **common) for p in poles]
    case = case_of(section(1, 1), lags, y, mv)
    (case.models.parent / "metrics.json").write_text(json.dumps({"data": {"0": "x"}, "parts": {}}))
    tree = yaml.safe_load(Path("params.yaml").read_text())
    own = {"case": "it", "model": "identified"}
    tree["cases"] = {"it": {"held_out_seeds": [9001, 9002]}}
    tree["models"] = {"it-identified": {**own, "data": "data/it/record.parquet", "parts": {}}}
    tree["controllers"] = {f"it-{name}": {**own, "name": name, **its} for name, its in controllers.items()}
    Path("params.yaml").write_text(yaml.safe_dump(tree))
    return case
