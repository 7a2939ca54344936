"""One scan of the kit, and samples that are not as they should be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf, nan
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.guard import READ_BACK_MARGIN, InRange, Sample
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.modes import Mode

Array: TypeAlias = NDArray[np.float64]

MARGIN_SHARE = 0.4  # share of a margin by which a value lies inside or outside it


@dataclass(frozen=True, slots=True)
class KitScan:
    """Events before and at one scan. ``sample`` None: the plant cannot be read.

    ``set_mode`` and ``set_mv`` (n_mv,) are what the operator sets before it, ``missed`` the periods that passed without
    a scan before it. ``unwritten``: the command of the scan before did not reach the plant.
    """

    what: str
    sample: Sample | None
    set_mode: Mode | None = None
    missed: int = 0
    unwritten: bool = False
    set_mv: Array | None = None


def apart(m: Manifest) -> set[str]:
    """The MVs that a law can do without.

    This runtime goes on without one that is read back badly or elsewhere alone; a host may hold all of them.
    """
    return {e.signal for e in m.operate if e.group == "mv" and e.what == "use"} if "operate" in m.inputs else set()


def moved(m: Manifest, good: Sample) -> Sample:
    """The sample after somebody has moved each MV far from where it stood."""
    assert good.mv_applied is not None
    to = [
        (s.low + (0.8 if at < s.middle else 0.2) * (s.high - s.low))
        if s.values is None
        else next((v for v in s.values if v != at), at)
        for s, at in zip(m.mv, np.asarray(good.mv_applied).tolist(), strict=True)
    ]
    return replace(good, mv_applied=np.array(to, dtype=np.float64))


def doubtful(m: Manifest) -> Iterator[tuple[str, _Spoil]]:
    """Samples at and beyond each limit, as functions of a good one."""
    for i, s in enumerate(m.pv):
        for bad in (nan, inf, -inf):
            yield f"PV {s.name} {bad}", _Spoil("pv", i, bad)
        yield from _around("PV", "pv", i, s, InRange(m.pv).margin)
    for i, s in enumerate(m.dv if "dv" in m.inputs else ()):
        yield f"DV {s.name} not finite", _Spoil("dv", i, nan)
    for i, s in enumerate(m.mv):
        if s.name in apart(m):
            continue
        yield f"applied MV {s.name} not finite", _Spoil("mv_applied", i, nan)
        if s.values is None:
            yield from _around("applied MV", "mv_applied", i, s, READ_BACK_MARGIN)
        elif len(s.values) > 1:
            between = (s.values[0] + s.values[1]) / 2
            yield f"applied MV {s.name} between two values", _Spoil("mv_applied", i, between)
    yield "no read-back", _Spoil("mv_applied", None, nan)
    for age in (0.9, 1.1, -0.5, nan):
        yield f"age {age} periods", _Spoil("age_s", None, age * m.period_s)


def _around(label: str, name: str, i: int, s: Signal, margin: float) -> Iterator[tuple[str, _Spoil]]:
    for share, words in ((1 - MARGIN_SHARE, "within its margin"), (1 + MARGIN_SHARE, "beyond its margin")):
        slack = share * margin * (s.high - s.low)
        yield f"{label} {s.name} below, {words}", _Spoil(name, i, s.low - slack)
        yield f"{label} {s.name} above, {words}", _Spoil(name, i, s.high + slack)


@dataclass(frozen=True, slots=True)
class _Spoil:
    name: str
    index: int | None
    value: float

    def __call__(self, sample: Sample) -> Sample:
        if self.name == "age_s":
            return replace(sample, age_s=self.value)
        if self.index is None:
            return replace(sample, mv_applied=None)
        return changed(sample, self.name, self.index, self.value)


def changed(sample: Sample, name: str, index: int, value: float) -> Sample:
    """The sample with another ``value`` at ``index`` of its vector ``name``."""
    vector = np.array(getattr(sample, name), dtype=np.float64)
    vector[index] = value
    changed: dict[str, Any] = {name: vector}
    return replace(sample, **changed)
