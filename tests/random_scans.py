"""Random histories of a loop as scans of a kit: what operators and others do, and samples of each kind."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.serving import Controller, ControlLoop, LoopError, Mode, Sample
from loopwright.serving.conformance.kit import scan_row
from loopwright.serving.conformance.kit_samples import KitScan
from loopwright.serving.conformance.scans import Scanned, start

Array = NDArray[np.float64]
PLACES = 21  # where an MV may be sent or moved to: far enough from each other to be no offset of an actuator


@dataclass(slots=True)
class _Plant:
    """Actuators that others move, too, with a read-back that is bad, or missing, or that never was there."""

    controller: Controller
    rng: np.random.Generator
    mv: Array = field(init=False)  # shape: (n_mv,)
    reads_back: bool = field(init=False)

    def __post_init__(self) -> None:
        self.mv, self.reads_back = self.place(), bool(self.rng.uniform() < 0.7)

    def place(self) -> Array:
        """MVs (n_mv,) at one of the places each."""
        shares = self.rng.integers(0, PLACES, len(self.controller.manifest.mv)) / (PLACES - 1)
        return np.array(
            [s.low + x * (s.high - s.low) for s, x in zip(self.controller.manifest.mv, shares, strict=True)]
        )

    def move(self) -> None:
        """Others move it far, or not at all: a small move counts as an actuator's offset."""
        to = self.place()
        span = np.array([s.high - s.low for s in self.controller.manifest.mv])
        self.mv = np.where(np.abs(to - self.mv) > 0.04 * span, to, self.mv)

    def sample(self) -> Sample | None:
        """A sample; None: the plant cannot be read."""
        m, rng = self.controller.manifest, self.rng
        if rng.uniform() < 0.1:
            return None
        near = [np.array([s.middle + 0.2 * rng.uniform(-1, 1) * (s.high - s.low) for s in of]) for of in (m.pv, m.dv)]
        made = Sample(pv=near[0], dv=near[1], mv_applied=self.mv.copy())
        if rng.uniform() < 0.2:
            made = replace(made, age_s=1.5 * m.period_s)
        how = rng.uniform()
        if not self.reads_back or how < 0.2:
            return replace(made, mv_applied=None)
        if how < 0.3:
            bad = self.mv.copy()
            i = rng.integers(len(bad))
            bad[i] = rng.choice([np.nan, 2 * m.mv[i].high - m.mv[i].low])
            return replace(made, mv_applied=bad)
        return made


def random_rows(controller: Controller, seed: int, n: int) -> list[dict[str, Any]]:
    """``n`` rows of ``scans`` as a kit has them, with the commands of this runtime."""
    m, rng = controller.manifest, np.random.default_rng(seed)
    begin, plant = start(m), _Plant(controller, rng)
    options = {"recover_after": begin.recover_after, "max_gap": begin.max_gap, "learns": False}
    loop = ControlLoop(controller, sp=begin.sp, mode=Mode.AUTO, **options)
    rows, said, sent, before, wrote, may_leave = [], Mode.AUTO, False, loop.mv, False, True
    for k in range(n):
        plant.reads_back = plant.reads_back or bool(rng.uniform() < 0.01)
        mode = None
        if rng.uniform() < 0.15 and (may_leave or loop.mode is not Mode.SHADOW):  # this runtime refuses it then
            said = mode = Mode(rng.choice([str(other) for other in Mode if other is not said]))
        # A block of Structured Text sees the edge of a request.
        sends = not sent and rng.uniform() < 0.2 and (mode or loop.mode) is Mode.MANUAL
        by_hand = plant.place() if sends else None
        sent = sends
        missed = int(rng.integers(1, 6)) if rng.uniform() < 0.05 else 0
        lost = wrote and bool(rng.uniform() < 0.15)
        if wrote and not lost:
            plant.mv = loop.mv
        if mode is not None:
            loop.set_mode(mode)
        if by_hand is not None:
            with suppress(LoopError):
                loop.set_mv(by_hand)
        if lost:
            loop.unwritten(before, "the plant cannot be written")
        if rng.uniform() < 0.15:
            plant.move()
        if missed:
            loop.gap(missed)
        before, sample = loop.mv, plant.sample()
        command = loop.miss("the plant cannot be read") if sample is None else loop.scan(sample)
        wrote = command.writes
        may_leave = not command.fault and sample is not None and sample.mv_applied is not None
        rows.append(scan_row(Scanned(KitScan(f"random {k}", sample, mode, missed, lost, by_hand), command)))
    return rows
