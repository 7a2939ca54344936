"""Courses that stood when a loop last ended: kept in its journal by the clock, told at its next start, taken back."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any, Self

from loopwright.serving.errors import LoopError
from loopwright.serving.fields import is_number
from loopwright.serving.journal import Journal
from loopwright.serving.loop import ControlLoop
from loopwright.serving.preview.course import Course
from loopwright.serving.station.last_run import kept_at_end
from loopwright.serving.words import first_line

COURSES = "courses"  # what they are kept under


@dataclass(frozen=True, slots=True)
class DatedCourse:
    """A course by the clock: ``points`` (time [s] since 1970, value), and who gave it."""

    points: tuple[tuple[float, float], ...]
    straight: bool
    who: str
    of: Course | None = field(default=None, compare=False)  # in the loop that runs

    def to_come(self, now_s: float, speed: float) -> list[tuple[float, float]]:
        """Points (time [s] of the loop from now, value); of those in the past only the last, which holds now."""
        points = [((t - now_s) * speed, v) for t, v in self.points]
        past = sum(t < 0 for t, _ in points)
        return points[max(0, past - 1) :]

    def over(self, now_s: float) -> bool:
        """Whether its last point lies in the past."""
        return self.points[-1][0] < now_s


@dataclass(frozen=True, slots=True)
class LastCourses:
    """The courses of a loop by signal, and of which controller; the loop runs ``speed`` times as fast as the clock."""

    sha256: str = ""
    by_signal: Mapping[str, DatedCourse] = field(default_factory=dict)

    @classmethod
    def of(cls, loop: ControlLoop, before: LastCourses, scanned_s: float, speed: float) -> Self:
        """The courses of a loop after a scan at ``scanned_s`` (since 1970); those that were there ``before`` stay."""
        begun = loop.courses.now_s - loop.manifest.period_s  # the loop's time of this scan
        found = dict[str, DatedCourse]()
        for name, course in loop.courses.standing.items():
            known = before.by_signal.get(name)
            if known is None or known.of is not course:
                times = (scanned_s + (course.times_s - begun) / speed).tolist()
                points = tuple(zip(times, course.values.tolist(), strict=True))
                known = DatedCourse(points, course.straight, course.who, course)
            found[name] = known
        return cls(loop.controller.sha256 if found else "", found)

    @classmethod
    def before(cls, journal: Path) -> Self:
        """The courses that the last loop of a journal ended with; none where it does not tell."""
        kept = kept_at_end(journal, COURSES)
        rows = kept.get("courses")
        found = {str(name): _dated(row) for name, row in rows.items()} if isinstance(rows, dict) else {}
        return cls(kept.get("sha256", ""), {name: of for name, of in found.items() if of is not None})

    def keep(self, journal: Journal) -> None:
        """Write it down."""
        rows = {n: {"points": of.points, "straight": of.straight, "who": of.who} for n, of in self.by_signal.items()}
        journal.keep(COURSES, json.dumps({"sha256": self.sha256, "courses": rows}))

    def compare(self, loop: ControlLoop, note: Callable[[str, str], None], now_s: float) -> None:
        """Say in a line which courses stood that ``loop`` does not follow."""
        if self.by_signal:
            listed = "; ".join(self._words(loop, name, now_s) for name in self.by_signal)
            note(f"the last loop ended with courses that are followed no more: {listed}", _restorable(self, now_s))

    def restore(self, loop: ControlLoop, note: Callable[[str, str], None], now_s: float, speed: float) -> None:
        """Give them to a loop of the same controller, and say it; one that is over, or not valid, is said and left."""
        if not self.by_signal:
            return
        if self.sha256 != loop.controller.sha256:
            note(f"no course is restored: another controller had {', '.join(self.by_signal)}", "")
            return
        setpoints = {s.name for s in loop.manifest.sp}
        taken, left = list[str](), list[str]()
        for name, course in self.by_signal.items():
            words = self._words(loop, name, now_s)
            if course.over(now_s):
                left.append(words)
                continue
            try:
                straight = [name] if course.straight and name in setpoints else []
                loop.set_course({name: course.to_come(now_s, speed)}, straight, course.who)
                taken.append(words)
            except LoopError as error:
                left.append(f"{words}: {first_line(error)}")
        if left:
            note(f"not restored: {'; '.join(left)}", "")
        if taken:
            note(f"restored: {'; '.join(taken)}", "the last loop ended with them; what lies in the past is skipped")

    def _words(self, loop: ControlLoop, name: str, now_s: float) -> str:
        """A course in words: its end, and who gave it."""
        course = self.by_signal[name]
        at, value = course.points[-1]
        unit = next((s.unit for s in (*loop.manifest.sp, *loop.manifest.dv) if s.name == name), "")
        when = datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M UTC")
        by = f", by {course.who}" if course.who else ""
        ends = "was over at" if course.over(now_s) else "until"
        return f"the course of {name} {ends} {when}, {value:g} {unit}".rstrip() + by


def _restorable(kept: LastCourses, now_s: float) -> str:
    """The way to have them; none where all are over."""
    over = all(course.over(now_s) for course in kept.by_signal.values())
    return "" if over else "with restore = true in loop.toml a start takes them back"


LATEST_S = 253_402_300_799.0  # since 1970, the end of the year 9999: a later time cannot be written as a date


def _dated(row: Any) -> DatedCourse | None:
    """The course that ``keep`` wrote; None where it is none, as anybody may have changed the journal."""
    points = row.get("points") if isinstance(row, dict) else None
    if not isinstance(points, list) or not points:
        return None
    if not all(isinstance(p, list) and len(p) == 2 and all(map(is_number, p)) for p in points):
        return None
    found = tuple((float(t), float(v)) for t, v in points)
    if not all(isfinite(v) and abs(t) < LATEST_S for t, v in found) or not isinstance(row.get("who"), str):
        return None
    return DatedCourse(found, row.get("straight") is True, row["who"])
