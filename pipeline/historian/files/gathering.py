"""Blocks of a file, put together: the series of each tag, without a copy of the whole, and no row twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.export import SENT_AGAIN, Series
from loopwright.pipeline.historian.files.numbers import numbers
from loopwright.pipeline.historian.files.quality import MOST_QUALITIES, Reason, meaning_of
from loopwright.pipeline.metrics import Array

# ------------------------------------------------------------------------------------- rows that stand in a file again
FACTOR = np.uint64(0x9E3779B97F4A7C15)


def flag_repeated_rows(series: Mapping[str, Series]) -> None:
    """Rows of one file that stand there again, stamp and all values, become DUPLICATE; the first of each stays.

    Tags with the same stamps share rows. Only where nearly all rows that share a stamp are equal, in every tag:
    where stamps are rounded the rows differ, but a resting tag repeats its value by right.
    """
    found = []
    for group in with_the_same_stamps(list(series.values())):
        t = group[0].time_s
        if not len(t) or np.all(np.diff(t) > 0):
            continue
        shared = len(t) - len(np.unique(t))
        if not shared:
            continue
        again = _repeated(t, row_keys(group))
        if np.count_nonzero(again) <= SENT_AGAIN * shared:
            return
        found.append((group, again))
    for group, again in found:
        for one in group:
            one.code[again] = Reason.DUPLICATE


def with_the_same_stamps(series: Sequence[Series]) -> list[list[Series]]:
    """Tags in groups that share their stamps: the columns of one file."""
    groups: list[list[Series]] = []
    for one in series:
        t = one.time_s
        own = next((g for g in groups if g[0].time_s is t or np.array_equal(g[0].time_s, t)), None)
        if own is None:
            groups.append([one])
        else:
            own.append(one)
    return groups


def row_keys(group: Sequence[Series]) -> NDArray[np.uint64]:
    """A number (n,) for the values of each row; two that are equal by chance are next to impossible."""
    keys = np.zeros(len(group[0]), dtype=np.uint64)
    for one in group:
        bits = (np.where(np.isnan(one.value), np.inf, one.value) + 0.0).view(np.uint64)
        keys = keys * FACTOR + (bits ^ (bits >> np.uint64(29))) + one.code
    return keys


def _repeated(t: Array, keys: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Where (n,) a row has the stamp and the key of an earlier one."""
    order = np.lexsort((keys, t))  # stable: of equal rows the first of the file stays the first
    again = np.zeros(len(t), dtype=bool)
    again[order[1:]] = (np.diff(t[order]) == 0) & (keys[order][1:] == keys[order][:-1])
    return again


# ------------------------------------------------------------------------------------- series that grow block by block
ARRAY_GROWTH = 1.1  # of an array that is full: what is spare takes memory too


class Gathered:
    """Blocks of readings, put together; of a wide file the time stands once in memory."""

    def __init__(self, modes: set[str], decimal: str, *, wide: bool) -> None:
        self.modes, self.decimal, self.wide = modes, decimal, wide
        self.time: dict[str, Growing] = {}
        self.value: dict[str, Growing] = {}
        self.code: dict[str, Growing] = {}
        self.texts: dict[str, Counter[str]] = {}
        self.names: dict[str, dict[str, int]] = {}
        # Of a tag and a column of its quality: the index of each reading's quality among the words of the column.
        self.flag: dict[tuple[str, str], Growing] = {}
        self.words: dict[str, Counter[str]] = {}  # of each column of quality, in the order of their index
        self.says: dict[str, str] = {}  # column of quality -> how it was understood

    def add(self, name: str, seconds: Any, column: Any, qualities: Mapping[str, Any]) -> None:
        """A block of readings of one tag: seconds (m,), its Arrow column, and those of its qualities by their names."""
        if name in self.modes:
            known = self.names.setdefault(name, {})
            index, cells = _categories(column)
            numbered = [float(known.setdefault(c, len(known))) if c else np.nan for c in cells]
            values = np.array([*numbered, np.nan])[index]
            codes = np.where(np.isnan(values), np.uint8(Reason.EMPTY), np.uint8(Reason.GOOD))
        else:
            values, codes, texts = numbers(column, self.decimal)
            self.texts.setdefault(name, Counter()).update(texts)
        for header, quality in qualities.items():
            self._add_quality(name, quality, header)
        if not self.wide or name == next(iter(self.value), name):
            self.time.setdefault("" if self.wide else name, Growing(np.float64)).append(seconds)
        self.value.setdefault(name, Growing(np.float64)).append(values)
        self.code.setdefault(name, Growing(np.uint8)).append(codes)

    def series(self) -> dict[str, Series]:
        """The series of each tag; nothing may be added afterwards."""
        code = {name: grown.whole() for name, grown in self.code.items()}
        good, lost = {}, dict[str, list[str]]()
        for column, words in self.words.items():
            meaning = meaning_of(column, words)
            good[column] = None if meaning.good is None else np.array([w in meaning.good for w in words])
            self.says[column] = meaning.says
        for (name, column), flag in self.flag.items():
            if (known := good[column]) is not None:
                bad = ~known[flag.whole()]
                if bad.all() and bad.size:
                    lost.setdefault(column, []).append(name)
                code[name][bad & (code[name] == Reason.GOOD)] = Reason.QUALITY
        for column, names in lost.items():  # its only note
            shown = ", ".join(t.strip() or "an empty cell" for t, _ in self.words[column].most_common(3))
            self.says[column] = (
                f"calls every reading of {', '.join(names[:3])} bad, by {shown}; remove it if it is wrong"
            )
        times = {name: grown.whole() for name, grown in self.time.items()}
        return {
            name: Series(
                name,
                times["" if self.wide else name],
                value.whole(),
                code[name],
                self.texts.get(name, Counter()),
                tuple(self.names.get(name, ())),
            )
            for name, value in self.value.items()
        }

    def _add_quality(self, name: str, column: Any, header: str) -> None:
        """Keep the quality (m,) of a block: what it means is known from all of them."""
        words = self.words.setdefault(header, Counter())
        place = {word: i for i, word in enumerate(words)}
        index, cells = _categories(pc.cast(column, pa.string()) if not pa.types.is_dictionary(column.type) else column)
        cells = [*cells, ""]  # of the index -1, a null
        own = np.array([place.setdefault(word, len(place)) for word in cells])
        if len(place) > MOST_QUALITIES:
            raise RecordError(f"column {header!r} has more than {MOST_QUALITIES} qualities; name it otherwise")
        for word in place:
            words.setdefault(word, 0)
        for i, times in enumerate(np.bincount(np.where(index < 0, len(cells) - 1, index), minlength=len(cells))):
            words[cells[i]] += int(times)
        self.flag.setdefault((name, header), Growing(np.uint16)).append(own[index].astype(np.uint16))


class Growing:
    """An array that grows in place: many blocks leave no copies behind."""

    def __init__(self, dtype: type) -> None:
        self.values: Any = np.empty(0, dtype)
        self.length = 0

    def append(self, block: Any) -> None:
        """Add the values of ``block`` (m,)."""
        end = self.length + len(block)
        if end > len(self.values):
            self.values.resize(max(end, int(ARRAY_GROWTH * end)), refcheck=False)
        self.values[self.length : end] = block
        self.length = end

    def whole(self) -> Any:
        """All values, (n,); nothing may be appended afterwards."""
        self.values.resize(self.length, refcheck=False)
        return self.values


def _categories(column: Any) -> tuple[Any, list[str]]:
    """Index (n,) of each cell among the texts of the column, -1 where it is null; the texts as they come first."""
    if pa.types.is_dictionary(column.type):
        column = pc.cast(column, column.type.value_type)
    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    encoded = column.dictionary_encode()
    index = encoded.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    return index, [("" if c is None else str(c).strip()) for c in encoded.dictionary.to_pylist()]
