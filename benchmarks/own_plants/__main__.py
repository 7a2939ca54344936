"""From a record to a controller on plants that no case has: the predictive law beside a PID and the perfect NMPC.

``python benchmarks/own_plants [--rows N] [--tuning search|given] [PLANT ...]``; without plants, all of them; a row a
plant as it comes, some minutes each at first (fits and NMPC are kept in the folder for temporary files). The record
holds an operator's random moves and measurement noise. The model and the law know the record alone, with all
defaults. The PID is tuned in closed loop on the true plant, with its noise; the NMPC knows the true equations and the
state. Figures: mean absolute error in % of the set points' range, on random set points, after unmeasured loads at the
MVs, and after upsets at the outputs, none of which anyone has seen, of the true output under measurement noise (of the
NMPC without noise); travel in % of the MVs' range a sample, on set points. The method was chosen with the plants of
DEVELOPMENT in sight; those of UNTOUCHED are reported as they come. ``--run`` sends the records through `loopwright new`
and `loopwright run` instead, gates and all, and steps the files that are shipped; also of the plants of FURTHER.

``python benchmarks/own_plants --closed PLANT ... [--rows N] [--fit]``: the plants whose records were taken in closed
loop, and what the product makes of the file of a historian (``closed_benchmark.py``); ``--closed development`` is the
half that may be looked at while a method is chosen. 3 to 5 minutes of two cores a plant, with ``--fit`` 1 to 2.
``--observed PLANT ...``: what the NMPC reaches behind a Kalman filter, with the noise that a controller has
(``observed.py``); some minutes a plant.
``--cold PLANT ...``: how far from the record's MVs the predictive law asks for where it is started cold at rests of the
record (``cold.py``); some minutes a plant.
``--refused [KIND ...]``: records of which no controller may come, and how many slip through (``closed_refused.py``).
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # what all benchmarks share

import numpy as np
import torch
from closed_benchmark import PLANTS, closed_main
from closed_development import CLOSED_DEVELOPMENT
from closed_refused import KINDS, MINUTES, refused_main
from closed_untouched import CLOSED_UNTOUCHED
from cold import COLD_HEAD, COLD_ROWS, cold_row
from development import DEVELOPMENT
from further import FURTHER
from loops import Score, scored
from observed import observed_main
from open_product import run_row
from plant import OwnPlant
from store import bound_of, model_of
from untouched import UNTOUCHED

from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.laws.base import ControlLaw
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.plants.simulator import PerturbedPlant

ROWS, CLOSED_ROWS = 8_000, 12_000
GROUPS = {
    "development": [p.name for p in CLOSED_DEVELOPMENT],
    "untouched": [p.name for p in CLOSED_UNTOUCHED],
    "all": list(PLANTS),
}
HEAD = (
    f"{'':12} {'set points: nMAE [%]':^40} | {'travel':^11} | {'loads':^11} | {'upsets':^11} | {'fit':>5} {'law':>5}\n"
    f"{'plant':12} {'PID':>7} {'NMPC':>7} {'ours':>7} {'/NMPC':>8} {'/PID':>7} | {'PID':>5} {'ours':>5} |"
    f" {'PID':>5} {'ours':>5} | {'PID':>5} {'ours':>5} | {'[s]':>5} {'[s]':>5}"
)


def pid_of(plant: OwnPlant) -> ControlLaw | None:
    """The PID tuned on the true plant, of the least cost; None where it controls no such plant."""
    simulated = PerturbedPlant(plant, {}) if len(plant.mv_signals) == 1 else plant
    try:
        found = PID.design(PID.Params(), {}, plant.signals, simulated)
        # Calm settings err more: a law ahead of them would be ahead of less than a PID can do.
        return PID(plant.signals, found.tried[0].loops, pairs=found.pairs).eval()
    except PipelineError as error:
        print(f"  {plant.name}: no PID: {error}", file=sys.stderr)
        return None


@dataclass(frozen=True, slots=True)
class Row:
    """Of one plant: its text, and our errors over the NMPC's on set points, and over the PID's by test."""

    text: str
    over_bound: float
    over_pid: Mapping[str, float]


def row_of(plant: OwnPlant, rows: int, tuning: str) -> Row:
    """Fit, design, and run the loops."""
    model, fitted = model_of(plant, rows)
    predictive, began = LAWS["predictive"], time.process_time()
    params = predictive.Params(tuning=tuning)
    law = predictive.design(params, {"identified": model}, plant.signals, None).eval()
    designed = time.process_time() - began
    ours, pid, bound = scored(law, plant), pid_of(plant), bound_of(plant)
    theirs = {} if pid is None else scored(pid, plant)
    over_pid = {test: ours[test].nmae / score.nmae for test, score in theirs.items()}
    of_test = " | ".join(f"{_text(theirs.get(test), 'nmae'):>5} {ours[test].nmae:5.2f}" for test in ("loads", "upsets"))
    sp = ours["set points"]
    text = (
        f"{plant.name:12} {_text(theirs.get('set points'), 'nmae'):>7} {bound:7.2f} {sp.nmae:7.2f}"
        f" {sp.nmae / bound:8.2f} {over_pid.get('set points', np.nan):7.2f} |"
        f" {_text(theirs.get('set points'), 'travel'):>5} {sp.travel:5.2f} | {of_test} | {fitted:5.0f} {designed:5.0f}"
    )
    return Row(text, sp.nmae / bound, over_pid)


def _text(score: Score | None, of: str) -> str:
    return "-" if score is None else f"{getattr(score, of):.2f}"


def main(argv: list[str]) -> int:
    """Print a row a plant."""
    plants = {p.name: p for p in (*DEVELOPMENT, *UNTOUCHED, *FURTHER)}
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("plants", nargs="*", choices=[[], *plants], help="(default: all)")
    parser.add_argument("--rows", type=int, help=f"of the record ({ROWS}, of --closed {CLOSED_ROWS})")
    parser.add_argument("--tuning", choices=["search", "given"], default="search", help="of the law (search)")
    add = parser.add_argument
    add("--run", action="store_true", help="through `new` and `run`, to the files that are shipped")
    closed = [*PLANTS, *GROUPS]
    what = "plants in closed-loop records instead, through `new` and `run`"
    add("--closed", nargs="*", choices=closed, metavar="PLANT", help=f"{what}: {', '.join(closed)} (development)")
    add("--fit", action="store_true", help="of --closed: model and predictive law alone, no stages")
    add("--seed", type=int, default=0, help="of the records of --closed (0)")
    every = [*plants, *PLANTS]
    add("--cold", nargs="*", choices=[*plants, *PLANTS], metavar="PLANT", help="laws started cold at rests (all)")
    add("--observed", nargs="*", choices=every, metavar="PLANT", help="the NMPC behind a filter instead (all)")
    add("--sequences", type=int, default=3, help="of the tests of --observed (3)")
    add("--refused", nargs="*", choices=[*KINDS], metavar="KIND", help=f"records to refuse: {', '.join(KINDS)} (all)")
    add("--count", type=int, default=20, help="of each kind of --refused (20)")
    add("--minutes", type=float, default=MINUTES, help=f"of a model's search, of --refused and --cold ({MINUTES:g})")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    if options.closed is not None:
        names = [n for name in options.closed or ["development"] for n in GROUPS.get(name, [name])]
        rows = options.rows or CLOSED_ROWS
        return closed_main(names, rows, fit=options.fit, seed=options.seed, pid_of=pid_of)
    if options.cold is not None:
        print(COLD_HEAD)
        for name in options.cold or [*plants, *PLANTS]:
            print(cold_row((plants | PLANTS)[name](), options.rows or COLD_ROWS, options.minutes), flush=True)
        return 0
    if options.observed is not None:
        return observed_main([(plants | PLANTS)[name]() for name in options.observed or every], options.sequences)
    if options.refused is not None:
        return refused_main(options.refused or list(KINDS), options.count, options.minutes)
    options.rows = options.rows or ROWS
    if options.run:
        for name in options.plants or plants:
            print(run_row(plants[name](), options.rows), flush=True)
        return 0
    print(HEAD)
    found = []
    for name in options.plants or [p.name for p in (*DEVELOPMENT, *UNTOUCHED)]:
        found.append(row_of(plants[name](), options.rows, options.tuning))
        print(found[-1].text, flush=True)
    over = [row.over_bound for row in found if np.isfinite(row.over_bound)]
    if over:
        print(f"over the NMPC {statistics.median(over):.2f} in the median, {max(over):.2f} at worst")
    print("ahead of the PID:")
    for test in ("set points", "loads", "upsets"):
        by_pid = [row.over_pid[test] for row in found if test in row.over_pid]
        print(f"  {test}: {sum(v < 1 for v in by_pid)} of {len(by_pid)}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
