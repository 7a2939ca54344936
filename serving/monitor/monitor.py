"""The monitor of one controller: fed scan by scan, asked for verdicts now and then."""

from __future__ import annotations

from collections import deque
from math import isfinite, log
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.guard import Sample
from serving.loop import Command, Mode
from serving.manifest import Manifest
from serving.monitor.cusum import Drift
from serving.monitor.error import Swing, harris_index
from serving.monitor.estimates import Estimates
from serving.monitor.plight import Plight
from serving.monitor.residual import Foresight
from serving.monitor.rest import RestMap
from serving.monitor.shares import Share
from serving.monitor.verdict import Verdict
from serving.monitor.verdicts import verdicts

Array: TypeAlias = NDArray[np.float64]

SETTLE, LEAST_SETTLE, MOST_SETTLE = 100, 20, 2000  # scans
LEARN_RESTS = 300  # periods of rest
LEARN_BLOCKS = 60
DAY_S = 86_400.0
LEAST_DAY, MOST_DAY = 2_000, 200_000  # scans over which a share is taken
BAND = 0.005  # of a set point's range: smaller errors are no swing
HARRIS_SCANS = 500
AT_END = 1e-6  # of the range
NEAR_REST = 0.02  # of a set point's range: a mean error beyond is no rest


class Monitor:
    """Watches one controller in its loop.

    ``observe`` takes a scan: bounded work and memory, and no content of it raises. The settling time of the
    validation (the evidence's ``settling``, else ``SETTLE`` scans) says how long a period of rest is. What normal is,
    it learns from the first periods in AUTO; ``serving.monitor.verdicts`` says what each figure is held against.

    Parameters
    ----------
    manifest
        The controller's.
    started_s
        When it began [s since 1970].
    """

    def __init__(self, manifest: Manifest, *, started_s: float) -> None:
        m = self.manifest = manifest
        self.started_s = started_s
        self.settle = settle_scans(m)
        day = int(min(max(DAY_S / m.period_s, LEAST_DAY), MOST_DAY))
        learn = 20 * self.settle
        self.saturated, self.hold, self.limited, self.outside = (Share(learn, day) for _ in range(4))
        self.errors = [Share(learn, day) for _ in m.sp]  # mean |error|, of the range
        self.rest = RestMap(m.sp, m.mv, LEARN_RESTS)
        self.spread = [Drift(LEARN_RESTS, 0.3) for _ in m.sp]  # log of the error's mean square at rest
        self.foresight = Foresight(m, self.settle, LEARN_BLOCKS)
        self.estimates = Estimates(m.info, 10 * self.settle, LEARN_BLOCKS)
        self.swings = [Swing(BAND * (s.high - s.low)) for s in m.sp]
        self.plight = Plight(m.mv, 2 * self.settle)
        self.harris = [Share(1, 20) for _ in m.sp]
        self.moves = np.zeros(len(m.mv))
        self._window = [deque[float](maxlen=HARRIS_SCANS) for _ in m.sp]
        self._domain = m.info.index("in_domain") if "in_domain" in m.info else None
        self._mv_low = np.array([s.low for s in m.mv])
        self._mv_span = np.array([s.high - s.low for s in m.mv])
        self._sp_span = np.array([s.high - s.low for s in m.sp])
        self._max_move = np.array([np.inf if s.max_move is None else s.max_move for s in m.mv])
        self._sp: Array | None = None
        self._last_mv: Array | None = None
        self._still = 0  # scans since the set points moved or the loop left AUTO
        self._mv_sum, self._e_sum, self._e2_sum = np.zeros(0), np.zeros(0), np.zeros(0)
        self._clear()
        self.trouble = ""  # what the monitor itself failed at

    # ------------------------------------------------------------------ a scan
    def observe(self, time_s: float, sample: Sample | None, command: Command) -> None:
        """One scan, at ``time_s`` [s since 1970]."""
        try:
            self._observe(time_s, sample, command)
        except Exception as error:  # the loop goes on, whatever fails here
            self.trouble = f"{type(error).__name__}: {error}"
            self._gap()

    def _observe(self, time_s: float, sample: Sample | None, command: Command) -> None:
        if command.mode is not Mode.SHADOW:
            self.hold.add(float(command.mode is Mode.HOLD))
        if sample is None or command.mode is not Mode.AUTO or command.law_mv is None:
            if command.mode in {Mode.SHADOW, Mode.MANUAL}:  # a batch's end; a fault is none
                self.estimates.end(time_s)
            self._gap()
            return
        pv, mv = np.asarray(sample.pv, dtype=np.float64), command.mv
        n_cv = len(self.manifest.sp)
        error = pv[:n_cv] - command.sp
        if not isfinite(float(error.sum() + mv.sum())):
            self._gap()
            return
        saturated = self._shares(mv, command)
        for i, value in enumerate(error.tolist()):
            self.errors[i].add(abs(value) / self._sp_span[i])
            self.swings[i].add(value)
        self.plight.add(mv, float(np.max(np.abs(error) / self._sp_span)), time_s)
        self.foresight.add(pv, mv, command.info, time_s)
        self.estimates.add(command.info, time_s)
        if self._sp is None or not np.array_equal(self._sp, command.sp):
            self._sp, self._still = command.sp.copy(), 0
            self._clear()
        self._still += 1
        if self._still > 2 * self.settle:
            self._rest(time_s, error, mv, saturated)
        self._last_mv = mv

    def _shares(self, mv: Array, command: Command) -> bool:
        share = (mv - self._mv_low) / self._mv_span
        saturated = bool((share <= AT_END).any() or (share >= 1 - AT_END).any())
        self.saturated.add(float(saturated))
        if self._last_mv is not None:
            self.limited.add(float((np.abs(mv - self._last_mv) >= 0.999 * self._max_move).any()))
        if self._domain is not None and command.info is not None:
            self.outside.add(float(command.info[self._domain] < 0.5))
        return saturated

    def _rest(self, time_s: float, error: Array, mv: Array, saturated: bool) -> None:
        """A scan at set points that stand still; a period of rest is whole after ``settle`` of them."""
        self._n += 1
        self._mv_sum = self._mv_sum + mv
        self._e_sum = self._e_sum + error
        self._e2_sum = self._e2_sum + error**2
        self._ends += saturated
        for window, value in zip(self._window, error.tolist(), strict=True):
            window.append(value)
        if self._n < self.settle:
            return
        mean = self._e_sum / self._n
        if not self._ends and (np.abs(mean) <= NEAR_REST * self._sp_span).all():
            assert self._sp is not None
            self.rest.add(self._sp, self._mv_sum / self._n, time_s)
        for i, drift in enumerate(self.spread):
            drift.add(log(float(self._e2_sum[i]) / self._n / self._sp_span[i] ** 2 + 1e-18), time_s)
            if len(self._window[i]) == HARRIS_SCANS:
                self.harris[i].add(harris_index(np.array(self._window[i]), 2))
                self._window[i].clear()
        self._clear()

    def _gap(self) -> None:
        """No sample, or another mode: what follows has nothing to do with what was."""
        self.foresight.forget()
        self.plight.forget()
        self._sp = self._last_mv = None
        self._still = 0
        self._clear()

    def _clear(self) -> None:
        self._n = self._ends = 0
        self._mv_sum = np.zeros(len(self.manifest.mv))
        self._e_sum, self._e2_sum = np.zeros(len(self.manifest.sp)), np.zeros(len(self.manifest.sp))

    # ------------------------------------------------------------------ what it says
    def verdicts(self) -> list[Verdict]:
        """A plain line on each thing that is watched."""
        return verdicts(self)

    def numbers(self) -> dict[str, float]:
        """What was measured, for those who draw it over months."""
        m = self.manifest
        found = {"saturated_share": self.saturated.value, "hold_share": self.hold.value}
        if np.isfinite(self._max_move).any():
            found["rate_limited_share"] = self.limited.value
        if self._domain is not None:
            found["outside_domain_share"] = self.outside.value
        for i, s in enumerate(m.sp):
            found[f"mean_error_{s.name}"] = self.errors[i].value * float(self._sp_span[i])
            found[f"regularity_{s.name}"] = self.swings[i].regularity()
            if self.harris[i].count:
                found[f"harris_index_{s.name}"] = self.harris[i].value
            if self.foresight.learnt:
                found[f"residual_ratio_{s.name}"] = self.foresight.ratio(i)
        if self.rest.learnt:
            for i, s in enumerate(m.mv):
                found[f"shift_at_rest_{s.name}"] = float(self.rest.shift[i] * self._mv_span[i])
                gain = self.rest.gain(i)
                if gain is not None:
                    found[f"gain_ratio_{s.name}"] = gain[0]
        return {name: value for name, value in found.items() if isfinite(value)}

    # ------------------------------------------------------------------ over a restart
    PARTS = (
        "saturated",
        "hold",
        "limited",
        "outside",
        "errors",
        "rest",
        "spread",
        "foresight",
        "estimates",
        "swings",
        "harris",
    )

    def state(self) -> dict[str, Any]:
        """All that was learnt, JSON-ready."""
        parts = {name: getattr(self, name) for name in self.PARTS}
        return {
            "law": self.manifest.law,
            "settle": self.settle,
            "started_s": self.started_s,
            "parts": {n: [p.memory() for p in v] if isinstance(v, list) else v.memory() for n, v in parts.items()},
        }

    @classmethod
    def restored(cls, manifest: Manifest, state: dict[str, Any]) -> Self:
        """The monitor that gave ``state``. ValueError, KeyError or TypeError where it is another controller's."""
        made = cls(manifest, started_s=float(state["started_s"]))
        if state["law"] != manifest.law or state["settle"] != made.settle:
            raise ValueError("what was learnt is of another controller")
        for name in cls.PARTS:
            part, kept = getattr(made, name), state["parts"][name]
            if isinstance(part, list):
                for one, memory in zip(part, kept, strict=True):
                    one.recall(memory)
            else:
                part.recall(kept)
        return made


def settle_scans(m: Manifest) -> int:
    """Scans of a settling time: the median over the evidence's tests."""
    rows = m.evidence.get("scenarios")
    found = [row.get("settling") for row in rows.values() if isinstance(row, dict)] if isinstance(rows, dict) else []
    times = sorted(float(v) for v in found if isinstance(v, int | float) and v > 0)
    scans = round(times[len(times) // 2] / m.period_s) if times else SETTLE
    return min(max(scans, LEAST_SETTLE), MOST_SETTLE)
