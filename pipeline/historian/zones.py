"""The zone of an export's local times: seconds of a local clock -> seconds since 1970 UTC, over summer time."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.day_counts import DAY_S
from loopwright.pipeline.metrics import Array

OFFSET = re.compile(r"^(?:UTC|GMT)?(?P<sign>[+-])(?P<hours>\d{1,2})(?::?(?P<minutes>\d\d))?$", re.IGNORECASE)
HOUR_S = 3600.0
SET_BACK_S = 600.0  # against the order of the file; less is disorder
NO_CHANGES = np.zeros((0, 3))


def zone_named(text: str) -> tzinfo:
    """The zone of a name as Europe/Berlin, or of an offset as +01:00; RecordError where it is neither."""
    if match := OFFSET.match(text.strip()):
        minutes = 60 * int(match["hours"]) + int(match["minutes"] or 0)
        if minutes <= 14 * 60:
            return timezone(timedelta(minutes=-minutes if match["sign"] == "-" else minutes))
    if text.strip().upper() in {"UTC", "Z", "GMT"}:
        return UTC
    try:
        return ZoneInfo(text.strip())
    except (ZoneInfoNotFoundError, ValueError, OSError, ModuleNotFoundError):
        raise RecordError(
            f"--time-zone {text}: no such zone; write a name as Europe/Berlin, or an offset as +01:00"
        ) from None


@dataclass(slots=True)
class LocalClock:
    """A clock of one file on the wall, read block by block in the order of the file.

    In the hour that comes twice the first pass is summer time; the second begins where the times go back. A file with
    the newest row first is read the other way round.
    """

    name: str
    zone: tzinfo
    second: bool = False  # the second pass of an hour that comes twice
    last_s: float = -np.inf
    falls: bool | None = None  # the newest row comes first
    told: int = 0  # readings of hours that come twice, by their order
    missing: list[float] = field(default_factory=list)  # local times that the clock skipped

    def utc(self, local_s: Array) -> Array:
        """Seconds since 1970 (n,) of local ones (n,), NaN where they are."""
        known = np.flatnonzero(np.isfinite(local_s))
        out = np.full(len(local_s), np.nan)
        if not known.size:
            return out
        local = local_s[known]
        if self.falls is None:
            steps = np.diff(local)
            self.falls = bool(np.count_nonzero(steps < 0) > np.count_nonzero(steps > 0))
        changes = self._changes(float(local.min()), float(local.max()))
        offset = np.full(len(local), self._offset(datetime.fromtimestamp(float(local.min()) - DAY_S, UTC)))
        for at, before, after in changes:
            offset[local >= at + max(before, after)] = after
            skipped = (local >= at + before) & (local < at + after)
            if skipped.any():
                self.missing += local[skipped].tolist()
            twice = (local >= at + after) & (local < at + before)
            offset[twice] = np.where(self._second_pass(local, twice), after, before)
        out[known] = local - offset
        self.last_s = float(local[-1])
        return out

    def _second_pass(self, local: Array, twice: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Where readings of an hour that comes twice (m,) lie after the clock was set back."""
        place = np.flatnonzero(twice)
        if not place.size:
            return np.zeros(0, dtype=bool)
        self.told += int(place.size)
        steps = np.diff(local) * (-1.0 if self.falls else 1.0)
        usual_s = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
        stamps_repeat = bool(np.any(np.delete(steps, np.minimum(place, len(steps) - 1)) == 0)) if len(steps) else True
        before = np.r_[self.last_s, local[:-1]][place]
        own = local[place]
        entered = np.r_[place[0] == 0 or not twice[place[0] - 1], np.diff(place) > 1]
        if place[0] == 0 and np.isfinite(self.last_s):  # the hour goes on from the block before
            entered[0] = abs(own[0] - self.last_s) >= HOUR_S
        out = np.zeros(len(place), dtype=bool)
        second = self.second
        for i in range(len(place)):
            back_s = (before[i] - own[i]) * (-1.0 if self.falls else 1.0)
            if entered[i]:
                begins = place[i] == 0 and self._begins_second(local, twice, usual_s, stamps_repeat=stamps_repeat)
                second = bool(self.falls) or begins
            elif back_s > SET_BACK_S or (back_s == 0 and usual_s >= HOUR_S and not stamps_repeat):
                second = not self.falls
            out[i] = second
        self.second = second
        return out

    def _begins_second(self, local: Array, twice: NDArray[np.bool_], usual_s: float, *, stamps_repeat: bool) -> bool:
        """Whether the file begins in the second pass: it goes on beyond the hour without a gap, and never back."""
        if np.isfinite(self.last_s) or twice.all():
            return False
        steps = np.diff(local[: int(np.argmin(twice)) + 1])
        on = bool(np.all(steps >= 0 if stamps_repeat else steps > 0))
        return on and float(steps[-1]) < usual_s + HOUR_S / 2

    def _offset(self, utc: datetime) -> float:
        offset = utc.astimezone(self.zone).utcoffset()
        return 0.0 if offset is None else offset.total_seconds()

    def _changes(self, first_s: float, last_s: float) -> Array:
        """Rows (time UTC, offset before, offset after) [s] of each change of the clock near some local times."""
        found = []
        days = np.arange(first_s - 2 * DAY_S, last_s + 2 * DAY_S, DAY_S)
        if len(days) > 100_000:
            raise RecordError("the times of the export cover more than 270 years; check --time and --time-format")
        offsets = [self._offset(datetime.fromtimestamp(float(d), UTC)) for d in days]
        for k in np.flatnonzero(np.diff(offsets)):
            low, high = float(days[k]), float(days[k + 1])
            while high - low > 1:  # the second of the change
                middle = np.floor((low + high) / 2)
                if self._offset(datetime.fromtimestamp(middle, UTC)) == offsets[k]:
                    low = middle
                else:
                    high = middle
            found.append((np.ceil(high), offsets[k], offsets[k + 1]))
        return np.array(found).reshape(-1, 3) if found else NO_CHANGES
