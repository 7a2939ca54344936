"""How a hybrid fuzzy model is learnt from a record, and what is reported of one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from loopwright.pipeline.metrics import r2, rmse
from loopwright.pipeline.models.base import Model, simulate
from loopwright.pipeline.models.fuzzy.hybrid_fuzzy import COEFFICIENTS, HybridFuzzy
from loopwright.pipeline.models.fuzzy.hybrid_fuzzy_identification import MODES, Transitions, identify
from loopwright.pipeline.models.part import Learnt, Part, Source, predict
from loopwright.pipeline.models.training.regressors import split_in_time
from loopwright.pipeline.plants.signals import Signals
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.records.record import Record

Identification = Literal["tied", "global", "local"]
GRID_DEGC = 0.5  # of the search for gaps


@dataclass(frozen=True, kw_only=True)
class HybridFuzzyPart(Part):
    """A hybrid fuzzy model of a jacketed vessel with a hot and a cold mode, by least squares over a record.

    ``identification`` is what the modes share (hybrid_fuzzy_identification). ``centres`` are the rules' jacket
    temperatures [degC]. ``free_run`` is the length of the free runs whose error is reported [samples].
    ``train_fraction`` of the record trains, the rest validates.
    """

    model: ClassVar[type[Model]] = HybridFuzzy
    identification: Identification
    centres: tuple[float, ...]
    train_fraction: float = 0.7
    free_run: int = 360

    def __post_init__(self) -> None:
        if self.free_run < 1:
            raise ValueError(f"free_run is {self.free_run}; it must be at least 1")

    def learn(self, source: Source) -> Learnt:
        """The model; its figures are over the last part of the record, which no identification saw."""
        train, _ = split_in_time(source.data(self.model.kind), self.train_fraction)
        model = identify(Transitions.of(train), self.centres, self.identification)
        return Learnt(model, figures(model, source, self.train_fraction, self.free_run))


def figures(model: HybridFuzzy, source: Source, train_fraction: float, free_run: int) -> dict[str, Any]:
    """Figures of a model: gap and coefficients, and with a record the errors over its last part."""
    own = {**gap(model, source.signals), **coefficients(model, source.plant)}
    if source.record is None:
        return own
    train, validation = split_in_time(source.record, train_fraction)
    return {**_scored(model, validation, free_run), "n_train": len(Transitions.of(train).row), **own}


def _scored(model: HybridFuzzy, validation: Record, free_run: int) -> dict[str, float]:
    """Errors of the jacket and of the core, one step ahead and running free [degC]."""
    data = Transitions.of(validation)
    ahead = predict(model, data.before)
    run, measured = _free(model, validation, free_run)
    return {
        "rmse": rmse(data.after[:, 1], ahead[:, 1]),
        "r2": r2(data.after[:, 1], ahead[:, 1]),
        "core_rmse": rmse(data.after[:, 0], ahead[:, 0]),
        "free_run_rmse": rmse(measured[..., 1], run[..., 1]),
        "free_run_core_rmse": rmse(measured[..., 0], run[..., 0]),
    }


def _free(model: HybridFuzzy, record: Record, samples: int) -> tuple[Array, Array]:
    """(predicted, measured) states of free runs end to end through the record, shape (runs, samples, 2)."""
    k = record.starts(samples)
    # Each begins where the one before has ended; what is left at the end of a run is not used.
    first = [int(k[0])]
    for start in k[1:]:
        if start >= first[-1] + samples:
            first.append(int(start))
    window = np.array(first)[:, None] + np.arange(samples)
    with torch.no_grad():
        run = simulate(model, torch.from_numpy(record.pv[window[:, 0]]), torch.from_numpy(record.mv[window]))
    return run.numpy(), record.pv[window + 1]


def gap(model: HybridFuzzy, signals: Signals) -> dict[str, float]:
    """Jacket temperatures a step ahead that lie between the modes' ranges, and those that lie in both [degC].

    With the throttle shut, mode hot leads to base_1 and can only be hotter, mode cold to base_2 and can
    only be colder: base_1 - base_2 above 0 is a gap that no throttle reaches, below 0 an overlap. The
    figures are the widest over jacket temperatures from the second to the last centre and core
    temperatures over the set points' range.
    """
    sp = signals.sp[0]
    low, high = float(model.centres[1]), float(model.centres[-1])
    t, t_w = np.meshgrid(np.arange(sp.low, sp.high + GRID_DEGC, GRID_DEGC), np.arange(low, high + GRID_DEGC, GRID_DEGC))
    with torch.no_grad():
        base = model.jacket(*(torch.from_numpy(v.reshape(-1, 1)) for v in (t, t_w))).base.numpy()
    between = base[:, 0] - base[:, 1]
    return {"gap": max(0.0, float(between.max())), "overlap": max(0.0, float(-between.min()))}


def coefficients(model: HybridFuzzy, plant: Simulator | None) -> dict[str, dict[str, float]]:
    """The model's coefficients by name (``b_hot_40``), and what the plant itself, if there is one, does over a period.

    ``physics`` is the plant's own line at the centres, with T = T_w there: slopes in T_w and T with the throttle
    shut; b the chord from shut to a quarter open, the pulses' mean opening (it bends: an open throttle gains less).
    """
    at = model.centres.tolist()
    theta = model.consequents.tolist()
    found: dict[str, dict[str, float]] = {"parameters": {"core_jacket": float(model.core[0])}, "physics": {}}
    truth = None
    if plant is not None:
        truth = np.stack([_plant_line(plant, c) for c in at], axis=-1)
        dv, p = plant.dv_nominal, plant.parameters()
        moved = [float(plant.step(np.array([0.0, v]), np.array([0.0, 1.0]), dv, p)[0]) for v in (20.0, 21.0)]
        found["physics"]["core_jacket"] = moved[1] - moved[0]
    for q, mode in enumerate(MODES.values()):
        for i, name in enumerate(COEFFICIENTS):
            for j, centre in enumerate(at):
                key = f"{name}_{mode}_{centre:g}"
                found["parameters"][key] = theta[q][i][j]
                if truth is not None:
                    found["physics"][key] = float(truth[q, i, j])
    return found


def _plant_line(plant: Simulator, at: float, opening: float = 0.25, step: float = 0.5) -> Array:
    """a1, a2, b, r of both modes around T = T_w = ``at``, shape (2, 4), from the plant's steps."""
    dv, p = plant.dv_nominal, plant.parameters()

    def jacket(t: float, t_w: float, k_m: float, mode: float) -> float:
        return float(plant.step(np.array([t, t_w]), np.array([k_m, mode]), dv, p)[1])

    rows = []
    for q in MODES:
        a1 = (jacket(at, at + step, 0.0, q) - jacket(at, at - step, 0.0, q)) / (2 * step)
        a2 = (jacket(at + step, at, 0.0, q) - jacket(at - step, at, 0.0, q)) / (2 * step)
        base = jacket(at, at, 0.0, q)
        b = (jacket(at, at, opening, q) - base) / opening
        rows.append([a1, a2, b, base - (a1 + a2) * at])
    return np.array(rows)
