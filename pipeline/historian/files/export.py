"""Export: what the files hold, a series of readings a tag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import tzinfo
from itertools import combinations, pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.files.numbers import Codes
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import runs_of
from loopwright.pipeline.metrics import Array

MOST_PASSES = 20  # over the same time; more is disorder
LEAST_OVERLAP = 5  # readings
SENT_AGAIN = 0.9  # of the values of two passes that are equal: sent twice, and no ambiguous clock
NO_CUTS = np.zeros(0, dtype=np.int64)
SHARED = 0.4  # of the readings have the stamp of the one before: stamps are rounded


@dataclass(slots=True, eq=False)
class Series:
    """Readings of one tag in the order of time; ``code`` says which of them are good, and why the others are not."""

    tag: str
    time_s: Array  # (n,) [s]
    value: Array  # (n,) NaN where the cell holds no number
    code: Codes  # (n,) Reason
    texts: Counter[str] = field(default_factory=Counter)  # cells that hold no number; of a mode, its names
    categories: tuple[str, ...] = ()  # of a mode: value i is categories[i]
    between: Literal["", "step", "line"] = ""  # how it goes from one reading to the next; "" is to be guessed
    rounded_s: float = 0.0  # to which the stamps were rounded, where several readings shared each

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def good(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """The readings that are good, shape (n,)."""
        return self.code == Reason.GOOD

    def counts(self) -> dict[str, int]:
        """Number of readings by reason, GOOD too; together they are all of them."""
        found = {r.name.lower(): int(np.count_nonzero(self.code == r)) for r in Reason}
        return {name: n for name, n in found.items() if n}

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


class Note(NamedTuple):
    """An assumption about a column of a file, for a person to confirm."""

    column: str
    words: str


@dataclass(frozen=True, slots=True)
class Contents:
    """The tags of one file among those asked for, in how many rows, and from when to when [s]."""

    path: str
    tags: frozenset[str]
    rows: int
    first_s: float
    last_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """All readings of the tags that were asked for, in one or more files."""

    series: Mapping[str, Series]
    files: tuple[tuple[str, str], ...]  # path, sha256
    layout: str  # wide or long
    rows: int  # lines or rows of the files
    unreadable_rows: int  # of another length than the header's
    timeless_rows: int  # whose time cannot be read
    zone: str = ""  # that its dates are in, or that it states none; empty where times are no dates
    contents: tuple[Contents, ...] = ()  # of each file
    notes: tuple[Note, ...] = ()
    local: tzinfo | None = None  # the zone that a person named for dates which state none; they are kept as UTC


def in_order(series: Series, files: NDArray[np.int64] = NO_CUTS) -> Series:
    """The readings sorted by time; of equal times the last good one stays, the others are DUPLICATE.

    Two passes over the same time with other values are CLOCK, both of them: a clock was set back, or zones are mixed.
    Rows in two passes were sent again: the first stays, the others are DUPLICATE. The rest that shares rounded stamps
    in equal numbers is spread evenly over them. ``files`` are the readings, (m,), with which the second and later files
    begin; where the times are in disorder, a file counts as a pass.
    """
    t = series.time_s
    back = np.flatnonzero(np.diff(t) < 0)
    if 0 < len(back) <= MOST_PASSES:  # more is disorder
        series.code[_ambiguous(t, series.value, back + 1) & series.good] = Reason.CLOCK
    if back.size or files.size:
        cuts = back + 1 if len(back) <= MOST_PASSES else files
        series.code[_in_another_pass(t, series.value, cuts) & series.good] = Reason.DUPLICATE
    if back.size:
        order = np.argsort(t, kind="stable")
        series.time_s, series.value, series.code = t[order], series.value[order], series.code[order]
        t = series.time_s
    same = np.flatnonzero(np.diff(t) == 0)
    once = series.code != Reason.DUPLICATE
    if np.count_nonzero(np.diff(t[once]) == 0) > SHARED * np.count_nonzero(once):
        _spread(series, once)
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


def _ambiguous(t: Array, values: Array, cuts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Readings (n,) of passes over the same time, each ascending, that disagree with another pass."""
    where = np.zeros(len(t), dtype=bool)
    edges = [0, *cuts.tolist(), len(t)]
    passes = [slice(a, b) for a, b in pairwise(edges)]
    for one, other in combinations(passes, 2):
        start, end = max(t[one][0], t[other][0]), min(t[one][-1], t[other][-1])
        first, second = ((t[p] >= start) & (t[p] <= end) for p in (one, other))
        if min(first.sum(), second.sum()) < LEAST_OVERLAP:
            continue
        _, i, j = np.intersect1d(t[one][first], t[other][second], return_indices=True)
        if len(i) >= 0.5 * min(len(np.unique(t[one][first])), len(np.unique(t[other][second]))):
            same = values[one][first][i] == values[other][second][j]
            if np.mean(same) > SENT_AGAIN:
                continue  # the same readings, sent again
        for part, inside in ((one, first), (other, second)):
            where[part] |= inside
    return where


def _in_another_pass(t: Array, values: Array, cuts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Readings (n,) whose stamp and value an earlier pass holds too, as many of them as it holds."""
    of_pass = np.zeros(len(t), dtype=np.int64)
    of_pass[cuts] = 1
    of_pass = np.cumsum(of_pass)
    value = np.nan_to_num(values, nan=np.inf)
    rank = _rank(t, value, of_pass)  # within a pass equal readings may stand side by side: their stamps are rounded
    return _rank(t, value, rank) > 0


def _rank(*keys: NDArray[Any]) -> NDArray[np.int64]:
    """How many earlier rows (n,) have the same keys, each (n,)."""
    order = np.lexsort(keys)  # stable
    first = np.r_[True, np.any([k[order][1:] != k[order][:-1] for k in keys], axis=0)]
    place = np.arange(len(order))
    out = np.empty(len(order), dtype=np.int64)
    out[order] = place - np.maximum.accumulate(np.where(first, place, 0))
    return out


def _spread(series: Series, which: NDArray[np.bool_]) -> None:
    """``which`` readings (n,), in the order of the file, in groups of one stamp, over the time to the next stamp.

    Equal groups only. The others keep their stamps.
    """
    t = series.time_s[which]
    stamps, counts = np.unique(t, return_counts=True)
    usual = int(np.median(counts))
    if usual < 2 or len(stamps) < 3 or np.mean(np.abs(counts[1:-1] - usual) <= 1) < 0.8:
        return
    step = float(np.median(np.diff(stamps)))
    rank = np.arange(len(t)) - np.repeat(np.cumsum(counts) - counts, counts)
    # The first group may begin anywhere within its step; it ends with it.
    rank[: counts[0]] += max(usual - counts[0], 0)
    time_s = series.time_s.copy()
    time_s[which] = t + rank * (step / np.maximum(np.repeat(counts, counts), usual))
    order = np.argsort(time_s, kind="stable")
    series.time_s, series.value, series.code = time_s[order], series.value[order], series.code[order]
    series.rounded_s = step


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
    files = np.cumsum([len(p) for p in parts[:-1]])
    code = np.concatenate([p.code for p in parts])
    return in_order(Series(parts[0].tag, time_s, value, code, texts, names), files[files < len(time_s)])
