"""A historian export of the demo server's reactor: ``python make_export.py FILE.csv`` (a fixed seed).

It stands in for your historian: three hours of operation by hand, a row every two seconds. The feed `F` [l/s] is moved
now and then; the product `C_B` [mol/l] and the temperature `T` [K] are measured with noise.
"""

import csv
import sys
from datetime import UTC, datetime, timedelta

import numpy as np

from loopwright.pipeline.cases import CASES

ROWS, PERIOD_S = 5400, 2
START = datetime(2024, 3, 4, 6, 0, tzinfo=UTC)
NOISE = (0.0005, 0.05)  # of C_B [mol/l] and T [K]


def main() -> None:
    plant, rng = CASES["reversible_cstr"].plant, np.random.default_rng(0)
    (x, feed), advance, hold = plant.start, plant.stepper(), 30
    with open(sys.argv[1], "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["time", *(s.name for s in plant.signals.pv), "F"])
        for k in range(ROWS):
            if hold == 0:  # the operator moves the feed
                feed, hold = np.round(rng.uniform([0.5], [5.5]), 2), int(rng.integers(10, 80))
            c_b, t = plant.measure(x) + rng.normal(0, NOISE)
            when = START + timedelta(seconds=k * PERIOD_S)
            out.writerow([when.strftime("%Y-%m-%d %H:%M:%S"), f"{c_b:.5f}", f"{t:.3f}", f"{feed[0]:.2f}"])
            x, hold = advance(x, feed, plant.dv_nominal, plant.parameters()), hold - 1


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python make_export.py FILE.csv")
    main()
