"""Analysers that are seldom, late and now and then without a result: what their models and laws lose by it.

``python benchmarks/operated_plants/analysers.py [PLANT ...]``: two plants (``analysed.py``), five seeds, three ways:

- true: the analyser reads at every row, as late: what nobody has, and the most that could be got.
- fresh: it reads as it does, and the record says in which rows, as ``loopwright new`` finds them of an ``analyser``.
- held: the same readings, and the last one counts in every row between, as for somebody who says nothing of it.

One record of 4,000 rows a seed, with noise and without loads; all ways have the same of other process variables. The
search for a model has a quarter of a minute (``--minutes``), which is less than the reactor's networks need. A model is
then run free over 2,000 other rows, from rest, and its outputs are compared with the true ones, late as they are,
without noise: rms in % of the standard deviation, after the first 200. ``--loops`` runs the laws of these models over a
day of 600 samples a seed instead, with loads and noise: errors and travel. ``--table FILE ...`` prints kept figures.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from analysed import DISTILLATION, SERIES
from figures import WARM_UP, run_day
from from_record import FOLDER, Fit, Served, params_of, record_of
from operated_plant import OperatedPlant

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record
from loopwright.serving import Controller

PLANTS = {p.name: p for p in (DISTILLATION, SERIES)}
WAYS = ("true", "fresh", "held")
HELD_OUT = 5_000  # added to a record's seed for the rows that judge its model
WARM_ROWS = 200  # of a free run that do not count: it begins at a rest
STEP_ROWS = 400  # of an answer to a step, which then stands
STEP_SHARE = 0.25  # of an MV's span in the record
ROWS, TEST_ROWS, MINUTES, DAY_ROWS = 4_000, 2_000, 0.25, 600


# ----------------------------------------------------------------------------------------------------------- the record
def quiet(plant: OperatedPlant) -> OperatedPlant:
    """The plant without loads."""
    return replace(plant, wanders=tuple(replace(w, sd=0.0) for w in plant.wanders))


def read_as(record: Record, plant: OperatedPlant, seed: int, way: str) -> Record:
    """The record of every row's readings as a way has it."""
    if way == "true":
        return record
    fresh = plant.fresh(len(record), np.random.default_rng(seed)) > 0
    rows, pv = np.arange(len(record)), record.pv.copy()
    for i in plant.every:
        pv[:, i] = pv[np.maximum.accumulate(np.where(fresh[:, i], rows, 0)), i]
    return replace(record, pv=pv, fresh=fresh if way == "fresh" else None)


# ------------------------------------------------------------------------------------------------------------ the model
class FreeRun:
    """A model under MVs in engineering units, from the rest that it has at the first of them."""

    def __init__(self, model: Identified) -> None:
        self.of: Mapping[str, Array] = {name: v.numpy() for name, v in model.state_dict().items()}
        self.dynamics = Dynamics(*(self.of[name] for name in ("a", "b", "c", "w1", "b1", "w2")))
        self.n_y = model.n_y

    def __call__(self, mv: Array, y0: Array) -> Array:
        """Outputs (n, n_y) under MVs (n, n_mv), begun near ``y0`` (n_y,)."""
        of = self.of
        v, y = (mv - of["v_center"]) / of["v_scale"], (y0 - of["y_center"]) / of["y_scale"]
        x = of["rest"] @ np.concatenate([y, v[0], [1.0]])
        rest = Stretch(np.tile(y, (STEP_ROWS, 1)), np.tile(v[0], (STEP_ROWS, 1)))
        settled = self.dynamics.free_run(x, rest)
        x = x if settled is None else settled[0][-1]
        found = self.dynamics.free_run(x, Stretch(np.tile(y, (len(v), 1)), v))
        if found is None:
            return np.full((len(v), self.n_y), np.nan)
        return np.asarray(found[0][: len(v), : self.n_y] * of["y_scale"] + of["y_center"])


def steps_of(plant: OperatedPlant) -> list[Array]:
    """For each MV a course (n, n_mv) that steps in row 0 from ``mv0``, which row -1 has."""
    _, mv0 = plant.start
    found = []
    for j, (low, high) in enumerate(plant.moves):
        mv = np.tile(mv0, (STEP_ROWS + 1, 1))
        mv[1:, j] += STEP_SHARE * (high - low)
        found.append(mv)
    return found


def true_course(plant: OperatedPlant, mv: Array) -> Array:
    """Outputs (n, n_pv) as they are handed over, late, without noise and loads, from the plant's rest."""
    x, _ = plant.start
    found = np.empty((len(mv), len(plant.pv)))
    for k, row in enumerate(mv):
        found[k] = plant.look(x)[1]
        x = plant.step(x, row, plant.dv0, plant.w0)
    return found


def gain_and_time(course: Array) -> tuple[float, float]:
    """Final change of an answer (n,), and when it passes 63 % of it [rows], between rows."""
    y = course - course[0]
    share = y / y[-1] if y[-1] else np.zeros(len(y))
    k = int(np.argmax(share >= 1 - np.exp(-1)))
    before = share[k - 1] if k else 0.0
    return float(y[-1]), k - 1 + float((1 - np.exp(-1) - before) / max(share[k] - before, 1e-12))


def judged(plant: OperatedPlant, model: Identified, metrics: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """The figures of a model, by process variable."""
    run = FreeRun(model)
    silent = replace(quiet(plant), noise=(0.0,) * len(plant.pv))
    test = record_of(silent, TEST_ROWS, HELD_OUT + seed)
    off = run(test.mv, test.pv[0]) - test.pv
    error = 100 * np.sqrt(np.mean(off[WARM_ROWS:] ** 2, axis=0)) / test.pv[WARM_ROWS:].std(axis=0)
    answers = [(true_course(plant, mv), run(mv, plant.look(plant.start[0])[1])) for mv in steps_of(plant)]
    found = {}
    for i, s in enumerate(plant.pv):
        of = [(gain_and_time(true[:, i]), gain_and_time(ours[:, i])) for true, ours in answers]
        found[s.name] = {
            "error": float(error[i]),
            "late": metrics.get("late", {}).get(s.name, 0),
            "gain": float(np.mean([abs(b[0] / a[0] - 1) for a, b in of])) * 100,
            "time": float(np.mean([b[1] - a[1] for a, b in of])),
            "true_time": float(np.mean([a[1] for a, _ in of])),
        }
    return found


def model_of(plant: OperatedPlant, seed: int, way: str, fit: Fit) -> tuple[Identified, Mapping[str, Any], float]:
    """The model of a record of a seed, what its search says, and its seconds."""
    return fit.learnt(plant, read_as(record_of(quiet(plant), fit.rows, seed), plant, seed, way))


def fitted(plant: OperatedPlant, seed: int, way: str, fit: Fit) -> dict[str, Any]:
    """The figures of a model of a seed."""
    model, metrics, seconds = model_of(plant, seed, way, fit)
    structure = metrics["structure"]
    line = {"plant": plant.name, "seed": seed, "way": way, "seconds": seconds, "order": structure["order"]}
    line |= {"hidden": structure["hidden"], "judged": structure["judged"], "rows": fit.rows}
    return line | {"of": judged(plant, model, metrics, seed)}


# ------------------------------------------------------------------------------------------------------------- the loop
class TakenAsNew:
    """A law whose host says of every number that it is new."""

    def __init__(self, served: Served) -> None:
        self.served = served

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        return self.served(sp, pv, dv, mv, np.ones_like(fresh))


def looped(plant: OperatedPlant, seed: int, way: str, fit: Fit) -> dict[str, Any]:
    """Errors of PVs with set points [% of these' ranges], late and seldom as they are seen, and travel [% a sample]."""
    model, _, _ = model_of(plant, seed, way, fit)
    began = time.process_time()
    params = replace(params_of(plant), tuning="given")  # a search at each of the models would take an hour
    law = Predictive.design(params, {"identified": model}, plant.signals, None).eval()
    path = FOLDER / plant.name / f"{way}-{seed}.onnx"
    export(law, path, case=plant.name, provenance={})
    seconds = time.process_time() - began
    served = Served(Controller(path))
    day = plant.day(seed, DAY_ROWS)
    if way == "true":
        day = replace(day, fresh=np.ones_like(day.fresh))
    run = run_day(plant, TakenAsNew(served) if way == "held" else served, day)
    reach = np.array([s.high - s.low for s in plant.mv])
    span = np.array([s.high - s.low for s in plant.sp])
    errors = np.abs(run.pv[WARM_UP:, : len(span)] - day.sp[WARM_UP:]) / span
    names = [s.name for s in plant.sp]
    return {
        "plant": plant.name, "seed": seed, "way": way, "design": seconds,
        "error": dict(zip(names, (100 * errors.mean(axis=0)).tolist(), strict=True)),
        "travel": float(100 * np.mean(np.abs(np.diff(run.mv[WARM_UP:], axis=0)) / reach)),
    }  # fmt: skip


# ----------------------------------------------------------------------------------------------------------- the tables
def spread(values: Sequence[float]) -> str:
    """Median of the seeds, and the largest."""
    return f"{np.median(values):6.2f} ({max(values):.2f})"


def model_table(lines: Sequence[Mapping[str, Any]]) -> str:
    """A row for each analyser and way, and one for the other process variables."""
    found = ["plant, output, way | free run [% of sd] | states | late | gain off [%] | 63 % off [rows] | s"]
    for plant in PLANTS.values():
        for i, s in enumerate(plant.pv):
            for way in WAYS:
                rows = [r for r in lines if (r["plant"], r["way"]) == (plant.name, way)]
                if not rows:
                    continue
                of = [r["of"][s.name] for r in rows]
                cells = [f"{plant.name} {s.name} ({plant.late.get(i, 0)} late) {way}", spread([o["error"] for o in of])]
                cells += [" ".join(f"{r['order']}{'+' * bool(r['hidden'])}" for r in rows)]
                cells += [" ".join(str(o["late"]) for o in of), spread([o["gain"] for o in of])]
                cells += [spread([abs(o["time"]) for o in of])]
                found.append(" | ".join([*cells, f"{np.median([r['seconds'] for r in rows]):.0f}"]))
    return "\n".join(found)


def loop_table(lines: Sequence[Mapping[str, Any]]) -> str:
    """A row for each plant and way."""
    found = ["plant, way | error of each set point [% of its range] | travel [% a sample] | design [s]"]
    for plant in PLANTS.values():
        for way in WAYS:
            rows = [r for r in lines if (r["plant"], r["way"]) == (plant.name, way)]
            if rows:
                errors = [f"{s.name} {spread([r['error'][s.name] for r in rows])}" for s in plant.sp]
                travel, seconds = ([r[key] for r in rows] for key in ("travel", "design"))
                found.append(f"{plant.name} {way} | {', '.join(errors)} | {spread(travel)} | {np.median(seconds):.0f}")
    return "\n".join(found)


def main(argv: list[str]) -> int:
    """Print a line of figures a model or a day, and the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("plants", nargs="*", choices=[[], *PLANTS], help="(default: both)")
    parser.add_argument("--ways", nargs="*", choices=WAYS, default=list(WAYS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3, 4, 5])
    parser.add_argument("--rows", type=int, default=ROWS, help=f"of the record ({ROWS})")
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"of a model's search ({MINUTES:g})")
    parser.add_argument("--loops", action="store_true", help="days of the laws instead of the models")
    parser.add_argument("--json", type=Path, help="file of the figures, one line each; they are added to it")
    parser.add_argument("--table", type=Path, nargs="*", help="files of figures: prints their table, and runs nothing")
    options = parser.parse_args(argv)
    if options.table:
        kept = [json.loads(line) for file in options.table for line in file.read_text().splitlines()]
        print(loop_table(kept) if options.loops else model_table(kept))
        return 0
    torch.set_num_threads(1)
    fit, lines = Fit(options.rows, options.minutes, networks=True), []
    for seed in options.seeds:
        for name in options.plants or PLANTS:
            for way in options.ways:
                try:
                    line = (looped if options.loops else fitted)(PLANTS[name], seed, way, fit)
                except LawError as refused:
                    print(f"{name}, seed {seed}, {way}: {refused}", flush=True)
                    continue
                print(json.dumps(line), flush=True)
                lines.append(line)
                if options.json is not None:
                    with options.json.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(line) + "\n")
    print(loop_table(lines) if options.loops else model_table(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
