"""Time on control, week by week: how long in each mode, which signals were in use, and what bound them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from math import isfinite, nan
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.guard import Sample
from loopwright.serving.loop import Command, Mode
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.monitor.cusum import SIZE_RANGE, number
from loopwright.serving.monitor.signal_use import SignalUse, UseOfSignals
from loopwright.serving.monitor.verdicts import worst_validated

Array: TypeAlias = NDArray[np.float64]
Counts: TypeAlias = dict[str, float]

AT_LIMIT = 1e-3  # of an MV's range: nearer than that it stands at its limit, as a read-back may be rounded
WEEK = "week "  # how the names begin under which a journal keeps weeks
MOST_NAMES = 10_000  # numbers of a week that are believed
VALUES = ("low_limit", "high_limit", "validated", "period_s")  # that are no counts but the last value seen


def week_of(time_s: float) -> str:
    """The Monday, in UTC, of the week of a time [s since 1970], as 2026-11-23."""
    day = datetime.fromtimestamp(time_s, UTC)
    return (day - timedelta(days=day.weekday())).strftime("%Y-%m-%d")


class WeeklyCounts:
    """Counts of the scans of a week, over all controllers that had the plant.

    A count has the name of its mode (``AUTO``), ``all in use`` (in AUTO with every signal), or that of a signal and of
    what is counted:

        cv NAME tracked, ranged, out, shed, bridged     scans in AUTO
        cv NAME at_low, at_high                         of those in use: at or beyond an end of its range
        cv NAME error, readings                         sum of |error| [pv], and the new readings that it is of
        mv NAME moved, out                              scans in AUTO: the law moves it, or operators have it out
        mv NAME clamped_low, clamped_high               at an operator's limit inside the engineered one
        mv NAME end_low, end_high                       at an end of its range
        mv NAME fastest, travel                         as fast as it may; sum of |moves| [mv]

    ``low_limit`` and ``high_limit`` of an MV are the operators' limits that bound it last, ``validated`` of a CV the
    largest mean error of its validation's noisy tests, where there is one CV.
    """

    def __init__(self, week: str = "", counts: Mapping[str, float] | None = None) -> None:
        self.week, self.counts = week, dict(counts or {})
        self._of: Manifest | None = None
        self._last: Array | None = None  # shape: (n_mv,), the MVs of the scan before, in AUTO

    def add(
        self, manifest: Manifest, sample: Sample | None, command: Command, time_s: float, operate: Array | None = None
    ) -> None:
        """One scan of the law of ``manifest``; ``operate`` (n_operate,) is what operators want of it."""
        week = week_of(time_s)
        if week != self.week:
            self.week, self.counts = week, {}
        if manifest is not self._of:
            self._of, self._use, self._last = manifest, UseOfSignals(manifest), None
            self._validated = worst_validated(manifest) if len(manifest.sp) == 1 else None
        self.counts["period_s"] = manifest.period_s
        self._count(command.mode.value)
        if command.mode is not Mode.AUTO or sample is None or command.law_mv is None:
            self._last = None
            return
        use = self._use.of(sample, command, operate)
        self._count("all in use", all(use.moved) and all(u for u in use.used[: len(manifest.sp)]))
        self._of_cvs(manifest, np.asarray(sample.pv, dtype=np.float64).tolist(), command, use)
        self._of_mvs(manifest.mv, command.mv, use)
        self._last = command.mv

    def _count(self, name: str, by: float = 1.0) -> None:
        if by:
            self.counts[name] = self.counts.get(name, 0.0) + by

    def _of_cvs(self, m: Manifest, pv: list[float], command: Command, use: SignalUse) -> None:
        errors = use.errors(pv, command.sp.tolist())
        for i, s in enumerate(m.pv):
            if i >= len(m.sp) and not isfinite(use.low[i]):
                continue  # neither a set point nor a range: the law reads it, and nobody controls it
            cv, used = f"cv {s.name}", use.used[i]
            shed = s.name in command.shed
            self._count(f"{cv} {'shed' if shed else 'tracked' if use.tracked[i] else 'ranged' if used else 'out'}")
            self._count(f"{cv} bridged", s.name in command.bridged)
            if not (used and use.fresh[i] and isfinite(errors[i])):
                continue
            inside = s.low < use.low[i], use.high[i] < s.high
            self._count(f"{cv} at_low", inside[0] and pv[i] <= use.low[i])
            self._count(f"{cv} at_high", inside[1] and pv[i] >= use.high[i])
            if use.tracked[i]:
                self._count(f"{cv} error", abs(errors[i]))
                self._count(f"{cv} readings")
                if self._validated is not None:
                    self.counts[f"{cv} validated"] = self._validated

    def _of_mvs(self, signals: tuple[Signal, ...], at: Array, use: SignalUse) -> None:
        before = [nan] * len(signals) if self._last is None else self._last.tolist()
        for i, (s, mv, last) in enumerate(zip(signals, at.tolist(), before, strict=True)):
            name, near = f"mv {s.name}", AT_LIMIT * (s.high - s.low)
            self._count(f"{name} {'moved' if use.moved[i] else 'out'}")
            if not use.moved[i] or not isfinite(mv):
                continue
            for end, limit, engineered, reached in (
                ("low", use.mv_low[i], s.low, mv <= use.mv_low[i] + near),
                ("high", use.mv_high[i], s.high, mv >= use.mv_high[i] - near),
            ):
                if reached and abs(limit - engineered) > near:
                    self._count(f"{name} clamped_{end}")
                    self.counts[f"{name} {end}_limit"] = limit
                elif reached:
                    self._count(f"{name} end_{end}")
            if isfinite(last):
                self._count(f"{name} travel", abs(mv - last))
                self._count(f"{name} fastest", abs(mv - last) >= (1 - AT_LIMIT) * use.mv_most[i])

    def text(self) -> str:
        """The counts, as a journal keeps them."""
        return json.dumps(self.counts, allow_nan=False)


def counts_of(text: str) -> Counts:
    """The counts that a journal kept. ValueError where they could be none."""
    found = json.loads(text)
    if not isinstance(found, dict) or len(found) > MOST_NAMES:
        raise ValueError("what was counted is no week's")
    return {name: _number(name, value) for name, value in found.items()}


def _number(name: str, value: Any) -> float:
    least = -SIZE_RANGE[1] if name.endswith("_limit") else 0.0
    return number(value, name, (least, SIZE_RANGE[1]))


def signals_in(counts: Mapping[str, float]) -> Iterator[tuple[str, str, Counts]]:
    """(``cv`` or ``mv``, name, its counts) of each signal of a week, in the order in which they were counted."""
    found = dict[tuple[str, str], Counts]()
    for key, value in counts.items():
        group, _, rest = key.partition(" ")
        name, _, what = rest.rpartition(" ")
        if group in {"cv", "mv"} and name:
            found.setdefault((group, name), {})[what] = value
    for (group, name), of in found.items():
        yield group, name, of
