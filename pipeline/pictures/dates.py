"""The time axis of an export: dates with their zone where it has dates, else the time from its first row."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo

import numpy as np
from matplotlib.axis import Axis
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

from loopwright.pipeline.metrics import Array
from loopwright.pipeline.pictures.drawing import time_axis

DAY_S = 86_400.0
TICKS = (4, 12)  # fewest and most


@dataclass(frozen=True, slots=True)
class ExportTimes:
    """Times [s] of an export from ``start_s`` to ``end_s``; ``zone`` as in ``Export``, empty of one without dates.

    Dates are drawn in ``local``, the zone that a person named, in which `--leave-out` counts too.
    """

    start_s: float
    end_s: float
    zone: str
    local: tzinfo = UTC

    def at(self, time_s: Array) -> Array:
        """Places (n,) on the axis of times (n,)."""
        if self.zone:
            return np.asarray(time_s / DAY_S)
        whole = self.end_s - self.start_s
        scale = time_axis(np.array([0.0, whole]))[0][1] / whole if whole > 0 else 1.0
        return np.asarray((time_s - self.start_s) * scale)

    @property
    def label(self) -> str:
        """Label of the axis."""
        return f"time ({self.zone})" if self.zone else time_axis(np.array([0.0, self.end_s - self.start_s]))[1]

    @property
    def words(self) -> str:
        """From when to when, for a sentence."""
        if not self.zone:
            return "The export has no dates: the time counts from its first row."
        start, end = (f"{datetime.fromtimestamp(t, self.local):%Y-%m-%d %H:%M:%S}" for t in (self.start_s, self.end_s))
        return f"From {start} to {end}, {self.zone}."

    def dress(self, axis: Axis) -> None:
        """Give the axis the ticks of dates, where there are dates."""
        if self.zone:
            locator = AutoDateLocator(tz=self.local, minticks=TICKS[0], maxticks=TICKS[1])  # type: ignore[no-untyped-call]
            axis.set_major_locator(locator)
            axis.set_major_formatter(ConciseDateFormatter(locator, tz=self.local))  # type: ignore[no-untyped-call]
