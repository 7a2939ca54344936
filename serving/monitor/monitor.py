"""The monitor of one controller: fed scan by scan, asked for verdicts now and then."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from math import ceil, inf, isfinite
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.guard import Sample
from loopwright.serving.loop import Command, Mode
from loopwright.serving.manifest import Manifest
from loopwright.serving.monitor.actuator_checks import ACTUATOR_AT_END, ActuatorFaults, Following
from loopwright.serving.monitor.batches import BatchMeans
from loopwright.serving.monitor.cusum import (
    ANY,
    DAY_S,
    TIME_S,
    WEEK_S,
    Chart,
    answer_scans,
    blocks,
    number,
    pooled,
    settle_scans,
)
from loopwright.serving.monitor.loop_statistics import Estimates, Foresight, Share, Swing, harris_index, log_mean_square
from loopwright.serving.monitor.plant_drift import Answers, RestMap
from loopwright.serving.monitor.signal_use import SignalUse, UseOfSignals
from loopwright.serving.monitor.verdicts import Verdict, failed, verdicts


def numbers(m: Monitor) -> dict[str, float]:
    """For those who draw it over months."""
    found = {"saturated_share": m.saturated.value, "hold_share": m.hold.value}
    if min(m.max_move) < inf:
        found["rate_limited_share"] = m.limited.value
    if m.domain is not None:
        found["outside_domain_share"] = m.outside.value
    for i, s in enumerate(m.manifest.sp):
        found[f"mean_error_{s.name}"] = m.errors[i].value * float(s.high - s.low)
        found[f"regularity_{s.name}"] = m.swings[i].regularity()
        if m.harris[i].count:
            found[f"harris_index_{s.name}"] = m.harris[i].value
        seen = m.residual
        if seen.chart.learnt if isinstance(seen, Foresight) else seen.sizes.learnt:
            found[f"residual_ratio_{s.name}"] = seen.ratio(i)
    if m.rest.learnt:
        for i, s in enumerate(m.manifest.mv):
            found[f"shift_at_rest_{s.name}"] = m.rest.chart.shift(i) * float(s.high - s.low)
            gain = m.rest.gain(i)
            if gain is not None:
                found[f"gain_ratio_{s.name}"] = gain[0]
    return {name: value for name, value in found.items() if isfinite(value)}


# --------------------------------------------------------------------------------------------------------- the monitor
Array: TypeAlias = NDArray[np.float64]

LEARN_RESTS, LEARN_MODEL, LEARN_BLOCKS = 300, 20, 40  # periods of rest, blocks of the model, blocks of a chart
BLOCK_SETTLINGS = 10  # settling times: a block holds some moves of the set point
FALSE_ALARMS = 0.25  # a week that are allowed to all charts together
LEAST_DAY, MOST_DAY = 2_000, 200_000  # scans over which a share is taken
SWING_BAND = 0.005  # of a set point's range: smaller errors are no swing
HARRIS_SCANS = 500  # scans that Harris's index is taken from
NEAR_REST = 0.02  # of a set point's range: a mean error beyond is no rest
LEAST_READINGS = 3  # of each variable in a period of rest: a slow analyser makes it longer


class Monitor:
    """Watches one controller in its loop.

    ``observe`` takes a scan: bounded work and memory, and no content of it raises. Only new and good readings count. A
    controlled variable that operators have out of use, or within a range alone, has no error from its set point, and
    an MV that they have out of use no fault. Rests are those of the ``operate`` with which it began.

    The loop's settling time in the validation (the evidence's ``settling``, else ``SETTLE_SCANS``) says how long a
    period of rest is. It learns the normal from the first periods in AUTO; ``loopwright.serving.monitor.verdicts`` says
    what each figure is held against.

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
        period, rate = m.period_s, FALSE_ALARMS / 6
        rests, pool = pooled(LEARN_RESTS, self.settle * period)
        weekly = WEEK_S / (self.settle * period)
        self.rest = RestMap(m.sp, m.mv, learn=rests, pool=pool, weekly=weekly, rate=rate)
        # The logarithm of the error's mean square at rest.
        self.spread = Chart(
            len(m.sp), rests // pool, pool=pool, weekly=weekly, rate=rate / len(m.sp), least=0.3, both=False
        )
        block_s, times = blocks(LEARN_MODEL + LEARN_BLOCKS, BLOCK_SETTLINGS * self.settle * period)
        block, model, learn = ceil(block_s / period), round(times * LEARN_MODEL), round(times * LEARN_BLOCKS)
        weekly = WEEK_S / (block * period)
        self.foresight = Foresight(m, block=block, learn=learn, weekly=weekly, rate=rate)
        self.answers = Answers(
            m, block=block, model=model, learn=learn, weekly=weekly, rate=rate, told=self.foresight.told
        )
        self.estimates = Estimates(m.info, block=block, learn=learn, weekly=weekly, rate=rate)
        self.batches = BatchMeans(m, rate)
        self.swings = [Swing(SWING_BAND * (s.high - s.low)) for s in m.sp]
        self.actuators = ActuatorFaults(m.mv, 2 * self.settle)
        self.following = Following(m.mv, self.settle)
        self._commanded: Array | None = None  # at the scan before, where it was written
        self.harris = [Share(1, 20) for _ in m.sp]
        self.first_answers = answer_scans(m)
        self.use = UseOfSignals(m)
        self._taste: tuple[float, ...] | None = None  # the values of ``operate`` that move rests, as it began
        self._held = np.full(len(m.pv), np.nan)  # the last good reading of each PV
        self._silent = [0] * len(m.sp)  # scans since each was read
        self._window = [deque[float](maxlen=HARRIS_SCANS) for _ in m.sp]
        self.domain = m.info.index("in_domain") if "in_domain" in m.info else None
        self._mv_low = np.array([s.low for s in m.mv])
        self._mv_span = np.array([s.high - s.low for s in m.mv])
        self._sp_span = np.array([s.high - s.low for s in m.sp])
        self._span: list[float] = self._sp_span.tolist()
        self.max_move = [inf if s.max_move is None else 0.999 * s.max_move / (s.high - s.low) for s in m.mv]
        pv_spans = [s.high - s.low for s in m.pv]
        self._error_span = [*self._span, *pv_spans[len(self._span) :]]
        self._sp: list[float] | None = None
        self._last: list[float] | None = None  # the MVs of the scan before, as shares of their ranges
        self._still = 0  # scans since the set points moved or the loop left AUTO
        self._mv_sum, self._e_sum, self._e2_sum = np.zeros(0), np.zeros(0), np.zeros(0)
        self._clear()
        self.trouble = ""  # what the monitor itself failed at

    @property
    def residual(self) -> Foresight | Answers:
        """Source of the one-step error: the law where it gives its expectation, else a model beside it."""
        return self.foresight if self.foresight.told else self.answers

    # ------------------------------------------------------------------ a scan
    def observe(self, time_s: float, sample: Sample | None, command: Command, operate: Array | None = None) -> None:
        """One scan, at ``time_s`` [s since 1970]; ``operate`` (n_operate,) is what operators want, None: defaults."""
        try:
            self._observe(time_s, sample, command, self.use.of(sample, command, operate))
        except Exception as error:  # the loop goes on, whatever fails here
            self.trouble = f"{type(error).__name__}: {error}"
            self._gap()

    def _observe(self, time_s: float, sample: Sample | None, command: Command, use: SignalUse) -> None:
        lawful = sample is not None and command.mode is Mode.AUTO and command.law_mv is not None
        pv = self._readings(sample, use) if sample is not None and lawful else None
        errors = None if pv is None else use.errors(pv.tolist(), command.sp.tolist())
        self._follow(time_s, sample, command, None if errors is None else self._largest(errors), use)
        if command.mode is not Mode.SHADOW:
            self.hold.add(float(command.mode is Mode.HOLD))
        if pv is None or errors is None:
            if command.mode in {Mode.SHADOW, Mode.MANUAL}:  # a batch's end; a fault is none
                self.batches.end(time_s)
            self._gap()
            return
        mv, sp = command.mv, command.sp.tolist()
        shares = ((mv - self._mv_low) / self._mv_span).tolist()
        if not isfinite(sum(errors) + sum(shares)):
            self._gap()
            return
        saturated = self._shares(shares, command, use)
        self._errors(errors, use)
        self.actuators.add(mv, self._largest(errors), time_s, use.moved)
        fresh = None if all(use.fresh) else np.array(use.fresh, dtype=np.float64)
        missed = self.foresight.add(pv, command.info, time_s, fresh)
        self.answers.add(pv, mv, missed, time_s, fresh)
        if not (command.bridged or command.shed):  # what it corrects stands still while a reading is bad
            self.estimates.add(command.info, time_s)
        self.batches.add((command.sp, pv, mv, command.info), time_s, fresh)
        if sp != self._sp:
            self._moved(sp)
        self._still += 1
        if self._taste is None:
            self._taste = use.taste
        if use.taste != self._taste or self._bound(mv, pv, use):
            self._still = 0
            self._clear()
        if self._still > 2 * self.settle:
            self._rest(time_s, errors, mv, saturated, use)

    def _readings(self, sample: Sample, use: SignalUse) -> Array | None:
        """The PVs (n_pv,), the last good one where there is no new one; None as long as one has not been read."""
        pv = np.asarray(sample.pv, dtype=np.float64)
        if not all(use.fresh):
            pv = np.where(use.fresh, pv, self._held)
        self._held = pv
        return pv if np.isfinite(pv).all() else None

    def _largest(self, errors: list[float]) -> float:
        """The largest error, as a share of the range of its set point or PV."""
        return float(max(abs(e) / span for e, span in zip(errors, self._error_span, strict=True)))

    def _errors(self, errors: list[float], use: SignalUse) -> None:
        """Errors from set points that are wanted, at new readings."""
        for i, (mean, swing) in enumerate(zip(self.errors, self.swings, strict=True)):
            self._silent[i] += 1
            if not use.tracked[i]:
                swing.forget()
                self._silent[i] = 0
            elif use.fresh[i]:
                mean.add(abs(errors[i]) / self._span[i])
                swing.add(errors[i], self._silent[i])
                self._silent[i] = 0

    def _bound(self, mv: Array, pv: Array, use: SignalUse) -> bool:
        """Whether operators' limits or ranges decide where the plant rests: then set points do not."""
        near = ACTUATOR_AT_END * self._mv_span
        low, high = self._mv_low + near, self._mv_low + self._mv_span - near  # the engineered ends are ``saturated``
        limits = zip(mv.tolist(), use.mv_low, use.mv_high, low.tolist(), high.tolist(), near.tolist(), strict=True)
        if any((a > low and at <= a + by) or (b < high and at >= b - by) for at, a, b, low, high, by in limits):
            return True
        ranges = zip(pv.tolist(), use.used, use.low, use.high, strict=True)
        return any(used and not low < value < high for value, used, low, high in ranges)

    def _follow(
        self, time_s: float, sample: Sample | None, command: Command, error: float | None, use: SignalUse
    ) -> None:
        """Compare the read-back with the command before, in each mode that writes; a fault says nothing of it."""
        before, self._commanded = self._commanded, None
        if sample is None or sample.mv_applied is None or command.fault or not command.writes:
            self.following.forget()
            return
        self._commanded = command.mv
        applied = np.asarray(sample.mv_applied, dtype=np.float64)
        if before is None or applied.shape != before.shape or not np.isfinite(applied).all():
            return
        moved = use.moved if command.mode is Mode.AUTO else None
        self.following.add(applied, before, error, time_s, moved)

    def _shares(self, shares: list[float], command: Command, use: SignalUse) -> bool:
        ends = zip(shares, use.moved, strict=True)
        saturated = any(moved and (s <= ACTUATOR_AT_END or s >= 1 - ACTUATOR_AT_END) for s, moved in ends)
        self.saturated.add(float(saturated))
        if self._last is not None:
            moves = zip(shares, self._last, self.max_move, strict=True)
            self.limited.add(float(any(abs(s - before) >= most for s, before, most in moves)))
        if self.domain is not None and command.info is not None:
            self.outside.add(float(command.info[self.domain] < 0.5))
        self._last = shares
        return saturated

    def _moved(self, sp: list[float]) -> None:
        """The set points are others than at the scan before."""
        before = self._sp
        if before is None or any(
            abs(a - b) > SWING_BAND * span for a, b, span in zip(sp, before, self._span, strict=True)
        ):
            self._steady()
        self._sp, self._still = sp, 0
        self._clear()

    def _rest(self, time_s: float, errors: list[float], mv: Array, saturated: bool, use: SignalUse) -> None:
        """A scan at set points that stand still; a period of rest is whole after ``settle`` of them."""
        self._n += 1
        n_sp = len(self._span)
        new = np.array(use.fresh[:n_sp], dtype=np.float64)
        error = new * np.array(errors[:n_sp])
        self._readings_of += new
        self._mv_sum += mv
        self._e_sum += error
        self._e2_sum += error * error
        self._ends += saturated
        for window, value, is_new in zip(self._window, errors[:n_sp], use.fresh[:n_sp], strict=True):
            if is_new:
                window.append(value)
            else:
                window.clear()  # its index is of readings at each scan
        if self._n < self.settle or (self._readings_of < LEAST_READINGS).any():
            return
        mean = self._e_sum / self._readings_of
        if not self._ends and (np.abs(mean) <= NEAR_REST * self._sp_span).all():
            self.rest.add(np.array(self._sp), self._mv_sum / self._n, time_s)
        self.spread.add(log_mean_square(self._e2_sum / self._sp_span**2, self._readings_of), time_s)
        for i, window in enumerate(self._window):
            if len(window) == HARRIS_SCANS:
                self.harris[i].add(harris_index(np.array(window), self.first_answers[i]))
                window.clear()
        self._clear()

    def _steady(self) -> None:
        """Swings count from here: a set point that moves swings the error by itself."""
        for swing in self.swings:
            swing.forget()

    def _gap(self) -> None:
        """No sample, or another mode: what follows has nothing to do with what was."""
        self.foresight.forget()
        self.answers.forget()
        self.batches.forget()
        self.actuators.forget()
        self._steady()
        self._silent = [0] * len(self._span)
        self._sp = self._last = None
        self._still = 0
        self._clear()

    def _clear(self) -> None:
        self._n = self._ends = 0
        self._readings_of = np.zeros(len(self.manifest.sp))
        self._mv_sum = np.zeros(len(self.manifest.mv))
        self._e_sum, self._e2_sum = np.zeros(len(self.manifest.sp)), np.zeros(len(self.manifest.sp))

    # ------------------------------------------------------------------ what it says
    def verdicts(self) -> list[Verdict]:
        """A plain line on each thing that is watched. It never raises, and its figures are finite."""
        try:
            with np.errstate(all="ignore"):
                found = verdicts(self)
        except Exception as error:  # whatever was learnt, the loop's state is told
            return [failed(f"{type(error).__name__}: {error}")]
        return [replace(v, value=_finite(v.value), limit=_finite(v.limit)) for v in found]

    def numbers(self) -> dict[str, float]:
        """The figures, for those who draw them over months. It never raises, and every number is finite."""
        try:
            with np.errstate(all="ignore"):
                return numbers(self)
        except Exception:  # ``verdicts`` says what fails
            return {}

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
        "answers",
        "estimates",
        "batches",
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
            "taste": None if self._taste is None else list(self._taste),
            "parts": {n: [p.memory() for p in v] if isinstance(v, list) else v.memory() for n, v in parts.items()},
        }

    @classmethod
    def restored(cls, manifest: Manifest, state: Any) -> Self:
        """The monitor that gave ``state``. ValueError where it is another controller's, or could be no monitor's."""
        if not isinstance(state, dict) or not isinstance(parts := state.get("parts"), dict):
            raise ValueError("what was learnt is no monitor's")
        made = cls(manifest, started_s=number(state.get("started_s"), "started_s", TIME_S))
        if state.get("law") != manifest.law or state.get("settle") != made.settle:
            raise ValueError("what was learnt is of another controller")
        for name in cls.PARTS:
            part, kept = getattr(made, name), parts.get(name)
            if not isinstance(part, list):
                part.recall(kept)
                continue
            if not isinstance(kept, list) or len(kept) != len(part):
                raise ValueError(f"what was learnt of {name} is not of {len(part)} signals")
            for one, memory in zip(part, kept, strict=True):
                one.recall(memory)
        taste = state.get("taste")
        if taste is not None:
            if not isinstance(taste, list):
                raise ValueError("the values of operate with which it began are no list of numbers")
            made._taste = tuple(number(v, "taste", ANY) for v in taste)
        made._tried()
        return made

    def _tried(self) -> None:
        """ValueError where no verdict can be given: numbers that are each well may not go together."""
        try:
            with np.errstate(all="ignore"):
                verdicts(self)
                numbers(self)
        except Exception as error:
            raise ValueError(f"what was learnt gives no verdict: {type(error).__name__}: {error}") from None


def _finite(value: float | None) -> float | None:
    return value if value is None or isfinite(value) else None
