"""Analysers among the process variables: their numbers stand between two results, and are then no new readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from loopwright.serving.guard import Fault, Sample
from loopwright.serving.manifest import Manifest


class Analysers:
    """Tells new readings of analysers from numbers that stand.

    A reading is new where its number is another one than at the scan before, whatever its source time says: a server
    may stamp a number anew that nobody has measured. One that stands, or is bad, is not fresh, and no fault yet. After
    longer than its ``waits`` [s, of the plant's time] without a new one the process variable is bad.
    """

    def __init__(self, manifest: Manifest, waits: Mapping[str, float], speed: float = 1.0) -> None:
        self._names = [s.name for s in manifest.pv]
        self._waits = {self._names.index(name): wait / speed for name, wait in waits.items() if name in self._names}
        self._speed = speed
        self._last: dict[int, tuple[float, float]] = {}  # number and when it came, of the endpoint's clock

    def look(self, sample: Sample, now: float) -> Sample:
        """The sample with ``fresh`` (n_pv,), and with what has waited too long among ``bad_pv``."""
        if not self._waits:
            return sample
        fresh, bad = np.ones(len(self._names)), [*(sample.bad_pv or ("",) * len(self._names))]
        for i, longest in self._waits.items():
            number, why = float(sample.pv[i]), bad[i]
            last, since = self._last.setdefault(i, (np.nan, now))
            if not why and not np.isnan(number) and number != last:
                self._last[i] = number, now
                continue
            fresh[i], bad[i] = 0.0, ""
            if now - since > longest and why:
                bad[i] = why
            elif now - since > longest:
                waited, most = (self._speed * t for t in (now - since, longest))
                name = f"PV {self._names[i]}"
                bad[i] = Fault(
                    f"{name} has had no new reading for {waited:.3g} s; {most:g} s are allowed", "late", name
                )
        return replace(sample, fresh=fresh, bad_pv=tuple(bad) if any(bad) else ())
