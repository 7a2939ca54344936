"""The step test to run where a record cannot carry a model: a table that an operator can follow."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.historian.excitation import SEEN
from pipeline.historian.findings import InputReport

MOVES = 24  # of each MV
AMPLITUDE, LARGEST = 0.05, 0.12  # of the range, to each side of the present value
UNKNOWN_PERIODS = 60  # for settling where the record does not show it
HOLDS = (0.4, 0.7, 1.0, 1.6)  # of the settling time
LEAST_PERIODS = 5
SEED = 0


@dataclass(frozen=True, slots=True)
class StepTest:
    """Rows of (start [s], hold [s], value of each MV), and what they are for."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    start_s: tuple[float, ...]
    hold_s: tuple[float, ...]
    values: tuple[tuple[float, ...], ...]

    @property
    def hours(self) -> float:
        """Length of the whole test."""
        return (self.start_s[-1] + self.hold_s[-1]) / 3600.0

    def table(self) -> str:
        """CSV: step, time after the start, hold [min], one column an MV."""
        out = io.StringIO()
        rows = csv.writer(out, lineterminator="\n")
        columns = [f"{n} [{u}]" for n, u in zip(self.names, self.units, strict=True)]
        rows.writerow(["step", "at [h:mm:ss]", "at [s]", "hold [min]", *columns])
        for i, (at, hold, values) in enumerate(zip(self.start_s, self.hold_s, self.values, strict=True), start=1):
            clock = f"{int(at) // 3600}:{int(at) // 60 % 60:02}:{int(at) % 60:02}"
            rows.writerow([i, clock, f"{at:g}", f"{hold / 60:.4g}", *(f"{v:.5g}" for v in values)])
        return out.getvalue()


def planned(inputs: Sequence[InputReport], now: Sequence[float], period_s: float) -> StepTest:
    """Steps around the present values: first one MV at a time, then all at random, from a fixed seed.

    Amplitude: AMPLITUDE of the range, LARGEST where no answer was seen. Holds: HOLDS of the settling time that the
    record shows, or of UNKNOWN_PERIODS periods.
    """
    mvs = [i for i in inputs if i.role == "mv"]
    random = np.random.default_rng(SEED)
    settling = max([i.settling_s for i in mvs if i.settling_s > 0], default=UNKNOWN_PERIODS * period_s)
    size = [(LARGEST if not _seen(i) else AMPLITUDE) * (i.high - i.low) for i in mvs]
    middle = [min(max(v, i.low + s), i.high - s) for v, i, s in zip(now, mvs, size, strict=True)]
    values, holds = [tuple(middle)], [settling]
    for j in range(len(mvs)):  # one at a time: up, down, back
        for sign in (1.0, -1.0, 0.0):
            values.append(tuple(m + sign * s * (i == j) for i, (m, s) in enumerate(zip(middle, size, strict=True))))
            holds.append(1.5 * settling)
    share = np.array([-1.0, -0.5, 0.5, 1.0])
    for _ in range(MOVES):
        values.append(tuple(float(m + s * random.choice(share)) for m, s in zip(middle, size, strict=True)))
        holds.append(float(random.choice(HOLDS)) * settling)
    values.append(tuple(middle))
    holds.append(settling)
    hold_s = tuple(float(max(LEAST_PERIODS, round(h / period_s)) * period_s) for h in holds)
    start = tuple(float(t) for t in np.r_[0.0, np.cumsum(hold_s[:-1])])
    return StepTest(tuple(i.name for i in mvs), tuple(i.unit for i in mvs), start, hold_s, tuple(values))


def _seen(report: InputReport) -> bool:
    return any(a > SEEN for a in report.answers.values())
