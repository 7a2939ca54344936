"""Use of the signals at a scan: which ones the law has in use, which readings are new, and the error of each CV."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.guard import Sample
from loopwright.serving.loop import Command
from loopwright.serving.manifest import Manifest

Array: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = tuple[bool, ...]

KNOWN_SCANS = 64  # different scans whose use is remembered: operators change little, readings repeat themselves
TASTE = frozenset({"use", "track", "rest", "rest_use", "cost", "speed", "caution"})  # moves a plant's rest by itself


@dataclass(frozen=True, slots=True)
class SignalUse:
    """Use of the signals at a scan. A PV without an entry of ``operate`` is in use where it has a set point.

    ``used`` PVs are in use by operators and not left out for a bad reading; ``tracked`` ones have their set point
    wanted; ``fresh`` ones have a new and good reading. ``moved`` MVs are those that the law may move.
    """

    used: Flags  # shape: (n_pv,)
    tracked: Flags  # shape: (n_pv,)
    fresh: Flags  # shape: (n_pv,)
    moved: Flags  # shape: (n_mv,)
    low: tuple[float, ...]  # shape: (n_pv,), of the range; infinite without one
    high: tuple[float, ...]
    mv_low: tuple[float, ...]  # shape: (n_mv,), operators' limits
    mv_high: tuple[float, ...]
    mv_most: tuple[float, ...]  # shape: (n_mv,), operators' largest move a period; infinite without one
    taste: tuple[float, ...] = ()  # the values by which operators move a plant's rest

    def errors(self, pv: list[float], sp: list[float]) -> list[float]:
        """Error of each PV (n_pv,): from its set point, within the range; else by how much it is outside; else 0."""
        found = []
        for i, value in enumerate(pv):
            if self.tracked[i]:
                found.append(value - max(min(sp[i], self.high[i]), self.low[i]))
            elif self.used[i]:
                found.append(min(value - self.low[i], 0.0) + max(value - self.high[i], 0.0))
            else:
                found.append(0.0)
        return found


class UseOfSignals:
    """Reads the ``SignalUse`` of scans of one controller."""

    def __init__(self, manifest: Manifest) -> None:
        self._m = m = manifest
        of_cv, of_mv = ({e.name: i for i, e in enumerate(m.operate) if e.group == group} for group in ("cv", "mv"))
        self._cv = [{w: of_cv.get(f"{s.name}.{w}") for w in ("use", "track", "low", "high")} for s in m.pv]
        self._mv = [{w: of_mv.get(f"{s.name}.{w}") for w in ("use", "low", "high", "max_move")} for s in m.mv]
        self._taste = [i for i, e in enumerate(m.operate) if e.what in TASTE]
        self._known: dict[object, SignalUse] = {}

    def of(self, sample: Sample | None, command: Command, operate: Array | None) -> SignalUse:
        """The use at a scan; ``operate`` (n_operate,) is what operators want, None: the law's own defaults."""
        stale = None if sample is None or sample.fresh is None else np.asarray(sample.fresh).tobytes()
        of = None if operate is None else operate.tobytes()
        key = (of, stale, tuple(command.bridged), tuple(command.shed), tuple(command.local))
        found = self._known.get(key)
        if found is None:
            if len(self._known) >= KNOWN_SCANS:
                self._known.clear()
            found = self._known[key] = self._read(sample, command, operate)
        return found

    def _read(self, sample: Sample | None, command: Command, operate: Array | None) -> SignalUse:
        m = self._m
        values = [e.default for e in m.operate] if operate is None else operate.tolist()
        if len(values) != len(m.operate):
            raise ValueError(f"operate has {len(values)} numbers; the law has {len(m.operate)}")
        bad = {*command.bridged, *command.shed}
        new = [True] * len(m.pv) if sample is None or sample.fresh is None else np.asarray(sample.fresh).tolist()

        def value(at: Mapping[str, int | None], what: str, otherwise: float) -> float:
            place = at[what]
            return otherwise if place is None else values[place]

        wanted = [float(i < len(m.sp)) for i in range(len(m.pv))]
        used = [
            value(at, "use", w) > 0 and s.name not in command.shed
            for s, at, w in zip(m.pv, self._cv, wanted, strict=True)
        ]
        tracked = [u and value(at, "track", w) > 0 for u, at, w in zip(used, self._cv, wanted, strict=True)]
        return SignalUse(
            used=tuple(used),
            tracked=tuple(tracked),
            fresh=tuple(bool(n) and s.name not in bad for s, n in zip(m.pv, new, strict=True)),
            moved=tuple(
                value(at, "use", 1.0) > 0 and s.name not in command.local for at, s in zip(self._mv, m.mv, strict=True)
            ),
            low=tuple(value(at, "low", -inf) for at in self._cv),
            high=tuple(value(at, "high", inf) for at in self._cv),
            mv_low=tuple(value(at, "low", s.low) for at, s in zip(self._mv, m.mv, strict=True)),
            mv_high=tuple(value(at, "high", s.high) for at, s in zip(self._mv, m.mv, strict=True)),
            mv_most=tuple(value(at, "max_move", s.max_move or inf) for at, s in zip(self._mv, m.mv, strict=True)),
            taste=tuple(values[i] for i in self._taste),
        )
