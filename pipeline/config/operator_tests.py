"""``cases.<case>.operated`` of params.yaml: tests of one's own in which operators change what a law is asked for."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

AT = "at_s"
TEST_NAME = re.compile(r"^[a-z][a-z0-9_]{0,39}$")

Timed = tuple[Mapping[str, float], ...]
"""Changes: each the time ``at_s`` [s] and values by name, which hold from then on."""


@dataclass(frozen=True, slots=True)
class OperatedTestParams:
    """One test: what operators set and when, and what else happens to the plant.

    ``operate`` are entries of the law's ``operate``, as ``TIC-1.low``; ``set_points`` by PV; ``measured`` disturbances
    by name; ``changes`` parameters of the plant that nobody measures, such as ``load_TIC-1`` [its unit a period]. Each
    is a list of changes with ``at_s``. The test begins where the plant rests and lasts ``duration_s`` [s].
    ``most_outside`` and ``least_gain`` are its own limits [%]: the share of time outside a range, at the end, and the
    share of the optimum's gain in profit. ``title`` describes it in the report.
    """

    duration_s: float
    operate: Timed
    set_points: Timed = ()
    measured: Timed = ()
    changes: Timed = ()
    title: str = ""
    most_outside: float | None = None
    least_gain: float | None = None

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise ValueError(f"duration_s is {self.duration_s:g}; it must be above 0")
        if not self.operate:
            raise ValueError("operate is empty; give one change or more, such as {at_s: 600, TIC-1.low: 40}")
        for name, rows in (
            ("operate", self.operate),
            ("set_points", self.set_points),
            ("measured", self.measured),
            ("changes", self.changes),
        ):
            for row in rows:
                _check_change(name, row, self.duration_s)
        for name, share in (("most_outside", self.most_outside), ("least_gain", self.least_gain)):
            if share is not None and not 0 <= share <= 100:
                raise ValueError(f"{name} is {share:g}; it is a share in %, 0 to 100")


def _check_change(what: str, row: Mapping[str, float], duration_s: float) -> None:
    """ValueError unless a change has a time within the test and at least one value."""
    if AT not in row or len(row) < 2:
        raise ValueError(f"{what} has the change {dict(row)}; it needs {AT} and one value or more by name")
    if not 0 <= row[AT] < duration_s:
        raise ValueError(f"{what} has a change at {row[AT]:g} s; the test lasts from 0 to {duration_s:g} s")


def check_names(names: Sequence[str]) -> None:
    """ValueError unless each name of a test is a small letter, then small letters, digits and _ (40 at most)."""
    for name in names:
        if not TEST_NAME.match(name):
            raise ValueError(f"operated has the test {name!r}; a name is a small letter, then small letters, digits, _")
