"""A historian export with its usual dirt: `python make_export.py FILE.csv` (numpy alone, a fixed seed).

A stirred tank is heated by a valve and fed from a main whose flow is measured:

    C dT/dt = q(t - 30 s) Q - w c (T - T_feed) - k (T - T_room)

with q the valve's opening to a power of 1.4. Sampled every 10 s for 24 hours, moved by hand.
"""

from __future__ import annotations

import csv
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

PERIOD_S, HOURS, DEAD_S = 10.0, 24, 30.0
START = datetime(2024, 3, 4, 6, 0, 0, tzinfo=UTC)
HEADER = ["Timestamp", "TIC-101.PV", "TIC-101.OP", "FI-7", "TIC-101.SP", "TIC-101.MODE", "PI-3", "TIC-101.PV Quality"]
UNITS = ["", "degC", "%", "kg/h", "degC", "", "bar", ""]


def simulated(random: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperature [degC], valve [%] and feed [kg/h], (n,) each, before anything went wrong."""
    valve, feed = np.empty(n), np.empty(n)
    k = 0
    while k < n:  # the operator's steps
        hold = int(random.integers(15, 90))
        valve[k : k + hold], k = np.round(random.uniform(20, 80), 1), k + hold
    flow, level = 900.0, 900.0
    for k in range(n):
        if random.random() < 0.004:
            level = random.uniform(750, 1050)
        flow += 0.05 * (level - flow) + random.normal(0, 1.5)
        feed[k] = flow
    heat, loss, capacity = 110e3, 300.0, 9.0e5  # [W], [W/K], [J/K]
    temperature, dead = np.empty(n), int(DEAD_S / PERIOD_S)
    t = 60.0
    for k in range(n):
        temperature[k] = t
        power = heat * (valve[max(k - dead, 0)] / 100) ** 1.4
        for _ in range(10):
            t += PERIOD_S / 10 / capacity * (power - feed[k] / 3600 * 4180 * (t - 20) - loss * (t - 15))
    return temperature + random.normal(0, 0.08, n), valve, feed


def dirty(random: np.random.Generator) -> list[list[str]]:
    """The rows of the export."""
    n = int(HOURS * 3600 / PERIOD_S)
    temperature, valve, feed = simulated(random, n)
    pv, flow = np.round(temperature, 2), np.round(feed / 2.0) * 2.0  # digits of the export, steps of a converter
    pv[3000:3200] = pv[3000]  # the sensor is stuck
    quality = ["Good"] * n
    for k in random.choice(n, 45, replace=False):  # outliers
        pv[k] += random.choice([-1, 1]) * random.uniform(15, 60)
    cells = [f"{v:.2f}" for v in pv]
    for k in random.choice(n, 40, replace=False):
        cells[k] = "-9999"
    for k in random.choice(n, 25, replace=False):
        cells[k], quality[k] = "Bad Input", "Bad"
    flows = [f"{v:.0f}" for v in flow]
    for k in random.choice(n, 60, replace=False):
        flows[k] = ""
    for k in range(5200, 5290):  # the transmitter works in degF for a while
        cells[k] = f"{1.8 * pv[k] + 32:.2f}"
    rows = []
    for k in range(n):
        at = START + timedelta(seconds=k * PERIOD_S + float(random.uniform(-0.4, 0.4)))
        stamp = at.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        mode = "AUTO" if 7000 <= k < 7060 else "MAN"
        rows.append(
            [stamp, cells[k], f"{valve[k]:.1f}", flows[k], "65.0", mode, f"{3 + 0.01 * (k % 7):.2f}", quality[k]]
        )
    kept = [row for k, row in enumerate(rows) if not 6000 <= k < 6110]  # the historian was down
    for k in sorted(random.choice(len(kept), 12, replace=False), reverse=True):
        kept.insert(k, kept[k])  # sent twice
    return kept


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python make_export.py FILE.csv")
    with Path(sys.argv[1]).open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerows([HEADER, UNITS, *dirty(np.random.default_rng(7))])


if __name__ == "__main__":
    main()
