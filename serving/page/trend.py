"""Columns of a journal over a time, thinned to what a screen can show."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.journal import JournalReader

Array: TypeAlias = NDArray[np.float64]
Piece: TypeAlias = tuple[Array, dict[str, Array], list[str]]  # times, columns, modes

LINE_GAP = 5  # periods without a scan: a gap in the line
MOST_POINTS = 2_000  # of a curve: a screen has no more
MOST_CHANGES = 4  # of the mode for each point: two rows a point are drawn whole, each with a gap before it
MODES = ("", "AUTO", "SHADOW", "MANUAL", "HOLD")  # the last is what an operator must not miss


class BinnedExtremes:
    """The least and the greatest value of every column in each of ``points`` bins of a time, as they come in.

    A bin gives two rows at one time vector for all columns, in the order in which the two came in most columns' time;
    with fewer scans than rows there is nothing to thin, and the scans themselves are given.
    """

    def __init__(self, begin_s: float, end_s: float, points: int) -> None:
        self.begin_s, self.points = begin_s, points
        self.bin_s = max((end_s - begin_s) / points, 1e-9)
        self.low: dict[str, Array] = {}
        self.high: dict[str, Array] = {}
        self.rising: dict[str, NDArray[np.bool_]] = {}
        self.count = np.zeros(points, dtype=np.int64)
        self.first, self.last = np.full(points, np.nan), np.full(points, np.nan)

    def add(self, times: Array, columns: dict[str, Array]) -> None:
        """Scans at ``times`` (n,), in order; each column (n,)."""
        bins = np.clip(((times - self.begin_s) / self.bin_s).astype(np.int64), 0, self.points - 1)
        starts = np.flatnonzero(np.r_[True, bins[1:] != bins[:-1]])
        at = bins[starts]
        ends = np.r_[starts[1:], len(bins)] - 1
        self.first[at] = np.fmin(self.first[at], times[starts])
        self.last[at] = np.fmax(self.last[at], times[ends])
        self.count[at] += ends - starts + 1
        for name, values in columns.items():
            if name not in self.low:
                self.low[name], self.high[name] = np.full((2, self.points), np.nan)
                self.rising[name] = np.ones(self.points, dtype=bool)
            low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
            self.rising[name][at] = ~(values[starts] > values[ends])
            self.low[name][at] = np.fmin(self.low[name][at], low)
            self.high[name][at] = np.fmax(self.high[name][at], high)

    def rows(self) -> tuple[Array, dict[str, Array]]:
        """Times and columns, two rows a bin that has scans."""
        full = np.flatnonzero(self.count)
        times = np.stack([self.first[full], self.last[full]], axis=1).ravel()
        columns = {
            name: np.where(
                self.rising[name][full, None],
                np.stack([self.low[name][full], self.high[name][full]], axis=1),
                np.stack([self.high[name][full], self.low[name][full]], axis=1),
            ).ravel()
            for name in self.low
        }
        return times, columns


class Modes:
    """The changes of mode, ``(time, mode)``, as scans come in; the mode is empty where none did.

    ``changes`` has all of the first ``MOST_CHANGES`` times ``points``; ``thinned`` gives at most one a bin.
    """

    def __init__(self, begin_s: float, bin_s: float, points: int) -> None:
        self.begin_s, self.bin_s, self.points = begin_s, bin_s, points
        self.changes: list[tuple[float, str]] = []
        self._bins: dict[int, tuple[float, str, str]] = {}  # the first change's time, what is shown, the last mode
        self._last: float | None = None
        self._present = ""

    def add(self, times: Array, modes: list[str], longest_s: float) -> None:
        """Scans at ``times`` (n,), in order; a pause longer than ``longest_s`` is a gap."""
        last = times[0] if self._last is None else self._last
        before = np.concatenate([[last], times[:-1]])
        gaps = times - before > longest_s
        for t, since, gap, mode in zip(times.tolist(), before.tolist(), gaps.tolist(), modes, strict=True):
            if gap:
                self._change(since, "")
            if mode != self._present:
                self._change(t, mode)
        self._last = float(times[-1])

    def _change(self, time_s: float, mode: str) -> None:
        self._present = mode
        if len(self.changes) < MOST_CHANGES * self.points:
            self.changes.append((time_s, mode))
        bin_ = min(max(int((time_s - self.begin_s) / self.bin_s), 0), self.points - 1)
        first, shown, _ = self._bins.get(bin_, (time_s, mode, mode))
        self._bins[bin_] = first, _graver(shown, mode), mode

    def thinned(self) -> list[tuple[float, str]]:
        """At most one change a bin. A bin shows of its modes the one that an operator must not miss."""
        made: list[tuple[float, str]] = []
        drawn = last = ""
        for bin_ in sorted({*self._bins, *(b + 1 for b in self._bins)}):
            first, shown, after = self._bins.get(bin_, (0.0, last, last))
            begin_s = self.begin_s + bin_ * self.bin_s
            if drawn != last:  # the bin before showed another mode than its last
                first, shown = begin_s, _graver(shown, last)
            if shown != drawn:
                made.append((first, shown))
            drawn, last = shown, after
        return made


def _graver(one: str, other: str) -> str:
    """The one of two modes that is shown where there is room for one."""
    return max(one, other, key=lambda mode: MODES.index(mode) if mode in MODES else 0)


def trend(reader: JournalReader, begin_s: float, end_s: float, points: int) -> dict[str, Any]:
    """The trend from ``begin_s`` to ``end_s``: at most 2 ``points`` rows, and the changes of mode, thinned alike.

    The mode is empty from the last scan before a gap to the first one after it. Times ascend: where the clock was set
    back, what came before and after it lies one over the other.
    """
    thinned, whole, count = BinnedExtremes(begin_s, end_s, points), list[Piece](), 0
    modes = Modes(begin_s, thinned.bin_s, points)
    runs: dict[int, dict[str, Any]] = {}
    longest = float(LINE_GAP)
    for run, numbers, mode in reader.tables(begin_s, end_s):
        if not runs:  # of the same state of the file as the scans: another controller may take over meanwhile
            runs = {r["id"]: r for r in reader.runs()}
            longest = LINE_GAP * max(r["period_s"] / r["speed"] for r in runs.values())
        order = np.argsort(numbers[:, 0], kind="stable")
        numbers, mode = numbers[order], [mode[i] for i in order]
        times = numbers[:, 0]
        columns = {name: numbers[:, i + 1] for i, name in enumerate(runs[run]["columns"])}
        thinned.add(times, columns)
        count += len(times)
        if count <= 2 * points:
            whole.append((times, columns, mode))
        modes.add(times, mode, longest)
    if count <= 2 * points:
        times, columns, mode = _joined(whole)
        modes = Modes(begin_s, thinned.bin_s, points)
        if len(times):
            modes.add(times, mode, longest)
    else:
        times, columns = thinned.rows()
    times, columns = _with_gaps(times, columns, max(longest, 2.5 * thinned.bin_s if count > 2 * points else 0.0))
    return {
        "time": times.tolist(),
        "columns": {name: plain(values) for name, values in columns.items()},
        "modes": modes.changes if count <= 2 * points else modes.thinned(),
    }


def _joined(pieces: list[Piece]) -> Piece:
    """Pieces as one, by time; a column that a piece lacks is NaN there."""
    names = list(dict.fromkeys(name for _, columns, _ in pieces for name in columns))
    times = np.concatenate([t for t, _, _ in pieces]) if pieces else np.zeros(0)
    order = np.argsort(times, kind="stable")
    joined = {
        name: np.concatenate([columns.get(name, np.full(len(t), np.nan)) for t, columns, _ in pieces])[order]
        for name in names
    }
    modes = [mode for _, _, of in pieces for mode in of]
    return times[order], joined, [modes[i] for i in order]


def _with_gaps(times: Array, columns: dict[str, Array], longest_s: float) -> tuple[Array, dict[str, Array]]:
    """A row of NaN in each pause that is longer than ``longest_s``."""
    at = np.flatnonzero(np.diff(times) > longest_s) + 1
    if not len(at):
        return times, columns
    between = (times[at] + times[at - 1]) / 2
    return np.insert(times, at, between), {name: np.insert(v, at, np.nan) for name, v in columns.items()}


def plain(values: Iterable[float]) -> list[float | None]:
    """Numbers for JSON: seven digits are more than a screen shows; NaN is null."""
    return [None if v != v or v in (np.inf, -np.inf) else float(f"{v:.7g}") for v in values]
