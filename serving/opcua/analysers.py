"""Analysers among the process variables: their numbers stand between two results, and are then no new readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopwright.serving.guard import Fault, Sample
from loopwright.serving.manifest import Manifest
from loopwright.serving.opcua.settings import AnalyserNode


@dataclass(frozen=True, slots=True)
class _Result:
    number: float
    stamp: float | None  # its source time [s]; None where none has come yet, or it does not count
    came_s: float  # on the endpoint's clock


class Analysers:
    """Tells new readings of analysers from numbers that stand.

    A good reading is new where its number is another one than that of the last result; of an analyser whose ``new`` is
    ``source_time`` also where its source time is. A server may stamp a number anew that nobody has measured, so that
    source times count only where that is said. One that stands, or is bad, is not fresh, and no fault yet. After
    longer than ``longest_s`` [s, of the plant's time] without a new one the process variable is bad.
    """

    def __init__(self, manifest: Manifest, results: Mapping[str, AnalyserNode], speed: float = 1.0) -> None:
        self._names = [s.name for s in manifest.pv]
        self._of = {self._names.index(name): of for name, of in results.items() if name in self._names}
        self._speed = speed
        self._last: dict[int, _Result] = {}

    def look(self, sample: Sample, now: float, stamps: Mapping[str, float] | None = None) -> Sample:
        """The sample with ``fresh`` (n_pv,), and with what has waited too long among ``bad_pv``.

        ``now`` [s] is the endpoint's clock, ``stamps`` are source times [s] by PV.
        """
        if not self._of:
            return sample
        fresh, bad = np.ones(len(self._names)), [*(sample.bad_pv or ("",) * len(self._names))]
        for i, of in self._of.items():
            number, why = float(sample.pv[i]), bad[i]
            stamp = None if of.new == "number" else (stamps or {}).get(self._names[i])
            last = self._last.setdefault(i, _Result(np.nan, None, now))
            known = last.stamp if stamp is None else stamp
            if not why and not np.isnan(number):
                new = number != last.number or (last.stamp is not None and known != last.stamp)
                self._last[i] = _Result(number, known, now if new else last.came_s)
                if new:
                    continue
            fresh[i], bad[i] = 0.0, ""
            waited_s, name = self._speed * (now - last.came_s), f"PV {self._names[i]}"
            if waited_s > of.longest_s:
                words = f"{name} has had no new reading for {waited_s:.3g} s; {of.longest_s:g} s are allowed"
                bad[i] = why or Fault(words, "late", name)
        return replace(sample, fresh=fresh, bad_pv=tuple(bad) if any(bad) else ())
