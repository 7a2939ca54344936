"""From a record to a controller on plants that no case has: the predictive law beside a PID and the perfect NMPC.

``python benchmarks/own_plants [--rows N] [--tuning search|given] [PLANT ...]``; without plants, all of them; a row a
plant as it comes, some minutes each at first (fits and NMPC are kept in the folder for temporary files). The record
holds an operator's random moves and measurement noise. The model and the law know the record alone, with all
defaults. The PID is tuned in closed loop on the true plant, with its noise; the NMPC knows the true equations and the
state. Figures: mean absolute error in % of the set points' range, on random set points and after unmeasured loads
that no one has seen, the true output under measurement noise (of the NMPC without noise); travel in % of the MVs'
range a sample, on set points. The method was chosen with the plants of DEVELOPMENT in sight; those of UNTOUCHED are
reported as they come.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time

import torch
from development import DEVELOPMENT
from loops import Score, closed, scores, tests_of
from plant import OwnPlant
from store import bound_of, model_of
from untouched import UNTOUCHED

from pipeline.errors import PipelineError
from pipeline.laws import LAWS
from pipeline.laws.base import ControlLaw
from pipeline.plants.spoilt import SpoiltPlant

HEAD = (
    f"{'':12} {'set points: nMAE [%]':^40} | {'travel':^11} | {'loads':^11} | {'fit':>5} {'law':>5}\n"
    f"{'plant':12} {'PID':>7} {'NMPC':>7} {'ours':>7} {'/NMPC':>8} {'/PID':>7} | {'PID':>5} {'ours':>5} |"
    f" {'PID':>5} {'ours':>5} | {'[s]':>5} {'[s]':>5}"
)


def pid_of(plant: OwnPlant) -> ControlLaw | None:
    """The PID tuned on the true plant; None where it controls no such plant."""
    pid = LAWS["pid"]
    simulated = SpoiltPlant(plant, {}) if len(plant.mv_signals) == 1 else plant
    try:
        return pid.design(pid.Params(), {}, plant.signals, simulated).eval()
    except PipelineError as error:
        print(f"  {plant.name}: no PID: {error}", file=sys.stderr)
        return None


def scored(law: ControlLaw, plant: OwnPlant) -> dict[str, Score]:
    """Of one law, by test."""
    found = {}
    for name, tests in tests_of(plant).items():
        y, u = closed(law, plant, tests)
        found[name] = scores(plant, tests, y[0], u[0])
    return found


def row_of(plant: OwnPlant, rows: int, tuning: str) -> tuple[str, float, float | None, float | None]:
    """The row of one plant; and ours over the NMPC, over the PID, and over the PID after loads."""
    model, fitted = model_of(plant, rows)
    predictive, began = LAWS["predictive"], time.process_time()
    params = predictive.Params(tuning=tuning)
    law = predictive.design(params, {"identified": model}, plant.signals, None).eval()
    designed = time.process_time() - began
    ours, pid, bound = scored(law, plant), pid_of(plant), bound_of(plant)
    sp, load = ours["set points"], ours["loads"]
    theirs = None if pid is None else scored(pid, plant)
    their = ["-"] * 3 if theirs is None else [f"{v:.2f}" for v in _figures(theirs)]
    by_pid = [None, None] if theirs is None else [sp.nmae / _figures(theirs)[0], load.nmae / _figures(theirs)[2]]
    ratio = "-" if by_pid[0] is None else f"{by_pid[0]:.2f}"
    text = (
        f"{plant.name:12} {their[0]:>7} {bound:7.2f} {sp.nmae:7.2f} {sp.nmae / bound:8.2f} {ratio:>7} |"
        f" {their[1]:>5} {sp.travel:5.2f} | {their[2]:>5} {load.nmae:5.2f} | {fitted:5.0f} {designed:5.0f}"
    )
    return text, sp.nmae / bound, by_pid[0], by_pid[1]


def _figures(of: dict[str, Score]) -> tuple[float, float, float]:
    return of["set points"].nmae, of["set points"].travel, of["loads"].nmae


def main(argv: list[str]) -> int:
    """Print a row a plant."""
    plants = {p.name: p for p in (*DEVELOPMENT, *UNTOUCHED)}
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("plants", nargs="*", choices=[[], *plants], help="(default: all)")
    parser.add_argument("--rows", type=int, default=8_000, help="of the record (8000)")
    parser.add_argument("--tuning", choices=["search", "given"], default="search", help="of the law (search)")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    print(HEAD)
    found = []
    for name in options.plants or plants:
        text, *ratios = row_of(plants[name](), options.rows, options.tuning)
        print(text, flush=True)
        found.append(ratios)
    over = [r[0] for r in found]
    by_pid, by_load = ([r[i] for r in found if r[i] is not None] for i in (1, 2))
    ahead = [f"{sum(v < 1 for v in values)} of {len(values)}" for values in (by_pid, by_load)]
    print(
        f"over the NMPC {statistics.median(over):.2f} in the median, {max(over):.2f} at worst; "
        f"ahead of the PID on set points on {ahead[0]}, after loads on {ahead[1]}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
