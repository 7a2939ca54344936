"""Counts of days that programs write for dates, as 45355.25 of a spreadsheet, told from seconds since some start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.metrics import Array

DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Days:
    """A count of days: which numbers are such, and where it has 1970."""

    words: str
    low: float
    high: float
    at_1970: float


# Numbers of a spreadsheet are days since 1899-12-30: these are years 1968 to 2077. With the other origin of some old
# workbooks, 1904, the same numbers are four years later; they cannot be told apart, and the steps are the same.
SERIAL = Days("dates of a spreadsheet, in days since 1899-12-30", 25_000.0, 65_000.0, 25_569.0)
DAYS = (
    SERIAL,
    Days("dates of MATLAB, in days since the year 0", 700_000.0, 770_000.0, 719_529.0),
    Days("Julian dates, in days", 2.43e6, 2.49e6, 2_440_587.5),
)
YEAR = 365.25  # days
FIRST_YEAR, LAST_YEAR = 1990, 2050  # of a record, where no name says that numbers are dates
LONGEST = 30 * YEAR  # of a record
SHORTEST_STEP = 2e-3  # shorter steps are of days: no plant is sampled every 2 ms, and many every 3 minutes
USUAL_S = (*(60.0 * n for n in (3, 4, 5, 6, 10, 12, 15, 20, 30)), *(3600.0 * n for n in (1, 2, 3, 4, 6, 8, 12, 24)))
GRIDS_S = (1.0, 60.0, 300.0, 600.0, 900.0, 1800.0, 3600.0, 7200.0)  # that dates of a plant's readings stand on
REGULAR = 0.9  # of the steps are equal
DIFFERENT = 10  # times of the day, for a grid that is no chance
SHORT_DIGITS = 4  # a sampling period in seconds has no more


class UnclearCountError(RecordError):
    """Numbers that may be seconds or a count of days."""


def days_of(values: Array, *, dated: bool, counter: bool = False, everywhere: bool = False) -> Days | None:
    """The count of days that numbers (n,) are; None where they are seconds or another unit.

    ``dated`` is a header that says date, ``counter`` one that may number the rows. Other numbers are days if they stand
    on whole seconds, minutes or hours of the day, and their digits are none of a sampling period in seconds. Numbers
    ``everywhere`` come from all over a column, so that their steps say nothing. UnclearCountError where both may be.
    """
    own = next((d for d in DAYS if np.all((values > d.low) & (values < d.high))), None)
    if own is None or dated:
        return own
    years = 1970 + (values - own.at_1970) / YEAR
    if years.min() < FIRST_YEAR or years.max() > LAST_YEAR or np.ptp(values) > LONGEST:
        return None
    steps = np.abs(np.diff(values))
    stands = np.count_nonzero(steps == 0) > (1 - REGULAR) * len(steps)  # digits are missing
    steps = steps[steps > 0]
    step, whole = (float(np.median(steps)) if steps.size else 0.0), not np.any(values % 1)
    if everywhere:
        raise UnclearCountError(f"{values[0]:.10g}")
    if not whole and step < SHORTEST_STEP:
        return own
    if step > 1 or (whole and (step < 1 or counter)):
        return None
    unit = _last_digit(values)
    if not stands and _is_regular_and_odd(steps, step, unit):
        return None
    if not whole and _on_grid(values, unit):
        return own
    raise UnclearCountError(f"{values[0]:.10g}")


def _last_digit(values: Array) -> float:
    """The unit of the last digit that some of the numbers have, 1e-9 for all finer ones."""
    for digits in range(9):
        scaled = values * 10.0**digits
        if np.all(np.abs(scaled - np.round(scaled)) < 0.02):
            return float(10.0**-digits)
    return 1e-9


def _is_regular_and_odd(steps: Array, step: float, unit: float) -> bool:
    """Whether the steps are equal, and of no period that readings of a plant come in, taken as days."""
    equal = steps[np.abs(steps - step) <= 1.01 * unit]
    if len(equal) < REGULAR * len(steps):
        return False
    period_s = DAY_S * float(np.mean(equal))
    error_s = DAY_S * unit * (1 + len(steps) - len(equal)) / len(equal) + 1e-6 * period_s
    return all(abs(period_s - usual) > error_s for usual in USUAL_S)


def _on_grid(values: Array, unit: float) -> bool:
    """Whether all numbers are whole seconds, minutes or hours of the day, as no numbers of few digits are."""
    if len(np.unique(np.round(values % 1, 9))) < DIFFERENT:
        return False
    short = np.abs(values * 10.0**SHORT_DIGITS - np.round(values * 10.0**SHORT_DIGITS)) < 1e-4
    for grid_s in GRIDS_S:
        grid = grid_s / DAY_S
        beside = np.abs(values / grid - np.round(values / grid)) * grid
        exact = short & (beside < 0.01 * unit + 2e-11)
        if 4 * unit <= grid and np.all(beside <= 0.505 * unit + 2e-11) and 2 * np.count_nonzero(exact) <= len(values):
            return True
    return False
