"""Reasons not to act on a sample. A guard says why not, or None; it never changes a value."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from math import isfinite
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.manifest import Manifest, Signal

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sample:
    """What the plant's side knows at one scan, in engineering units.

    ``mv_applied`` is the MV that the plant really received over the last period, read back; None
    where it cannot be read. ``age_s`` is the time since the PVs were measured.
    """

    pv: Array  # shape: (n_pv,)
    mv_applied: Array | None = None  # shape: (n_mv,)
    dv: Array = field(default_factory=lambda: np.zeros(0))  # shape: (n_dv,)
    age_s: float = 0.0


class Guard(Protocol):
    """One reason not to act."""

    @property
    def memory(self) -> int:
        """How many past samples the guard looks at."""

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not to act on ``sample``, or None; ``past`` ends with the sample before it."""


@dataclass(frozen=True, slots=True)
class Complete:
    """Every value is there and finite."""

    manifest: Manifest
    memory: int = field(default=0, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: a vector has the wrong length, or a value is NaN or infinite."""
        m = self.manifest
        for label, signals, values in (
            ("PV", m.pv, sample.pv),
            ("DV", m.dv, sample.dv),
            ("applied MV", m.mv, sample.mv_applied),
        ):
            if values is None:
                continue
            if np.shape(values) != (len(signals),):
                return f"{label} has the shape {np.shape(values)} instead of ({len(signals)},)"
            for signal, value in zip(signals, values.tolist(), strict=True):
                if not isfinite(value):
                    return f"{label} {signal.name} is {value}"
        return None


@dataclass(frozen=True, slots=True)
class InRange:
    """Every PV lies in its signal's range, widened by ``margin`` times the range on both sides."""

    signals: tuple[Signal, ...]
    margin: float = 0.05
    memory: int = field(default=0, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: a sensor beyond its range is broken, or the plant is where the law was never tested."""
        for s, value in zip(self.signals, sample.pv.tolist(), strict=True):
            slack = self.margin * (s.high - s.low)
            if not s.low - slack <= value <= s.high + slack:
                return f"PV {s.name} is {value:.6g} {s.unit}, outside its range [{s.low:g}, {s.high:g}] {s.unit}"
        return None


@dataclass(frozen=True, slots=True)
class Allowed:
    """Every discrete applied MV has a value that it may have.

    A valve that is read back half way between open and shut has done neither over the last period:
    no law knows what the plant received.
    """

    signals: tuple[Signal, ...]
    memory: int = field(default=0, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: the actuator is on its way, or broken."""
        if sample.mv_applied is None:
            return None
        for s, value in zip(self.signals, sample.mv_applied.tolist(), strict=True):
            if s.values is not None and value not in s.values:
                return f"applied MV {s.name} is {value:.6g}, none of {', '.join(f'{v:g}' for v in s.values)}"
        return None


@dataclass(frozen=True, slots=True)
class Frozen:
    """No PV repeats itself to the bit for ``samples`` samples: a live sensor has noise.

    Not among the default guards, because a simulated plant at rest has none.
    """

    signals: tuple[Signal, ...]
    samples: int = 20

    @property
    def memory(self) -> int:
        """All samples that must not be equal, less the present one."""
        return self.samples - 1

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: the transmitter or the gateway repeats an old value."""
        recent = list(past)[-self.memory :]
        if len(recent) < self.memory:
            return None
        for i, s in enumerate(self.signals):
            if all(old.pv[i] == sample.pv[i] for old in recent):
                return f"PV {s.name} is frozen at {sample.pv[i]:.6g} {s.unit} for {self.samples} samples"
        return None


@dataclass(frozen=True, slots=True)
class Fresh:
    """The sample is at most ``max_age_s`` [s] old."""

    max_age_s: float
    memory: int = field(default=0, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: the measurement belongs to another period."""
        if not sample.age_s <= self.max_age_s:
            return f"the sample is {sample.age_s:.3g} s old; allowed are {self.max_age_s:.3g} s"
        return None


@dataclass(frozen=True, slots=True)
class Rate:
    """No PV moves by more than ``largest`` [pv units] from one sample to the next."""

    signals: tuple[Signal, ...]
    largest: tuple[float, ...]
    memory: int = field(default=1, init=False)

    def check(self, sample: Sample, past: Collection[Sample]) -> str | None:
        """Why not: faster than the process can, so it is the sensor."""
        if not past:
            return None
        moves = np.abs(sample.pv - list(past)[-1].pv).tolist()
        for s, move, largest in zip(self.signals, moves, self.largest, strict=True):
            if not move <= largest:
                return f"PV {s.name} moved by {move:.6g} {s.unit} in one sample; allowed are {largest:g} {s.unit}"
        return None


def default_guards(manifest: Manifest) -> tuple[Guard, ...]:
    """The guards that suit every plant: values there and allowed, PVs in range, no sample older than a period."""
    discrete = (Allowed(manifest.mv),) if any(s.values for s in manifest.mv) else ()
    return (Complete(manifest), *discrete, InRange(manifest.pv), Fresh(manifest.period_s))
