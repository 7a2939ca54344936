"""The record of a plant in closed loop, and the file that a historian would export of it, the truth beside."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import torch
from closed_plant import ClosedPlant, OldLoop, operated
from numpy.typing import NDArray
from torch import Tensor

from loopwright.pipeline.plants.simulator import Array

START = datetime(2025, 2, 3, 0, 0, 0)
IN_MANUAL = 0.085  # share of the rows, in the mean
HAND_MOVES = 4  # in one time in manual, in the mean


class OldLaw:
    """The old loops as one law: a PI in velocity form for each, on the applied MV.

    du = Kc (e(k) - e(k-1) + h/Ti e(k)), within the ends of its output.
    """

    def __init__(self, loops: Sequence[OldLoop], period_s: float) -> None:
        numbers = [[o.kc, period_s / o.ti_s, o.low, o.high] for o in loops]
        self.kc, self.integral, self.low, self.high = torch.tensor(numbers, dtype=torch.float64).T
        self.n_state = 1 + len(loops)

    def __call__(self, sp: Tensor, pv: Tensor, dv: Tensor, mv: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step; shapes as of any law."""
        error = sp - pv[..., : sp.shape[-1]]
        last = torch.where(state[..., :1] > 0, state[..., 1:], error)
        # A hand may have left the MV beyond the ends of the loop's output: it stays there until the loop comes back.
        low, high = torch.minimum(self.low, mv), torch.maximum(self.high, mv)
        moved = mv + self.kc * (error - last + self.integral * error)
        moved = torch.minimum(torch.maximum(moved, low), high)
        return moved, torch.cat([torch.ones_like(error[..., :1]), error], dim=-1), error[..., :0]


@dataclass(frozen=True, slots=True, eq=False)
class ClosedRecord:
    """Rows as measured, and the truth that no user has. Row k: PV and DV at sample k, OP held over [k, k+1)."""

    sp: Array  # (n, n_cv)
    pv: Array  # (n, n_cv)
    op: Array  # (n, n_mv)
    manual: NDArray[np.bool_]  # (n, n_mv)
    dv: Array  # (n, n_dv)
    true: Array  # (n, n_cv) without noise
    loads: dict[str, Array]  # what wandered (n,)


def closed_record_of(plant: ClosedPlant, rows: int, seed: int = 0) -> ClosedRecord:
    """Rows under the old loops, with times in manual; the same seed gives the same rows."""
    rng = np.random.default_rng(seed)
    sp = operated(plant, rows, rng)
    return recorded(plant, sp, *hands(plant, rows, rng), rng)


def recorded(
    plant: ClosedPlant,
    sp: Array,
    manual: NDArray[np.bool_],
    hand: Array,
    rng: np.random.Generator,
    valves: Array | None = None,
) -> ClosedRecord:
    """Rows under set points (n, n_cv) and old loops; in manual (n, n_mv) the hand adds its moves (n, n_mv).

    Where ``valves`` (n_mv,) are given, these act on the plant, and what the loops ask for does not.
    """
    rows, courses, names = len(sp), plant.drift(len(sp), rng), plant.parameter_names()
    p = np.tile(plant.parameters(), (rows, 1))
    for name, values in courses.items():
        p[:, names.index(name)] = values
    noise = plant.noise_std * rng.standard_normal((rows, len(plant.pv_signals)))
    dv = plant.shown(courses, rows, rng)
    first = plant.with_parameters({key: float(values[0]) for key, values in courses.items()})
    x, mv = first.rest(sp[0])
    law, step = OldLaw(plant.loops, plant.period_s), plant.stepper()
    state, none = torch.zeros(law.n_state, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    true, op = np.empty_like(noise), np.empty((rows, len(plant.mv_signals)))
    for k in range(rows):
        true[k] = plant.measured(x)
        given = (torch.from_numpy(v) for v in (sp[k], true[k] + noise[k]))
        asked, state, _ = law(*given, none, torch.from_numpy(mv), state)
        mv = np.where(manual[k], np.clip(mv + hand[k], 2.0, 98.0), asked.numpy())
        op[k] = np.round(mv, 2)
        x = step(x, op[k] if valves is None else valves, plant.dv_nominal, p[k])
    return ClosedRecord(sp, true + noise, op, manual, dv, true, courses)


def hands(plant: ClosedPlant, rows: int, rng: np.random.Generator) -> tuple[NDArray[np.bool_], Array]:
    """Rows in manual of each loop (rows, n_mv), and what the hand adds to the MV there [%]."""
    n_mv = len(plant.mv_signals)
    manual, hand = np.zeros((rows, n_mv), dtype=np.bool_), np.zeros((rows, n_mv))
    shortest, longest = plant.in_manual
    mean = (shortest + longest) / 2
    for j in range(n_mv):
        for first in np.arange(0.0, rows, mean / IN_MANUAL):  # once in each such stretch
            length, side = int(rng.integers(shortest, longest + 1)), rng.choice([-1.0, 1.0])
            k = int(first + rng.uniform() * (mean / IN_MANUAL - longest))
            end = min(k + length, rows)
            manual[k:end, j] = True
            for at in np.flatnonzero(rng.uniform(size=max(0, end - k)) < HAND_MOVES / length):
                hand[k + at, j] = side * rng.uniform(*plant.hand_moves)
                side = -side  # there and back: nobody drives a plant away
    return manual, hand


def header(plant: ClosedPlant) -> list[str]:
    """The columns of the export."""
    of_loops = [f"{o.tag}.{part}" for o in plant.loops for part in ("SP", "PV", "OP", "MODE")]
    return ["Timestamp", *of_loops, *(m.tag for m in plant.measured_disturbances)]


def write_export(plant: ClosedPlant, record: ClosedRecord, file: Path) -> None:
    """``file`` as a historian exports it, and the truth in a file of its own beside it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    times = [f"{START + timedelta(seconds=plant.period_s * k):%Y-%m-%d %H:%M:%S}" for k in range(len(record.pv))]
    digits = [_digits(s.high - s.low) for s in plant.pv_signals]
    with file.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(header(plant))
        for k, stamp in enumerate(times):
            cells = [stamp]
            for i in range(len(plant.loops)):
                sp, pv = (f"{v[k, i]:.{digits[i]}f}" for v in (record.sp, record.pv))
                cells += [sp, pv, f"{record.op[k, i]:.2f}", "MAN" if record.manual[k, i] else "AUTO"]
            rows.writerow([*cells, *(f"{v:.{_digits(m.high - m.low)}f}" for v, m in
                                     zip(record.dv[k], plant.measured_disturbances, strict=True))])  # fmt: skip
    with truth_beside(file).open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(["Timestamp", *(o.tag for o in plant.loops), *record.loads])
        columns = np.column_stack([record.true, *record.loads.values()])
        rows.writerows([stamp, *(f"{v:.6g}" for v in row)] for stamp, row in zip(times, columns, strict=True))


def truth_beside(file: Path) -> Path:
    """The file of the truth: outputs without noise, and the loads."""
    return file.with_name(f"{file.stem}-truth.csv")


def _digits(span: float) -> int:
    """Digits behind the point that show a ten-thousandth of the span."""
    return max(0, int(np.ceil(4 - np.log10(span))))


def roles(plant: ClosedPlant) -> list[str]:
    """The options of `loopwright new` that say what the columns are, as the plant's people would give them."""
    found = []
    for o, pv, mv in zip(plant.loops, plant.pv_signals, plant.mv_signals, strict=True):
        found += ["--pv", f"{o.tag}.PV[{pv.unit}]={pv.low:g}..{pv.high:g}"]
        found += ["--mv", f"{o.tag}.OP[{mv.unit}]={mv.low:g}..{mv.high:g}"]
        found += ["--sp", f"{o.tag}.SP", "--mode", f"{o.tag}.MODE"]
    for m in plant.measured_disturbances:
        found += ["--dv", f"{m.tag}[{m.unit}]={m.low:g}..{m.high:g}"]
    return found
