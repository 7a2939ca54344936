"""Operators' changes of a running law over a test: which entries of ``operate`` are set at which sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.errors import LoopwrightError
from loopwright.serving.manifest import OperateEntry
from loopwright.serving.operating import Operate


@dataclass(frozen=True, slots=True)
class OperatorChange:
    """Entries of ``operate`` by name, as ``TIC-1.low``, in engineering units, that are set at sample ``at``."""

    at: int
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class OperatedCourse:
    """The values (n, n_operate) of all entries at every sample of a test."""

    entries: tuple[OperateEntry, ...]
    values: Array

    @classmethod
    def of(
        cls, entries: Sequence[OperateEntry], changes: Sequence[OperatorChange], n: int, where: str
    ) -> OperatedCourse:
        """From the defaults of ``entries``, with ``changes`` each from its sample on, over ``n`` samples.

        ParamsError, which begins with ``where``, for a change beyond the test, an unknown name or a wrong value.
        """
        operate = Operate(entries)
        values, now = np.empty((n, len(operate.entries))), operate.default
        values[:] = now
        for change in sorted(changes, key=lambda one: one.at):
            if not 0 <= change.at < n:
                raise ParamsError(f"{where}: operators change it at sample {change.at}; the test has 0 to {n - 1}")
            try:
                now = operate.with_values(change.values, now)
            except LoopwrightError as error:
                raise ParamsError(f"{where}: {error}") from error
            values[change.at :] = now
        return cls(operate.entries, values)

    def of_signal(self, signal: str, what: str) -> Array | None:
        """The course (n,) of ``signal.what``; None where the law has no such entry."""
        for i, entry in enumerate(self.entries):
            if (entry.signal, entry.what) == (signal, what):
                return self.values[:, i]
        return None

    def at(self, signal: str, what: str, default: float, sample: int = -1) -> float:
        """The value of ``signal.what`` at a sample, by default the last; ``default`` where there is no such entry."""
        course = self.of_signal(signal, what)
        return default if course is None else float(course[sample])

    def changed(self) -> NDArray[np.intp]:
        """Samples (k,) at which any entry changes; sample 0 counts where it begins off its defaults."""
        default = np.array([entry.default for entry in self.entries])
        moved = np.any(np.diff(self.values, axis=0, prepend=default[None]) != 0, axis=1)
        return np.flatnonzero(moved)
