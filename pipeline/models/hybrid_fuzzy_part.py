"""How a hybrid fuzzy model is learnt from a record, and what is reported of one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import linalg

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.metrics import r2, rmse
from loopwright.pipeline.models.base import Model, simulate
from loopwright.pipeline.models.hybrid_fuzzy import COEFFICIENTS, HybridFuzzy
from loopwright.pipeline.models.part import Learnt, Part, Source, predict
from loopwright.pipeline.models.training.regressors import split_in_time
from loopwright.pipeline.plants.simulator import Array, Signals, Simulator
from loopwright.pipeline.records.record import Record

How = Literal["tied", "global", "local"]
MODES: Mapping[int, str] = {1: "hot", 2: "cold"}
SIGN: Mapping[str, float] = {"b_hot": 1.0, "b_cold": -1.0}
# [degC a period] that full flow does at least: at its inlet's temperature a valve does nothing
LEAST_VALVE_EFFECT = 0.01
MODE_ROUNDING = 1e-6  # of a mode that went through a file
OPEN_COEFFICIENT = 1e-3  # of a unit vector: from where on a coefficient has part in what the data leave open


@dataclass(frozen=True, slots=True, eq=False)
class Transitions:
    """Pairs of samples of a record: state and move before, state after; no pair reaches over the end of a run."""

    before: Array  # (N, 4) T, T_w, k_M, mode
    after: Array  # (N, 2) T, T_w
    row: NDArray[np.int64]  # (N,) of the record, ascending

    @classmethod
    def of(cls, record: Record) -> Self:
        """All pairs of a record with the PVs T, T_w and the MVs k_M, mode; raises ModelError, RecordError."""
        if record.pv.shape[1] != 2 or record.mv.shape[1] != 2:
            names = ", ".join(s.name for s in (*record.pv_signals, *record.mv_signals))
            raise ModelError(f"a hybrid fuzzy model needs the PVs T, T_w and the MVs k_M, mode; the record has {names}")
        name, mode = record.mv_signals[1].name, np.rint(record.mv[:, 1])
        strange = record.mv[~np.isin(mode, list(MODES)) | (np.abs(record.mv[:, 1] - mode) > MODE_ROUNDING), 1]
        if strange.size:
            raise ModelError(f"the record's {name} is {strange[0]:g} somewhere; it must be 1 (hot) or 2 (cold)")
        k = record.starts(1)
        missing = [f"{q} ({word})" for q, word in MODES.items() if q not in mode[k]]
        if missing:
            raise ModelError(f"the record's {name} is never {missing[0]}; record pulses of both modes")
        return cls(np.column_stack([record.pv[k], record.mv[k, 0], mode[k]]), record.pv[k + 1], k)


def identify(data: Transitions, centres: Sequence[float], how: How) -> HybridFuzzy:
    """The hybrid fuzzy model of hot and cold mode that fits the pairs.

    With the memberships beta_j(k) of the rules and psi = [T_w, T, k_M, 1]:

    - ``local``: each rule of a mode for itself, min sum_k (beta_j(k) [T_w(k+1) - psi(k)' theta_j])^2.
      A rule then explains its whole triangle alone, though its neighbours add to it there.
    - ``global``: all rules of a mode together, min sum_k (T_w(k+1) - sum_j beta_j(k) psi(k)' theta_j)^2.
    - ``tied``: so, with both modes together and a1, a2, r the same in both. The valves tell the modes
      apart by what they let in, and nothing else: with the throttle shut both modes must do the same, or
      there are temperatures between the modes' ranges that neither reaches.

    Between the outer centres sum_j beta_j c_j = T_w, so that adding d to every a1_j and -d c_j to every
    r_j changes nothing there: data cannot tell. Rules that are fitted together therefore have an r without
    slope over the centres, each counted by its share of the data; what follows T_w belongs to a1.

    The hot valve heats and the cold one cools, LEAST_VALVE_EFFECT at least, so that the model has an inverse: where the
    jacket is as warm as the inlet, b is nothing and its estimate may have either sign.

    The core is one least-squares line, T(k+1) - T(k) = c_w (T_w(k) - T(k)), c_t = 1 - c_w: it exchanges
    heat with the jacket alone, so that at equal temperatures nothing moves.

    Raises ModelError where the pairs leave a coefficient undetermined, or the centres do not ascend.

    Source: [karer, section 5.2], which leaves the identification to its
    reference [8]: rows multiplied by their membership, rule by rule.
    """
    # Refuses centres that cannot be, before anything is divided by their distances.
    HybridFuzzy(centres, np.zeros((1, len(COEFFICIENTS), len(centres))).tolist(), (0.0, 1.0))
    t, t_w, k_m, mode = data.before.T
    target = data.after[:, 1]
    rules = Rules(np.asarray(centres, dtype=np.float64), t_w)
    psi = np.column_stack([t_w, t, k_m, np.ones_like(t)])  # beside a1, a2, b, r
    if how == "tied":
        theta = _tied(rules, psi, target, mode)
    else:
        fit = _global if how == "global" else _local
        chosen = {word: mode == q for q, word in MODES.items()}
        theta = np.stack([fit(rules.at(rows), psi[rows], target[rows], word) for word, rows in chosen.items()])
    c_w = float(_solved((t_w - t)[:, None], data.after[:, 0] - t, ["c_w of the core"])[0])
    return HybridFuzzy(centres, theta.tolist(), (c_w, 1 - c_w))


class Rules:
    """Centres (K,) and the memberships beta (N, K) of jacket temperatures (N,) in them."""

    def __init__(self, centres: Array, t_w: Array) -> None:
        self.centres, self.t_w = centres, t_w
        into = np.clip((t_w[:, None] - centres[:-1]) / np.diff(centres), 0.0, 1.0)
        self.beta = -np.diff(into, axis=1, prepend=1.0, append=0.0)

    def at(self, rows: NDArray[np.bool_]) -> Rules:
        """The rules at some of the rows."""
        return Rules(self.centres, self.t_w[rows])

    def basis(self, name: str) -> Array:
        """Basis of a coefficient over the centres, shape (K, m): it may be anything, but r has no slope."""
        if name != "r":
            return np.eye(len(self.centres))
        share = self.beta.mean(axis=0)
        return linalg.null_space((share * (self.centres - share @ self.centres))[None, :])


def _local(rules: Rules, psi: Array, target: Array, mode: str) -> Array:
    """Consequents of one mode, shape (4, K)."""
    names = [[f"{name}_{mode}_{c:g}" for name in COEFFICIENTS] for c in rules.centres]
    fitted = [_solved(w[:, None] * psi, w * target, n) for w, n in zip(rules.beta.T, names, strict=True)]
    return np.stack(fitted, axis=1)


def _global(rules: Rules, psi: Array, target: Array, mode: str) -> Array:
    """Consequents of one mode, shape (4, K)."""
    return _blended(rules, psi, target, [(name, mode) for name in COEFFICIENTS])


def _tied(rules: Rules, psi: Array, target: Array, mode: Array) -> Array:
    """Consequents of both modes, shape (2, 4, K), of which only row b differs."""
    t_w, t, k_m, one = psi.T
    columns = np.column_stack([t_w, t, one, *(k_m * (mode == q) for q in MODES)])
    labels = [(name, "both") for name in ("a1", "a2", "r")] + [("b", word) for word in MODES.values()]
    a1, a2, r, *b = _blended(rules, columns, target, labels)
    return np.array([[a1, a2, of_mode, r] for of_mode in b])


def _blended(rules: Rules, columns: Array, target: Array, labels: Sequence[tuple[str, str]]) -> Array:
    """Least squares of sum_j beta_j columns' theta_j; theta, shape (n_columns, K), its rows labelled (name, mode)."""
    bases = [rules.basis(name) for name, _ in labels]
    design = np.hstack([column[:, None] * (rules.beta @ b) for column, b in zip(columns.T, bases, strict=True)])
    names = [
        f"{name}_{mode}" + (f"_{rules.centres[j]:g}" if name != "r" else "")
        for (name, mode), b in zip(labels, bases, strict=True)
        for j in range(b.shape[1])
    ]
    parts = np.split(_solved(design, target, names), np.cumsum([b.shape[1] for b in bases])[:-1])
    return np.stack([b @ part for b, part in zip(bases, parts, strict=True)])


def _solved(design: Array, target: Array, names: Sequence[str]) -> Array:
    """Least squares in which every b has the sign of its valve, by fixing those that would not at LEAST_VALVE_EFFECT.

    Raises ModelError as ``_least_squares`` does.
    """
    sign = np.array([SIGN.get(name.rsplit("_", 1)[0], 0.0) for name in names])
    found, free = np.zeros(len(names)), np.ones(len(names), dtype=bool)
    while True:
        rest = target - design[:, ~free] @ found[~free]
        found[free] = _least_squares(
            design[:, free], rest, [n for n, is_free in zip(names, free, strict=True) if is_free]
        )
        wrong = free & (sign != 0) & (sign * found < LEAST_VALVE_EFFECT)
        if not wrong.any():
            return found
        found[wrong] = LEAST_VALVE_EFFECT * sign[wrong]
        free &= ~wrong


def _least_squares(design: Array, target: Array, names: Sequence[str]) -> Array:
    """Least squares, each column scaled to length 1 so that the rank is judged alike for all.

    Raises ModelError that names the columns with a share in a direction that the data do not see.
    """
    length = np.linalg.norm(design, axis=0)
    scaled = design / np.where(length > 0, length, 1.0)
    solution, _, rank, _ = np.linalg.lstsq(scaled, target, rcond=None)
    if rank < design.shape[1]:
        unseen = np.linalg.norm(np.linalg.svd(scaled.T @ scaled)[2][int(rank) :], axis=0)
        which = dict.fromkeys(name for name, share in zip(names, unseen, strict=True) if share > OPEN_COEFFICIENT)
        raise ModelError(
            f"the data do not determine {', '.join(which)}: record pulses of both modes over the whole range of "
            "the jacket's temperature, or leave out centres where there are none"
        )
    return np.asarray(solution / length)


# --------------------------------------------------------------------------------------------------- the part of a set
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
