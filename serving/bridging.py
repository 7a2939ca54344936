"""Bad readings of single PVs: bridged by a law's own prediction for a while, then left out of what it controls."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.fields import nearest, shown
from loopwright.serving.guard import Fault, Guard, Sample, lasting, refused, refused_apart, reworded
from loopwright.serving.manifest import Manifest
from loopwright.serving.words import first_line

Array: TypeAlias = NDArray[np.float64]

BRIDGE_PERIODS = 10.0  # periods: a law's own prediction is as good as its model, and loads go on unseen meanwhile


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """The part of a sample that a law gets. ``reason`` says why it gets none; empty: it does.

    ``bridged`` and ``shed`` say by PV why its reading is not used: the law predicts the first, and no longer controls
    the second.
    """

    sample: Sample  # as it was judged: ``bad_pv`` says what speaks against single PVs
    reason: str = ""
    pv: Array | None = None  # shape: (n_pv,), the last good number where the present one is bad
    fresh: Array | None = None  # shape: (n_pv,), 1 or 0; None for a law that does not read it
    bridged: Mapping[str, str] = field(default_factory=dict)
    shed: Mapping[str, str] = field(default_factory=dict)


class Bridging:
    """Judges the samples of one law, and remembers the last good number of each PV.

    A law without ``fresh`` gets a whole sample or none. One that reads it goes on without a PV whose reading is bad:
    for ``bridge_s`` it predicts the PV. Then the PV is shed: its ``use`` is 0 for the law until the reading is good
    again. The sample is refused where no PV is left that the operator has in use, and where a PV is gone for longer
    than ``bridge_s`` that is ``critical`` or has no ``use``. A PV that was never read well is not bridged.

    A PV without a new reading (``Sample.fresh``) is predicted, too, for as long as it takes, and is neither bridged nor
    shed by that. One whose last reading was bad stays bad until the next good one.

    Parameters
    ----------
    manifest
        The law's.
    bridge_s
        Time for which a bad reading is bridged [s], 0 or more; None: ``BRIDGE_PERIODS`` periods.
    critical
        Names of PVs without which the law must not act.

    Raises
    ------
    LoopError
        ``bridge_s`` is no such time, or ``critical`` names what is no PV.
    """

    def __init__(self, manifest: Manifest, bridge_s: float | None = None, critical: Sequence[str] = ()) -> None:
        if bridge_s is not None and not 0 <= bridge_s < inf:
            raise LoopError(f"bridge_s is {bridge_s}; it must be a finite number of seconds, 0 or more")
        if isinstance(critical, str):
            raise LoopError(f"critical is {critical!r}; it must be a list of PVs")
        known = [s.name for s in manifest.pv]
        for name in critical:
            if name not in known:
                raise LoopError(f"critical has {name!r}, which is no PV{nearest(name, known)}")
        self.manifest = manifest
        self.bridge_s = BRIDGE_PERIODS * manifest.period_s if bridge_s is None else bridge_s
        self.critical = tuple(critical)
        self._last = np.full(len(manifest.pv), np.nan)  # the last good number of each PV
        self._gone = np.zeros(len(manifest.pv))  # periods since then, the present one included
        self._excused = np.zeros(len(manifest.pv))  # of those without a new reading, while nothing was wrong
        self._why = dict[int, str]()  # of PVs whose last reading was bad
        self._all_fresh = np.ones(len(manifest.pv))
        self._apart = "fresh" in manifest.inputs
        self._of_use = {e.signal: i for i, e in enumerate(manifest.operate) if e.group == "cv" and e.what == "use"}

    def beside(self, manifest: Manifest) -> Self:
        """The same readings for another law over the same PVs."""
        made = type(self)(manifest, self.bridge_s, self.critical)
        made._last, made._gone = self._last.copy(), self._gone.copy()
        made._excused, made._why = self._excused.copy(), dict(self._why)
        return made

    @property
    def unread_s(self) -> Array:
        """Time since each PV (n_pv,) was read well [s]; 0 for all of a law that takes a whole sample or none."""
        return self._gone * self.manifest.period_s if self._apart else np.zeros(len(self._gone))

    def missed(self, periods: int = 1) -> None:
        """Periods without a sample."""
        self._gone += periods

    def look(self, sample: Sample, guards: Sequence[Guard], past: Collection[Sample], operate: Array) -> Readings:
        """The readings of a sample, judged by ``guards``; ``past`` ends with the sample before it.

        ``operate`` (n_operate,) is what operators want. No content of a sample raises an exception.
        """
        try:
            reason, sample = self._judged(sample, guards, past)
            if not reason:
                return self._bridged(sample, operate) if self._apart else Readings(sample, "", sample.pv)
        except Exception as error:  # whatever a host gives as its numbers
            reason = first_line(error)
        self.missed()
        return Readings(sample, reason)

    def used(self, operate: Array, readings: Readings) -> Array:
        """``operate`` (n_operate,) as the law gets it: what is shed is not in use."""
        if not readings.shed:
            return operate
        found = operate.copy()
        found[[self._of_use[name] for name in readings.shed]] = 0.0
        return found

    def _judged(self, sample: Sample, guards: Sequence[Guard], past: Collection[Sample]) -> tuple[str, Sample]:
        """Why a sample is refused as a whole, or empty; and the sample with what speaks against single PVs."""
        if not isinstance(sample, Sample):
            return f"the sample is of the type {type(sample).__name__}; it must be a Sample", sample
        bad, n = sample.bad_pv, len(self.manifest.pv)
        if bad and not (isinstance(bad, tuple) and len(bad) == n and all(isinstance(why, str) for why in bad)):
            return f"bad_pv is {shown(bad)}; it needs a text for each of {n} PVs, or none at all", sample
        reason = ("" if self._apart else next(filter(None, bad), "")) or sample.fault
        if reason:
            return reason if isinstance(reason, str) else str(reason), sample
        if self._apart:
            stale = self._stale(sample)
            pv = np.where(stale, self._last, sample.pv) if stale.any() and np.shape(sample.pv) == (n,) else sample.pv
            seen = replace(sample, pv=pv, last_pv=self._last.copy(), since=self._gone + 1.0)
            why, judged = refused_apart(guards, seen, past, self.manifest.pv)
            return why or "", sample if judged.bad_pv is sample.bad_pv else replace(sample, bad_pv=judged.bad_pv)
        sample = sample if sample.fresh is None else replace(sample, fresh=None)  # this law takes all numbers as new
        return refused(guards, sample, past) or "", sample

    def _stale(self, sample: Sample) -> NDArray[np.bool_]:
        """Whether each PV (n_pv,) has no new reading; LoopError for a ``fresh`` that is none."""
        if sample.fresh is None:
            return np.zeros(len(self._last), dtype=bool)
        fresh = np.asarray(sample.fresh)
        if fresh.shape != self._last.shape or not np.isin(fresh, (0, 1)).all():
            raise LoopError(f"fresh is {shown(sample.fresh)}; it needs 0 or 1 for each of {len(self._last)} PVs")
        return np.asarray(fresh == 0)

    def _bridged(self, sample: Sample, operate: Array) -> Readings:
        """The readings of a sample that is good but for single PVs."""
        m = self.manifest
        pv = np.array(sample.pv, dtype=np.float64, ndmin=1)
        if not sample.bad_pv and sample.fresh is None and pv.shape == self._last.shape and isfinite(pv.sum()):
            self._last[:] = pv
            self._gone.fill(0.0)
            self._excused.fill(0.0)
            self._why.clear()
            return Readings(sample, "", pv, self._all_fresh)
        told = np.array([bool(why) for why in sample.bad_pv] or np.zeros(len(m.pv)), dtype=bool)
        stale = self._stale(sample) & ~told
        good = ~told & ~stale & np.isfinite(pv)
        for i, s in enumerate(m.pv):
            if good[i]:
                self._why.pop(i, None)
            elif not stale[i]:
                self._why[i] = (
                    sample.bad_pv[i] if told[i] else Fault(f"PV {s.name} is {pv[i]}", "number", f"PV {s.name}")
                )
        self._last[good], self._gone[good], self._excused[good] = pv[good], -1.0, 0.0
        self._gone += 1.0
        self._excused[[i for i in np.flatnonzero(stale).tolist() if i not in self._why]] += 1.0
        if good.all():  # a sum of finite numbers may overflow
            return Readings(sample, "", pv, self._all_fresh)
        bridged, shed, needed = dict[str, str](), dict[str, str](), dict[str, str]()
        for i in np.flatnonzero(~good).tolist():
            name = m.pv[i].name
            why = self._why.get(i, "")
            if np.isnan(self._last[i]):
                why = why or Fault(f"PV {name} has no new reading", "fresh", f"PV {name}")
                return Readings(sample, reworded(why, f"{why}; it has not been read yet"))
            if not why:
                continue
            if (self._gone[i] - self._excused[i] - 1) * m.period_s < self.bridge_s:
                bridged[name] = why
            elif name in self.critical or name not in self._of_use:
                needed[name] = why
            else:
                shed[name] = why
        if needed:
            return Readings(sample, _without(needed, "the loop needs it, or the law cannot leave it out"))
        wanted = [name for name, place in self._of_use.items() if operate[place] > 0]
        if shed and wanted and not set(wanted) - set(shed):
            return Readings(sample, _without(shed, "no controlled variable is left"))
        return Readings(sample, "", np.where(good, pv, self._last), good.astype(np.float64), bridged, shed)


def _without(those: Mapping[str, str], end: str) -> Fault:
    """A fault of all of these PVs, each with its reason."""
    kinds = {why.kind if isinstance(why, Fault) else "" for why in those.values()}
    subjects = ", ".join(f"PV {name}" for name in those)
    lasts = "; ".join(lasting(why) for why in those.values())
    return Fault(f"{'; '.join(those.values())}; {end}", ", ".join(sorted(kinds)), subjects, f"{lasts}; {end}")
