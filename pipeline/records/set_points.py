"""The set points under which the rows of a record were made; they lie in a file beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.files import draft_of
from loopwright.pipeline.metrics import Array

SET_POINTS = "set_points.npz"
"""Beside the record of an own plant: what stage `screen` found of its loops."""


@dataclass(frozen=True, slots=True, eq=False)
class SetPoints:
    """Set points (n, n_sp) of PVs in the rows of a record, in their units; NaN where a loop was not in automatic."""

    pvs: tuple[str, ...]
    values: Array

    def write(self, record: Path) -> None:
        """Write the file beside the record; none where no set point is known."""
        if self.pvs:
            with draft_of(record.with_name(SET_POINTS)) as draft, draft.open("wb") as file:
                np.savez_compressed(file, pvs=np.array(self.pvs), values=self.values)

    @classmethod
    def beside(cls, record: Path) -> Self | None:
        """The set points beside a record; None where there are none."""
        path = record.with_name(SET_POINTS)
        if not path.is_file():
            return None
        with np.load(path, allow_pickle=False) as file:
            return cls(tuple(map(str, file["pvs"])), np.asarray(file["values"], dtype=np.float64))

    def of(self, cvs: Sequence[str]) -> Array | None:
        """The set points (n, n_cv) of these PVs; None where one of them has none."""
        if not set(cvs) <= set(self.pvs):
            return None
        return self.values[:, [self.pvs.index(cv) for cv in cvs]]


def stretches(known: NDArray[np.bool_], run: NDArray[np.int64], least: int) -> list[slice]:
    """Stretches of rows (n,) of one run that are all ``known`` (n,), with at least so many rows."""
    edges = np.flatnonzero(np.diff(np.where(known, run, -1), prepend=-2, append=-2))
    pairs = zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    return [slice(a, b) for a, b in pairs if known[a] and b - a >= least]
