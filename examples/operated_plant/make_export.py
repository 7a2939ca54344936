"""A day of a mixing tank with three valves: `python make_export.py FILE.csv` (numpy alone, a fixed seed).

Hot and cold water are mixed, and an outlet valve lets the mixture go:

    A dh/dt = q_hot + q_cold - c_out (outlet / 100) sqrt(h)
    A h dT/dt = q_hot (T_hot - T) + q_cold (T_cold - T) - k (T - T_room)

with h the level [m] and q the flows [m3/s], each its valve's opening times its largest flow. Sampled every 10 s, all
three valves moved by hand. The mixture's flow FI-4 has no set point: the plant behind takes what lies in a range.
Three valves for two variables and a range: resting values and costs decide what these leave open.
"""

from __future__ import annotations

import csv
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

PERIOD_S, HOURS, DEAD_S, PARTS = 10.0, 24, 20.0, 10
START = datetime(2024, 3, 4, 6, 0, 0, tzinfo=UTC)
HEADER = ["Timestamp", "TIC-1", "LIC-2", "FV-1", "FV-2", "FV-3", "FI-4"]
UNITS = ["", "degC", "%", "%", "%", "%", "l/s"]
AREA, HEIGHT = 0.4, 2.0  # [m2], [m] at a level of 100 %
MOST_HOT, MOST_COLD, OUT = 0.009, 0.009, 0.0135  # [m3/s], [m3/s], [m2.5/s]
T_HOT, T_COLD, T_ROOM, LOSS = 80.0, 12.0, 18.0, 2e-4  # [degC], [m3/s]
VALVES = ((30.0, 60.0), (30.0, 60.0), (55.0, 80.0))  # hot, cold, outlet: where the operator moves them [%]


def moved(random: np.random.Generator, n: int) -> np.ndarray:
    """The valves' positions (n, 3) [%]: each is held for seven to twenty minutes at a time."""
    valves = np.empty((n, 3))
    for j, (low, high) in enumerate(VALVES):
        k = 0
        while k < n:
            hold = int(random.integers(40, 120))
            valves[k : k + hold, j], k = np.round(random.uniform(low, high), 1), k + hold
    return valves


def simulated(random: np.random.Generator, valves: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperature [degC], level [%] and flow of the mixture [l/s], (n,) each, with loads that nobody measures."""
    n, dead = len(valves), int(DEAD_S / PERIOD_S)
    temperature, level, flow = np.empty(n), np.empty(n), np.empty(n)
    t, h, hot = 40.0, 0.9, T_HOT
    for k in range(n):
        temperature[k], level[k] = t, 100 * h / HEIGHT
        flow[k] = 1000 * OUT * valves[max(k - 1, 0), 2] / 100 * np.sqrt(h)  # read before the valve moves
        hot += 0.01 * (T_HOT - hot) + random.normal(0, 0.1)
        feed, out = valves[max(k - dead, 0), :2] / 100, valves[k, 2] / 100
        for _ in range(PARTS):
            q_hot, q_cold = MOST_HOT * feed[0], MOST_COLD * feed[1]
            heat = q_hot * (hot - t) + q_cold * (T_COLD - t) - LOSS * (t - T_ROOM)
            t += PERIOD_S / PARTS * heat / (AREA * max(h, 0.1))
            h += PERIOD_S / PARTS / AREA * (q_hot + q_cold - OUT * out * np.sqrt(h))
            h = min(max(h, 0.05), HEIGHT)
    return temperature + random.normal(0, 0.1, n), level + random.normal(0, 0.2, n), flow + random.normal(0, 0.05, n)


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python make_export.py FILE.csv")
    random = np.random.default_rng(11)
    valves = moved(random, int(HOURS * 3600 / PERIOD_S))
    temperature, level, flow = simulated(random, valves)
    with Path(sys.argv[1]).open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerows([HEADER, UNITS])
        for k, at in enumerate(valves):
            stamp = (START + timedelta(seconds=k * PERIOD_S)).isoformat().replace("+00:00", "Z")
            valve = (f"{v:.1f}" for v in at)
            rows.writerow([stamp, f"{temperature[k]:.2f}", f"{level[k]:.2f}", *valve, f"{flow[k]:.3f}"])


if __name__ == "__main__":
    main()
