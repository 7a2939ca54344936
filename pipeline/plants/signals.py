"""The signals of a plant: all that reading a record, training a model and most laws need of it."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.serving.manifest import Signal


@dataclass(frozen=True, slots=True)
class Signals:
    """Set points, process variables, measured disturbances, MVs, and the sampling period [s]."""

    period_s: float
    sp: tuple[Signal, ...]
    pv: tuple[Signal, ...]  # controlled variables first
    dv: tuple[Signal, ...]
    mv: tuple[Signal, ...]
