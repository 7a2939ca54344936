"""Excitations by ``kind``: adding one is a class and a line here. One that only a case has stands in its folder."""

from __future__ import annotations

from loopwright.pipeline.excitation.base import Excitation, OpenLoop
from loopwright.pipeline.excitation.operating_point import OperatingPoint
from loopwright.pipeline.excitation.sequences import Aprbs, Batches, Multisine, Prbs, RandomSteps

EXCITATIONS: dict[str, type[Excitation]] = {
    RandomSteps.kind: RandomSteps,
    Prbs.kind: Prbs,
    Aprbs.kind: Aprbs,
    Multisine.kind: Multisine,
    OperatingPoint.kind: OperatingPoint,
    Batches.kind: Batches,
}

__all__ = ["EXCITATIONS", "Excitation", "OpenLoop"]
