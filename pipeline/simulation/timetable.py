"""The events of a simulated run, sample by sample, from what a person asked for."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from loopwright.pipeline.errors import ParamsError, nearest
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.simulation.operator_changes import OperatorChange
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import DV_DRAW, noise_draws
from loopwright.serving.manifest import Signal
from loopwright.serving.operating import SWITCH_WORDS

SETTLE_SAMPLES = 80  # after the last event, where no duration was asked for
MAX_SAMPLES = 10_000_000  # of a simulation


@dataclass(frozen=True, slots=True)
class TimedValue:
    """A value at a time [s]; ``name`` may be empty for a plant's only set point."""

    value: float
    time_s: float = 0.0
    name: str = ""


@dataclass(frozen=True, slots=True)
class ManualSpan:
    """The operator's hands on the MVs from ``start_s`` to ``end_s`` [s]; None keeps them as they were."""

    start_s: float
    end_s: float
    mv: tuple[float, ...] | None = None  # one value an MV


@dataclass(frozen=True, slots=True, eq=False)
class Timetable:
    """A run: the plant, set points, start, plant parameters, noise and manual spans, all by sample."""

    plant: Simulator
    sp: Array  # (n, n_sp)
    x0: Array  # (n_x,)
    mv0: Array  # (n_mv,)
    changes: dict[str, Array]  # plant parameter -> (n,)
    noise: Array  # (n, n_pv)
    dv_noise: Array  # (n, n_dv) of the readings: the plant feels none of it
    manual: tuple[ManualSpan, ...] = ()
    marks: dict[float, str] = field(default_factory=dict)  # time [s] -> what happened there
    dv: Array | None = None  # (n, n_dv) measured disturbances; None: the plant's own
    operate: tuple[OperatorChange, ...] = ()  # of what operators may change of the law

    def manual_at(self, time_s: float) -> ManualSpan | None:
        """The manual span that holds at ``time_s``."""
        return next((s for s in self.manual if s.start_s <= time_s < s.end_s), None)


def parse_event(text: str, form: str, *, switches: bool = False) -> TimedValue:
    """An event with a name where the form has ``=``, and with a time where it allows ``@``; ParamsError shows it.

    A form that begins with ``[`` leaves the name to the writer. With ``switches`` a value may be true or false.
    """
    named = "=" in (text if form.startswith("[") else form)
    name, equals, rest = text.partition("=") if named else ("", "=", text)
    value, at, time_s = rest.partition("@")
    if not equals or (named and not name) or (at and "@" not in form):
        raise ParamsError(f"{text!r} is not of the form {form}")
    number = SWITCH_WORDS.get(value.lower()) if switches else None
    event = TimedValue(
        _number(value, text, form) if number is None else number, _number(time_s, text, form) if at else 0.0, name
    )
    if event.time_s < 0:
        raise ParamsError(f"{text!r}: the time must not be negative")
    return event


def parse_manual(text: str) -> ManualSpan:
    """``START..END`` or ``START..END=MV``, several MVs as ``MV,MV``."""
    form = "START..END or START..END=MV (of several MVs all: MV,MV)"
    match = re.fullmatch(r"([^.=]+(?:\.\d+)?)\.\.([^=]+)(?:=(.+))?", text)
    if match is None:
        raise ParamsError(f"{text!r} is not of the form {form}")
    start, end = (_number(match[i], text, form) for i in (1, 2))
    if not 0 <= start < end:
        raise ParamsError(f"{text!r}: it must start at 0 or later and end after that")
    values = None if match[3] is None else tuple(_number(value, text, form) for value in match[3].split(","))
    return ManualSpan(start, end, values)


def timetable(
    plant: Simulator,
    test: Scenario | None = None,
    *,
    set_points: Sequence[TimedValue] = (),
    disturbances: Sequence[TimedValue] = (),
    noise: Sequence[TimedValue] = (),
    manual: Sequence[ManualSpan] = (),
    start_cv: float | None = None,
    duration_s: float | None = None,
    operate: Sequence[TimedValue] = (),
    seed: int = 0,
) -> Timetable:
    """The run that was asked for; ParamsError or PlantError names what cannot be.

    Without set points those of ``test`` are taken. A run with set points of its own starts at the
    steady state of ``start_cv``, or at that in the middle of the set point's range; a plant without
    equations starts at its ``start``. A test that has a plant of its own is run on that.
    """
    moved = [(_set_point(plant, event), event) for event in set_points]
    for i, event in moved:
        _check_range("set point", plant.sp_signals[i], event.value)
    if start_cv is not None:
        _check_range("a start at", plant.pv_signals[0], start_cv)
    changes: dict[str, Array] = {}
    marks: dict[float, str] = {}
    measured: Array | None = None
    if set_points:
        x0, mv0, start = _rest(plant, start_cv)
        spans = [t for s in manual for t in (s.start_s, s.end_s) if math.isfinite(t)]
        last = max([*spans, *(e.time_s for e in (*set_points, *disturbances, *operate))])
        n = _samples(plant, duration_s, round(last / plant.period_s) + SETTLE_SAMPLES)
        sp = np.tile(start, (n, 1))
        for i, event in sorted(moved, key=lambda e: e[1].time_s):
            sp[_sample(plant, event, n) :, i] = event.value
    else:
        if test is None:
            raise ParamsError("the plant belongs to no case, so it has no scenarios; give set points (--sp)")
        plant = test.plant or plant
        n = _samples(plant, duration_s, test.samples)
        x0, mv0 = (test.x0, test.mv0) if start_cv is None else _rest(plant, start_cv)[:2]
        sp = _stretched(test.sp, n)
        changes = {name: _stretched(values, n) for name, values in test.changes.items()}
        measured = None if test.dv is None else _stretched(test.dv, n)
        if changes:
            marks[0.0] = ", ".join(changes)
    nominal = dict(zip(plant.parameter_names(), plant.parameters(), strict=True))
    places = {s.name: j for j, s in enumerate(plant.dv_signals)}
    for event in sorted(disturbances, key=lambda e: e.time_s):
        if event.name not in {**nominal, **places}:
            what = "measured disturbance or parameter" if places else "parameter"
            near = nearest(event.name, [*places, *nominal])
            raise ParamsError(f"plant {plant.name!r} has no {what} {event.name!r}{near}")
        k = _sample(plant, event, n)
        if event.name in places:
            signal = plant.dv_signals[places[event.name]]
            _check_range("a measured disturbance", signal, event.value)
            measured = np.tile(plant.dv_nominal, (n, 1)) if measured is None else measured
            measured[k:, places[event.name]] = event.value
            unit = signal.unit
        else:
            changes.setdefault(event.name, np.full(n, nominal[event.name]))[k:] = event.value
            unit = plant.parameter_units()[event.name]
        text = f"{event.name} = {event.value:g} {unit}".strip()
        at = k * plant.period_s
        marks[at] = f"{marks[at]}, {text}" if at in marks else text
    for span in manual:
        _check_manual(plant, span)
        if span.start_s >= n * plant.period_s:
            raise ParamsError(
                f"manual from {span.start_s:g} s lies beyond the run, which ends at {n * plant.period_s:g} s"
            )
        marks.setdefault(span.start_s, "manual")
    changed = changes_of(operate, plant, n)
    for change in changed:
        if change.at:
            text = ", ".join(f"{name} = {value:g}" for name, value in change.values.items())
            at = change.at * plant.period_s
            marks[at] = f"{marks[at]}, {text}" if at in marks else text
    operated = (*(() if test is None or set_points else test.operate), *changed)
    noises = _noise(plant, noise, n, seed)
    return Timetable(plant, sp, x0, mv0, changes, *noises, tuple(manual), marks, measured, operated)


def at_once(events: Sequence[TimedValue]) -> dict[str, float]:
    """Values of ``operate`` by name; ParamsError for a name that is there twice."""
    found: dict[str, float] = {}
    for event in events:
        if event.name in found:
            raise ParamsError(
                f"operate sets {event.name} twice, to {found[event.name]:g} and {event.value:g}; give it once"
            )
        found[event.name] = event.value
    return found


def changes_of(events: Sequence[TimedValue], plant: Simulator, n: int) -> tuple[OperatorChange, ...]:
    """Operators' changes by sample, from events by name; ParamsError for one beyond the run, or twice at one time."""
    found: dict[int, list[TimedValue]] = {}
    for event in events:
        found.setdefault(_sample(plant, event, n), []).append(event)
    return tuple(OperatorChange(at, at_once(found[at])) for at in sorted(found))


def _set_point(plant: Simulator, event: TimedValue) -> int:
    """The plant's set point that an event moves; ParamsError where it names none of them, or has to name one."""
    names = [s.name for s in plant.sp_signals]
    if not event.name and len(names) > 1:
        raise ParamsError(f"plant {plant.name!r} has the set points {', '.join(names)}; name one: {names[0]}=VALUE")
    if event.name and event.name not in names:
        raise ParamsError(f"plant {plant.name!r} has no set point {event.name!r}{nearest(event.name, names)}")
    return names.index(event.name) if event.name else 0


def _rest(plant: Simulator, start_cv: float | None) -> tuple[Array, Array, Array]:
    """(x0, mv0, set points (n_sp,)) where a run starts: as ``timetable`` says."""
    if start_cv is None and not isinstance(plant, EquationPlant):
        x0, mv0 = plant.start
        return x0, mv0, plant.measure(x0)[: len(plant.sp_signals)]
    sp = plant.sp_signals[0]
    cv = (sp.low + sp.high) / 2 if start_cv is None else start_cv
    return *equations(plant, "a start at a chosen controlled variable").steady_state_at(cv), np.array([cv])


def _check_manual(plant: Simulator, span: ManualSpan) -> None:
    """ParamsError unless the span has one value an MV, each in its range or among its allowed values."""
    if span.mv is None:
        return
    signals = plant.mv_signals
    if len(span.mv) != len(signals):
        raise ParamsError(
            f"manual has {len(span.mv)} value{'s' * (len(span.mv) > 1)}; plant {plant.name!r} has the MVs "
            f"{', '.join(s.name for s in signals)}: give {','.join(s.name for s in signals)}"
        )
    for s, value in zip(signals, span.mv, strict=True):
        if s.values is not None and value not in s.values:
            raise ParamsError(f"manual {s.name} = {value:g} is none of {', '.join(f'{v:g}' for v in s.values)}")
        _check_range("manual", s, value)


def _check_range(what: str, s: Signal, value: float) -> None:
    if not s.low <= value <= s.high:
        unit = "" if s.unit == "-" else f" {s.unit}"
        raise ParamsError(f"{what} {s.name} = {value:g}{unit} is outside [{s.low:g}, {s.high:g}]{unit}")


def _number(text: str, whole: str, form: str) -> float:
    what = f"{text!r}" if text == whole else f"{whole!r}: {text!r}"
    try:
        value = float(text)
    except ValueError:
        raise ParamsError(f"{what} is no number; the form is {form}") from None
    if not math.isfinite(value):
        raise ParamsError(f"{what} is not finite")
    return value


def _samples(plant: Simulator, duration_s: float | None, default: int) -> int:
    n = default if duration_s is None else math.ceil(duration_s / plant.period_s - 1e-9)
    if not 1 <= n <= MAX_SAMPLES:
        raise ParamsError(
            f"a duration of {n * plant.period_s:g} s is {n} samples; allowed are 1 to {MAX_SAMPLES} "
            f"of {plant.period_s:g} s"
        )
    return n


def _sample(plant: Simulator, event: TimedValue, n: int) -> int:
    k = round(event.time_s / plant.period_s)
    if k >= n:
        raise ParamsError(f"time {event.time_s:g} s lies beyond the run, which ends at {n * plant.period_s:g} s")
    return k


def _stretched(values: Array, n: int) -> Array:
    """The first n rows; the last row again where there are fewer."""
    return np.concatenate([values[:n], np.repeat(values[-1:], max(0, n - len(values)), axis=0)])


def _noise(plant: Simulator, deviations: Sequence[TimedValue], n: int, seed: int) -> tuple[Array, Array]:
    """Measurement noise (n, n_pv) and (n, n_dv), from the standard deviations of some PVs and measured disturbances."""
    std = {s.name: 0.0 for s in (*plant.pv_signals, *plant.dv_signals)}
    for event in deviations:
        if event.name not in std:
            what = "process variable or measured disturbance" if plant.dv_signals else "process variable"
            raise ParamsError(f"plant {plant.name!r} has no {what} {event.name!r}{nearest(event.name, std)}")
        if event.value < 0:
            raise ParamsError(f"the noise of {event.name} is {event.value:g}; a standard deviation is 0 or above")
        std[event.name] = event.value
    n_pv, sizes = len(plant.pv_signals), np.array(list(std.values()))
    white = np.random.default_rng((seed, DV_DRAW)).standard_normal((n, len(plant.dv_signals)))
    return noise_draws(plant, n, sizes[:n_pv], np.random.default_rng(seed)), sizes[n_pv:] * white
