"""Eight plants under ranges, costs and resting values: the predictive law from a record, PIDs, and the perfect NMPC.

``python benchmarks/operated_plants [PLANT ...]``: some minutes a plant at first (models and the PIDs' numbers are kept
in the folder for temporary files), then three rows of figures over the days of the seeds 101 to 103, 480 samples each,
of which the first 40 are not scored:

- ours: the model is identified from one record of 8,000 rows with noise, and with all that wanders unmeasured. The
  law has what operators set (``operate`` of the plant), and ``tuning: search``. The runtime steps its file. An
  analyser's model comes from a record in which it reads at every row, late; on the day it reads seldom.
- PID: schemes as engineers build them, tuned on the true plant on days that are not scored (``pid_blocks.py``).
- NMPC: the true equations, the same measurements through a Kalman filter, the law's cost (``perfect_economic.py``).

``error``: mean absolute error in % of the set points' ranges; ``/NMPC``: over the NMPC's. ``in range``: % of samples
with all PVs within their ranges; ``beyond``: what lies outside, in % of a range's width, in the mean. ``profit`` an
hour by the costs of ``operate``; ``of NMPC``: in % of the NMPC's, of costs 100 % less what is spent
beyond the NMPC's. ``travel``: % of the MVs' ranges a sample; ``rest``: % of them that MVs with a rest are off it.

``--run``: ours as users come by it. The record as a file, in which an analyser's last number stands until the next,
and a table of tags (roles, ranges, rests, costs) go through `loopwright new` and `loopwright run` on one core, with all
defaults and gates, and the shipped file steps the same days, beside the NMPC. What came is kept in the folder for
temporary files until the product's code or the plant changes. A plant that is refused, or that ships no predictive
file, is a row that says so. Half an hour of one core a plant.

``--solved``: ours beside its own law with each quadratic problem solved to its end: some minutes.

``--operating``: priorities where ranges are at odds, and bumps of changes, on the files of three plants instead.
``--json FILE`` keeps the figures, ``--picture FILE`` draws the first day of the first plant.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # what all benchmarks share

import torch
from contest import HEAD, SCORED, as_json, contested, rows_of
from from_record import Fit
from heating import EXCHANGER, FURNACE
from mixing import BLENDER, TANK
from moving import PUMPS, REACTOR
from operated_plant import DAY
from separating import COLUMN, EVAPORATOR
from solved import solved_rows
from users_run import users_main

from loopwright.pipeline.files import write_bytes

PLANTS = {p.name: p for p in (COLUMN, TANK, BLENDER, FURNACE, EXCHANGER, PUMPS, EVAPORATOR, REACTOR)}


def main(argv: list[str]) -> int:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("plants", nargs="*", choices=[[], *PLANTS], help="(default: all)")
    parser.add_argument("--rows", type=int, default=Fit().rows, help=f"of the record ({Fit().rows})")
    parser.add_argument("--minutes", type=float, default=Fit().minutes, help=f"of a model's search ({Fit().minutes:g})")
    parser.add_argument("--networks", action="store_true", help="tried beside linear models")
    parser.add_argument("--seeds", type=int, nargs="*", default=list(SCORED), help="of the days")
    parser.add_argument("--samples", type=int, default=DAY, help=f"of a day ({DAY})")
    parser.add_argument("--json", type=Path, help="file of the figures, one line a plant")
    parser.add_argument("--picture", type=Path, help="file of a picture of the first plant's first day")
    parser.add_argument("--operating", action="store_true", help="priorities and bumps instead")
    parser.add_argument("--run", action="store_true", help="ours through `new` and `run` instead, beside the NMPC")
    parser.add_argument("--solved", action="store_true", help="ours beside problems solved to their end instead")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    fit = Fit(options.rows, options.minutes, options.networks)
    names = options.plants or list(PLANTS)
    if options.operating:
        from operating_changes import operating_rows

        for name in options.plants or ("column", "furnace", "reactor"):
            print(operating_rows(PLANTS[name], fit), flush=True)
        return 0
    if options.solved:
        for name in names:
            print(solved_rows(PLANTS[name], fit, options.seeds, options.samples), flush=True)
        return 0
    if options.run:
        return users_main([PLANTS[n] for n in names], fit, options.seeds, options.samples, options.json)
    print(HEAD)
    lines = []
    for i, name in enumerate(names):
        contest = contested(PLANTS[name], fit=fit, seeds=options.seeds, samples=options.samples)
        print(rows_of(contest), flush=True)
        lines.append(as_json(contest))
        if options.json is not None:
            write_bytes(options.json, ("\n".join(lines) + "\n").encode())
        if options.picture is not None and not i:
            from day_picture import drawn

            drawn(contest, contest.plant.day(options.seeds[0], options.samples), options.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
