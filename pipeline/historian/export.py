"""Export: what the files hold, a series of readings a tag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pipeline.historian.character import runs_of
from pipeline.historian.numbers import Codes
from pipeline.historian.reason import Reason
from pipeline.metrics import Array

CLOCK_S = 3600.0  # a clock set back at the end of summer time
CLOCK_SLACK_S = 300.0


@dataclass(slots=True, eq=False)
class Series:
    """Readings of one tag in the order of time; ``code`` says which of them are good, and why the others are not."""

    tag: str
    time_s: Array  # (n,) [s]
    value: Array  # (n,) NaN where the cell holds no number
    code: Codes  # (n,) Reason
    texts: Counter[str] = field(default_factory=Counter)  # cells that hold no number; of a mode, its names
    categories: tuple[str, ...] = ()  # of a mode: value i is categories[i]

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def good(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which readings are good, shape (n,)."""
        return self.code == Reason.GOOD

    def counts(self) -> dict[str, int]:
        """Number of readings by reason, GOOD too; together they are all of them."""
        found = np.bincount(self.code, minlength=len(Reason))
        return {r.name.lower(): int(found[r]) for r in Reason if found[r]}

    def lighten(self, around: int = 400) -> None:
        """Keep the bad readings, and the others only near the longest stretch of each reason: what pictures show."""
        keep = ~self.good
        for reason in np.unique(self.code[keep]):
            start, end = runs_of(self.code == reason)
            longest = int(np.argmax(end - start))
            around_it = max(around, int(end[longest] - start[longest]))
            keep[max(int(start[longest]) - around_it, 0) : int(end[longest]) + around_it] = True
        self.time_s, self.value, self.code = self.time_s[keep], self.value[keep], self.code[keep]

    def flag(self, where: np.ndarray[tuple[int], np.dtype[np.bool_]], reason: Reason) -> int:
        """Give good readings a reason; how many have it now for the first time."""
        new = where & self.good
        self.code[new] = reason
        return int(np.count_nonzero(new))


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """All readings of the tags that were asked for, in one or more files."""

    series: Mapping[str, Series]
    files: tuple[tuple[str, str], ...]  # path, sha256
    layout: str  # wide or long
    rows: int  # lines or rows of the files
    unreadable_rows: int  # of another length than the header's
    timeless_rows: int  # whose time cannot be read
    notes: tuple[str, ...] = ()


def in_order(series: Series) -> Series:
    """The readings sorted by time; of equal times the last good one stays, the others are DUPLICATE.

    Times that come twice because a clock was set back by an hour are CLOCK, in both passes.
    """
    t = series.time_s
    back = np.flatnonzero(np.diff(t) < 0)
    ambiguous = np.zeros(len(t), dtype=bool)
    for k in back if len(back) <= 20 else ():  # more is disorder
        if abs(t[k] - t[k + 1] - CLOCK_S) < CLOCK_SLACK_S and k + 2 < len(t):
            ambiguous |= (t >= t[k + 1]) & (t <= t[k])
    series.code[ambiguous & series.good] = Reason.CLOCK
    if back.size:
        order = np.argsort(t, kind="stable")
        series.time_s, series.value, series.code = t[order], series.value[order], series.code[order]
        t = series.time_s
    same = np.flatnonzero(np.diff(t) == 0)
    if same.size:
        # The last good reading of a time stays; groups are short, so one pass from the end is enough.
        group = np.cumsum(np.r_[True, np.diff(t) > 0]) - 1
        rank = np.where(series.good, np.arange(len(t)), -1)
        best = np.full(int(group[-1]) + 1, -1)
        np.maximum.at(best, group, rank)
        twice = np.bincount(group)[group] > 1
        series.code[twice & series.good & (best[group] != np.arange(len(t)))] = Reason.DUPLICATE
    return series


def joined(parts: list[Series]) -> Series:
    """Readings of one tag from several files, in the order of time."""
    if len(parts) == 1:
        return in_order(parts[0])
    names = tuple(dict.fromkeys(c for p in parts for c in p.categories))
    for p in parts:
        if p.categories:
            index = np.array([names.index(c) for c in p.categories], dtype=np.float64)
            p.value = np.where(np.isfinite(p.value), index[np.nan_to_num(p.value).astype(np.int64)], np.nan)
    parts = sorted(parts, key=lambda p: float(p.time_s[0]) if len(p) else 0.0)
    texts = sum((p.texts for p in parts), Counter[str]())
    time_s, value = (np.concatenate([getattr(p, key) for p in parts]) for key in ("time_s", "value"))
    return in_order(Series(parts[0].tag, time_s, value, np.concatenate([p.code for p in parts]), texts, names))
