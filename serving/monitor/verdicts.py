"""The meaning of the figures, in plain lines.

| verdict | held against |
|---|---|
| saturated, at a rate limit, outside the domain | twice the share of the learning time, at least .2 (domain: .1) |
| time in HOLD | .02 |
| MV at its end beside an error above a tenth of the range | two settling times |
| read-back that stands | a settling time with the command .05 of the range off, or two beside a large error |
| MV that turns round | four of five moves, of a twentieth of its range |
| swing | regularity 1, with errors beyond LOUD times the learning time's at rest (before that: a tenth of the range) |
| variability | the learning time's scatter at rest (chart); the mean error also against the validation's largest |
| load, offset, disturbance of the law's info | the learning time's (chart) |
| MV at rest | the learnt map and its scatter (chart) |
| gain | 15 % and four standard errors |
| one-step error | the learning time's (chart); retrain: RETRAIN_RATIO times it |
| answer of a PV | what the errors of a linear model went with while it learnt (chart) |
| a variable over a batch | its means over the eighths of the first batches (chart) |

A chart is a CUSUM whose limit follows from the false alarms a week that are allowed: see
``loopwright.serving.monitor.cusum``.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.monitor.batches import BATCH_PARTS
from loopwright.serving.monitor.loop_statistics import Foresight, rms_ratio

if TYPE_CHECKING:
    from loopwright.serving.monitor.monitor import Monitor

Level: TypeAlias = Literal["as validated", "watch", "retrain", "not known yet"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """One plain line on one thing. ``value`` is what was measured and ``limit`` what it may be; None: not known."""

    name: str
    level: Level
    text: str
    value: float | None = None
    limit: float | None = None


def unknown(name: str, text: str) -> Verdict:
    """Nothing can be said yet."""
    return Verdict(name, "not known yet", text)


def failed(trouble: str) -> Verdict:
    """The monitor itself has an error."""
    return Verdict("monitor", "watch", f"the monitor itself failed: {trouble}")


def when(time_s: float | np.floating[Any]) -> str:
    """A time [s since 1970] in UTC; the page writes what it finds in this form in the zone of its own clock."""
    return datetime.fromtimestamp(float(time_s), UTC).strftime("%Y-%m-%d %H:%M UTC")


def unit_of(s: Signal) -> str:
    """The unit and a blank; nothing of a signal without one."""
    return "" if s.unit == "-" else f"{s.unit} "


# ------------------------------------------------------------------------------------------ the meaning of the figures
MOST_HOLD = 0.02  # share of the time in HOLD: above it somebody should look
TOLD_AT_LIMITS, TOLD_OUTSIDE = 0.2, 0.1  # of the time: at limits, and outside the domain, from which on it is told
SWING_REGULARITY = 1.0  # regularity of the error's crossings above which it is a swing, if large enough too
WORSE_ERROR = 2.0  # times the validation's worst mean error: how often set points move is another matter here
LOUD = 4.0  # times the error at rest: noise crosses zero regularly too, by chance
PLAIN_SWING = 0.1  # of a set point's range: a swing that needs no measure of what is normal
TOLD_GAIN_CHANGE, TOLD_GAIN_ERRORS = 0.15, 4.0  # change of a gain, and in its standard errors, above which it is told
RETRAIN_RATIO, RETRAIN_LEARNT = 1.5, 2.5  # of a law's own prediction; of a linear model beside it


def verdicts(m: Monitor) -> list[Verdict]:
    """All of them; whoever asks is to be ready for any error, for what was learnt came from a file."""
    parts = (_actuators, _following, _residual, _answers, _estimates, _batches, _rest, _variability, _swing, _shares)
    found = [verdict for part in parts for verdict in part(m)]
    if m.trouble:
        found.append(failed(m.trouble))
    return found


def _actuators(m: Monitor) -> list[Verdict]:
    found = []
    for i, s in enumerate(m.manifest.mv):
        name, actuators = f"{s.name} moves", m.actuators
        if actuators.jammed(i):
            end = "upper" if actuators.end[i] > 0 else "lower"
            since = when(float(actuators.since_s[i]))
            text = f"{s.name} is at the {end} end of its range since {since}, and the error stays"
            found.append(Verdict(name, "watch", text, float(actuators.stuck[i]), float(actuators.patience)))
        elif actuators.flutters(i):
            size = f"{actuators.move[i] * (s.high - s.low):.3g} {unit_of(s)}".strip()
            text = f"{s.name} turns round at nearly every scan, by {size} each time"
            found.append(Verdict(name, "watch", text, float(actuators.turns[i])))
        else:
            found.append(Verdict(name, "as validated", "neither stuck at an end nor to and fro at each scan"))
    return found


def _following(m: Monitor) -> list[Verdict]:
    found, following = [], m.following
    for i, s in enumerate(m.manifest.mv):
        name = f"{s.name} read back"
        if following.stuck(i):
            stands, asked = following.at(i)
            text = f"{s.name} stands at {stands:.5g} {unit_of(s)}since {when(following.since_s[i])}"
            text += f" and does not follow the command, now {asked:.5g}: the actuator is stuck, or its read-back is"
            scans = float(max(following.away[i], following.pushed[i]))
            found.append(Verdict(name, "watch", text, scans, float(following.patience)))
        else:
            found.append(Verdict(name, "as validated", "the read-back follows the command"))
    return found


def _residual(m: Monitor) -> list[Verdict]:
    found = []
    seen = m.residual
    chart = seen.chart if isinstance(seen, Foresight) else seen.sizes
    limit = RETRAIN_RATIO if isinstance(seen, Foresight) else RETRAIN_LEARNT
    source = "the law's own prediction" if isinstance(seen, Foresight) else "a model that was learnt beside the law"
    for i, s in enumerate(m.manifest.sp):
        name = f"one-step error of {s.name}"
        if not chart.learnt:
            if not m.batches.known:
                done = chart.done if isinstance(seen, Foresight) else seen.done
                found.append(unknown(name, f"{source} is still measured: {done:.0%} done"))
            continue
        ratio = seen.ratio(i)
        if chart.found[i]:
            level: Level = "retrain" if ratio >= limit else "watch"
            text = f"{source} errs {ratio:.2g} times as much as at first, since {when(chart.since_s[i])}"
        else:
            level, text = "as validated", f"{source} errs as much as at first"
        found.append(Verdict(name, level, text, ratio, limit))
    return found


def _answers(m: Monitor) -> list[Verdict]:
    """Whether each PV answers as at first."""
    found = []
    batches = m.batches.known
    seen = m.batches.answers if batches else m.answers
    for i, s in enumerate(m.manifest.pv):
        name, since = f"answer of {s.name}", seen.changed(i)
        if not seen.learnt:
            text = f"how {s.name} answers is still learnt: {seen.done:.0%} done"
            found.append(unknown(name, text))
        elif since is not None:
            text = (
                f"{s.name} answers otherwise than at first, since {when(since)}: the plant has changed, or a load has"
            )
            found.append(Verdict(name, "watch", text))
        else:
            found.append(Verdict(name, "as validated", f"{s.name} answers moves as at first"))
    return found


def _estimates(m: Monitor) -> list[Verdict]:
    found = []
    chart = m.estimates.chart
    for i, name in enumerate(m.estimates.names):
        if not chart.learnt:
            if not m.batches.known:
                found.append(unknown(name, f"what the law corrects is still measured: {chart.done:.0%} done"))
            continue
        ratio = rms_ratio(chart.shift(i))
        if chart.found[i]:
            text = f"what the law corrects of its model is {ratio:.2g} times that of the first days"
            found.append(Verdict(name, "watch", f"{text}, since {when(chart.since_s[i])}", ratio))
        else:
            found.append(Verdict(name, "as validated", "the law corrects its model as much as at first", ratio))
    return found


def _batches(m: Monitor) -> list[Verdict]:
    """Each variable beside earlier batches."""
    if not m.batches.known:
        return []
    found, chart = [], m.batches.chart
    for i, (variable, unit) in enumerate(zip(m.batches.names, m.batches.units, strict=True)):
        name, change = f"{variable} over a batch", m.batches.changed(i)
        if not chart.learnt:
            found.append(unknown(name, f"batches of one recipe are still learnt: {chart.count} of {chart.learn}"))
        elif change is not None:
            part, shift, since = change
            by = f"{abs(shift):.3g} {unit if unit != '-' else ''}".strip()
            text = f"{variable} is {by} {'higher' if shift > 0 else 'lower'} than in the first batches, "
            text += f"most in part {part + 1} of {BATCH_PARTS} of a batch, since {when(since)}"
            found.append(Verdict(name, "watch", text, shift))
        else:
            found.append(Verdict(name, "as validated", "as in the first batches"))
    return found


def _rest(m: Monitor) -> list[Verdict]:
    found = []
    chart = m.rest.chart
    for i, s in enumerate(m.manifest.mv):
        name = f"{s.name} at rest"
        if not chart.learnt:
            if not m.batches.known:
                done = min(m.rest.judged / m.rest.learn, 1) if chart.doublings == 0 else chart.done
                found.append(unknown(name, f"what the plant needs at rest is still learnt: {done:.0%} done"))
            continue
        shift = chart.shift(i) * (s.high - s.low)
        gain = m.rest.gain(i)
        if gain is not None and abs(gain[0] - 1) > max(TOLD_GAIN_CHANGE, TOLD_GAIN_ERRORS * gain[1]):
            change = f"{abs(gain[0] - 1):.0%} {'higher' if gain[0] > 1 else 'lower'}"
            since = f" since {when(chart.since_s[i])}" if chart.found[i] else ""
            found.append(
                Verdict(name, "retrain", f"the plant's gain seems {change}{since}", gain[0], 1 + TOLD_GAIN_CHANGE)
            )
        elif chart.found[i]:
            text = f"the plant needs {shift:+.3g} {unit_of(s)}for the same set points since {when(chart.since_s[i])}"
            found.append(Verdict(name, "watch", text, shift, float(chart.scatter[i]) * (s.high - s.low)))
        else:
            found.append(Verdict(name, "as validated", "the plant needs what it needed at first", shift))
    return found


def _variability(m: Monitor) -> list[Verdict]:
    found = []
    for i, s in enumerate(m.manifest.sp):
        name, drift, span = f"error of {s.name}", m.spread, s.high - s.low
        worst = worst_validated(m.manifest)
        mean = m.errors[i].value * span
        whole = m.errors[i].count >= m.errors[i].memory_scans  # a day: one move of the set point is no measure
        if worst is not None and len(m.manifest.sp) == 1 and whole and mean > WORSE_ERROR * worst:
            text = (
                f"the mean error is {mean:.3g} {unit_of(s)}".strip() + f"; in the validation it was at most {worst:.3g}"
            )
            found.append(Verdict(name, "watch", text, mean, worst))
        elif not drift.learnt:
            if not m.batches.known:
                found.append(unknown(name, f"the error at rest is still measured: {drift.done:.0%} done"))
        elif drift.found[i]:
            ratio = rms_ratio(drift.shift(i))
            text = f"the error at rest is {ratio:.2g} times that of the first days, since {when(drift.since_s[i])}"
            found.append(Verdict(name, "watch", text, ratio))
        else:
            left = m.harris[i]
            more = ""
            if left.count:
                more = f"; {left.value:.0%} of its variance no controller could remove"
            found.append(Verdict(name, "as validated", f"the error at rest is what it was{more}", mean, worst))
    return found


def _swing(m: Monitor) -> list[Verdict]:
    found = []
    drift = m.spread
    for i, (s, swing) in enumerate(zip(m.manifest.sp, m.swings, strict=True)):
        r, quiet = swing.regularity(), rms_ratio(float(drift.mean[i])) * (s.high - s.low)
        loud = LOUD * quiet if drift.learnt else PLAIN_SWING * (s.high - s.low)
        if not drift.learnt and not m.batches.known and not (r > SWING_REGULARITY and swing.amplitude() > loud):
            found.append(unknown(f"swing of {s.name}", "the error at rest is still measured"))
        elif r > SWING_REGULARITY and swing.amplitude() > loud:
            seconds = swing.period() * m.manifest.period_s
            text = f"{s.name} swings by {swing.amplitude():.3g} {unit_of(s)}every {seconds:.3g} s"
            found.append(Verdict(f"swing of {s.name}", "watch", text, r, SWING_REGULARITY))
        else:
            found.append(Verdict(f"swing of {s.name}", "as validated", "no regular swing", r, SWING_REGULARITY))
    return found


def _shares(m: Monitor) -> list[Verdict]:
    rows = [("saturated", m.saturated, TOLD_AT_LIMITS, "of the time an MV is at an end of its range")]
    if any(s.max_move is not None for s in m.manifest.mv):
        rows.append(("rate limit", m.limited, TOLD_AT_LIMITS, "of the time an MV moves as fast as it may"))
    if "in_domain" in m.manifest.info:
        rows.append(("domain", m.outside, TOLD_OUTSIDE, "of the time the law is outside its applicability domain"))
    found = []
    for name, share, least, words in rows:
        if not share.learnt:
            found.append(unknown(name, f"still measured: {share.done:.0%} done"))
            continue
        limit = max(2 * share.first, least)
        level: Level = "watch" if share.value > limit else "as validated"
        found.append(Verdict(name, level, f"{share.value:.1%} {words}", share.value, limit))
    name = "time in HOLD"  # not "HOLD": beside events of the mode it would read as one
    if not m.hold.learnt:
        found.append(unknown(name, f"still measured: {m.hold.done:.0%} done"))
    else:
        level = "watch" if m.hold.value > MOST_HOLD else "as validated"
        text = f"{m.hold.value:.1%} of the time the loop holds"
        found.append(Verdict(name, level, text, m.hold.value, MOST_HOLD))
    return found


def worst_validated(m: Manifest) -> float | None:
    """The largest mean error of the validation's noisy tests."""
    rows = m.evidence.get("scenarios")
    if not isinstance(rows, dict):
        return None
    found = [row.get("mae") for name, row in rows.items() if isinstance(row, dict) and name.endswith("_noise")]
    known = [float(v) for v in found if isinstance(v, int | float)]
    return max(known) if known else None
