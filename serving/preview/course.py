"""Set points of a recipe and forecasts of measured disturbances as values by time, which a loop follows."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.fields import is_number, nearest, shown
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.preview.ahead import AheadInput
from loopwright.serving.preview.differences import Differences
from loopwright.serving.ranges import within

Array: TypeAlias = NDArray[np.float64]
Points: TypeAlias = Sequence[tuple[float, float]]
"""Points (time [s] from now, value in the signal's unit) of one signal."""

MOST_COURSE_POINTS = 10_000  # of a signal: a month of five minutes


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Values of one signal by time. ``straight``: it runs straight from point to point; else each value is held.

    Two points at one time are a step. Before its first point a signal is as it is now, or runs straight from there.
    """

    signal: str
    times_s: Array  # (n,) of the loop's clock, none below the one before
    values: Array  # (n,)
    straight: bool
    who: str = ""  # gave it; empty where nobody said so
    number: int = 0  # of all that the loop was given, this is which

    def at(self, time_s: Array, present: float) -> Array:
        """The values at times (...,); ``present`` before the first point of one that holds its values."""
        if self.straight:
            return np.asarray(np.interp(time_s, self.times_s, self.values))
        place = np.searchsorted(self.times_s, time_s, side="right") - 1
        return np.where(place < 0, present, self.values[np.maximum(place, 0)])

    def begun(self, now_s: float, present: float) -> Course:
        """The course with the present value in front, where it is straight and has not begun."""
        if not self.straight or self.times_s[0] <= now_s or not isfinite(present):
            return self
        return replace(
            self,
            times_s=np.concatenate([[now_s], self.times_s]),
            values=np.concatenate([[present], self.values]),
        )


class Courses:
    """The courses of a loop's set points and measured disturbances.

    Set points hold each value, those of ``straight`` run from point to point; forecasts always do. At each scan a set
    point takes the value of its course, and the law gets all that is to come by its input ``ahead``:

        set point:             course(t + i T) - its present value
        measured disturbance:  course(t + i T) - course(t)

    A forecast counts by what it changes from now on. A forecast that is off by a constant so does no harm, and neither
    does noise of the reading. A course ends at its last point: the set point stays there, and the disturbance counts as
    it is measured. Times count from the loop's clock, so that missed periods pass here, too.
    """

    def __init__(self, manifest: Manifest) -> None:
        self._sp, self._dv = tuple(manifest.sp), tuple(manifest.dv)
        self._period_s = manifest.period_s
        self._periods = 0  # that have passed since the loop began
        self._of: dict[str, Course] = {}
        self._given = 0  # courses until now
        self._differences: dict[int, Differences] = {}  # by the input that they belong to: made once, not at each scan
        self._left: tuple[str, ...] = ()  # signals whose course left the range of the controller in charge
        self.finished: tuple[str, ...] = ()  # signals whose course came to its last point at the last scan

    @property
    def now_s(self) -> float:
        """Time [s] of the scan that comes next, from the loop's beginning."""
        return self._periods * self._period_s

    def passed(self, periods: int) -> None:
        """So many periods are over, with a scan or without."""
        self._periods += periods

    @property
    def standing(self) -> dict[str, Course]:
        """The courses that are not over, by signal; their times are those of ``now_s``."""
        return dict(self._of)

    @property
    def left(self) -> dict[str, list[tuple[float, float]]]:
        """The points to come by signal, times [s] from the next scan on."""
        now = self.now_s
        return {
            name: [(t - now, v) for t, v in zip(of.times_s.tolist(), of.values.tolist(), strict=True) if t >= now]
            for name, of in list(self._of.items())  # other threads ask, too
        }

    @property
    def ends(self) -> dict[str, tuple[float, float]]:
        """The last point by signal: time [s] from the next scan on, and value."""
        now = self.now_s
        return {name: (float(of.times_s[-1]) - now, float(of.values[-1])) for name, of in list(self._of.items())}

    def give(self, points: Mapping[str, Points], straight: Collection[str] = (), who: str = "") -> None:
        """Courses of some signals, in place of those that they had, by ``who``; LoopError as ``checked``."""
        for course in self.checked(points, straight):
            self._given += 1
            self._of[course.signal] = replace(course, who=who, number=self._given)

    def checked(self, points: Mapping[str, Points], straight: Collection[str] = ()) -> list[Course]:
        """The courses that ``give`` would set; LoopError with the signal and the point that is wrong.

        An unknown name, one that is a set point and a disturbance, no points or too many, a number that is not finite,
        a time before the one before it, a value outside the signal's range, or a last point before now. The error's
        ``entry`` is the signal and the place of the point, as TIC-1.2, where one point is wrong.
        """
        if not isinstance(points, Mapping) or not points:
            raise LoopError('a course is given by name, as {"TIC-1": [(0, 50), (600, 60)]}; times in s from now')
        for name in straight:
            if name not in points:
                raise LoopError(f"{shown(name)} is to run straight, but has no course{nearest(name, points)}")
        return [self._checked(name, of, name in straight) for name, of in points.items()]

    def _checked(self, name: str, points: Points, straight: bool) -> Course:
        sp = {s.name: s for s in self._sp}
        dv = {s.name: s for s in self._dv}
        if name in sp and name in dv:
            raise LoopError(f"{name} is a set point and a measured disturbance; a course cannot tell which is meant")
        if name not in sp and name not in dv:
            raise LoopError(f"there is no set point or measured disturbance {shown(name)}{nearest(name, {**sp, **dv})}")
        rows = _pairs(name, points)
        signal = sp.get(name) or dv[name]
        for k, ((before, _), (time_s, value)) in enumerate(zip([rows[0], *rows], rows, strict=False), start=1):
            if time_s < before:
                raise _wrong(name, k, f"the course of {name} goes back in time, from {before:g} s to {time_s:g} s")
            if name in sp:
                try:
                    within([value], (signal,), f"course at {time_s:g} s: set point")
                except LoopError as error:
                    raise _wrong(name, k, str(error)) from None
            elif not signal.low <= value <= signal.high:
                raise _wrong(
                    name,
                    k,
                    f"the course of {name} is {value:g} {signal.unit} at {time_s:g} s; allowed is {signal.low:g} to "
                    f"{signal.high:g} {signal.unit}",
                )
        if straight and signal.values is not None:
            raise LoopError(f"{name} has only some values; its course cannot run straight between them")
        if rows[-1][0] < 0:
            words = f"the course of {name} ends {-rows[-1][0]:g} s before now; give what is to come"
            raise _wrong(name, len(rows), words)
        times, values = np.array(rows).T
        return Course(name, times + self.now_s, values.copy(), straight or name in dv)

    def end(self, names: Iterable[str]) -> tuple[str, ...]:
        """End the courses of some signals; the names of those that had one."""
        ended = tuple(name for name in names if name in self._of)
        for name in ended:
            del self._of[name]
        return ended

    def followed(self, sp: Array, signals: Sequence[Signal]) -> Array:
        """The set points (n_sp,) at the scan that comes next.

        A course that leaves the range of its set point among ``signals``, as the controller in charge has it, ends.
        """
        now, found, left = self.now_s, sp, list[str]()
        for i, s in enumerate(self._sp):
            if s.name in self._of:
                course = self._of[s.name] = self._of[s.name].begun(now, float(found[i]))
                found = found.copy() if found is sp else found
                wanted = course.at(np.array([now]), float(found[i]))[0]
                if signals[i].low <= wanted <= signals[i].high:
                    found[i] = wanted
                else:
                    left.append(s.name)
        self._left = self.end(left)
        return found

    def over(self) -> None:
        """Forget the courses whose last point has come; ``finished`` are their names."""
        done = self.end([name for name, of in self._of.items() if of.times_s[-1] <= self.now_s])
        self.finished, self._left = (*self._left, *done), ()

    def ahead(self, manifest: Manifest, sp: Array, dv: ArrayLike | None, samples: int | None = None) -> Array | None:
        """``ahead`` (N n,) of a controller at this scan, within its signals' ranges.

        None where it reads none or nothing is to come. ``sp`` (n_sp,) and ``dv`` (n_dv,) are the present values of the
        loop's signals. ``samples`` is how many are known, N unless given.
        """
        if not self._of or manifest.ahead is None or "ahead" not in manifest.inputs:
            return None
        known = dict(zip((s.name for s in self._sp), sp.tolist(), strict=True))
        measured = np.full(len(self._dv), np.nan) if dv is None else np.asarray(dv, dtype=np.float64).reshape(-1)
        known |= dict(zip((s.name for s in self._dv), measured.tolist(), strict=True))
        now = self.now_s
        times: Array = now + self._period_s * np.arange(1.0, (samples or manifest.ahead.horizon) + 1)
        change = np.zeros((len(times), len(manifest.ahead.signals)))
        for i, s in enumerate(manifest.ahead.signals):
            if s.signal in self._of:
                present = known[s.signal]
                course = self._of[s.signal] = self._of[s.signal].begun(now, present)
                begins = course.at(np.array([now]), present) if s.group == "dv" else present
                change[:, i] = course.at(times, present) - begins
        values: Array = np.array([known[s.signal] for s in manifest.ahead.signals])
        return self._differences_of(manifest.ahead).within(change, values)

    def _differences_of(self, of: AheadInput) -> Differences:
        """The differences of a controller's input; they keep it, so that no other one has its place in memory."""
        if id(of) not in self._differences:
            self._differences[id(of)] = Differences(of)
        return self._differences[id(of)]


def _pairs(name: str, points: Any) -> list[tuple[float, float]]:
    """Times and values of a course; LoopError for what is none."""
    if isinstance(points, str | Mapping) or not isinstance(points, Iterable):
        raise LoopError(f"the course of {name} is {shown(points)}; it needs points (time in s from now, value)")
    rows = list(points)
    if not 1 <= len(rows) <= MOST_COURSE_POINTS:
        raise LoopError(f"the course of {name} has {len(rows)} points; it must have 1 to {MOST_COURSE_POINTS}")
    for k, row in enumerate(rows, start=1):
        if not isinstance(row, Sequence) or isinstance(row, str) or len(row) != 2 or not all(map(is_number, row)):
            words = f"the course of {name} has the point {shown(row)}; it needs a time in s and a value"
            raise _wrong(name, k, words)
    return [(float(t), float(v)) for t, v in rows]


def _wrong(name: str, place: int, words: str) -> LoopError:
    """The error of one point of a course; ``entry`` says which."""
    error = LoopError(words)
    error.entry = f"{name}.{place}"
    return error


def described(points: Mapping[str, Points], signals: Iterable[Signal]) -> str:
    """Courses in a sentence: how many points of which signals, until when and to what value."""
    units = {s.name: s.unit for s in signals}
    return ", ".join(
        f"{name} {len(of)} points, {of[-1][1]:g} {units.get(name, '')} at {of[-1][0]:g} s".replace(" - at", " at")
        for name, of in points.items()
    )
