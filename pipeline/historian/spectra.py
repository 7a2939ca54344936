"""Power of an input against the plant's band, and its coherence with a PV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.metrics import Array

SETTLINGS = 4  # of a segment
SHORTEST, LONGEST = 64, 4096  # rows of a segment
SEGMENTS = 4  # at least, for a coherence
MOST = 60_000  # rows
BAND = (0.1, 3.0)  # of the plant's corner frequency


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Spectra of one input and one PV over frequencies f (m,) [1/row]: shares of the input's power, and the coherence.

        coherence(f) = |P_uy|^2 / (P_uu P_yy),   P = S^-1

    with S the spectral matrix of all inputs and the PV: the partial coherence, 1 where the PV follows this input
    linearly and without noise once the other inputs' part is taken off.
    """

    frequency: Array
    power: Array  # (m,) of the input, sums to 1
    coherence: Array  # (m,)
    band: tuple[float, float]  # [1/row] of the plant: BAND times the corner 3 / (2 pi settling)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Frequencies (m,) of the plant's band; the nearest one where none lies in it."""
        inside = (self.frequency >= self.band[0]) & (self.frequency <= self.band[1])
        if not inside.any():
            inside = np.abs(self.frequency - self.band[0]) <= np.min(np.abs(self.frequency - self.band[0]))
        return inside

    @property
    def band_share(self) -> float:
        """Share of the input's power in the plant's band."""
        return float(self.power[self.inside].sum())

    @property
    def band_coherence(self) -> float:
        """Median coherence in the plant's band, where the input has power."""
        inside = self.inside & (self.power >= 1e-3 * self.power.max())
        return float(np.median(self.coherence[inside])) if inside.any() else 0.0


def spectra(u: Array, y: Array, run: NDArray[np.int64], settling: Sequence[int]) -> list[Spectrum] | None:
    """The spectrum of each input of u (n, m) and of y (n,), from the runs that hold a segment.

    ``settling`` [rows] of the answer to each input. None where too few segments fit for the coherences.
    """
    from scipy.signal import csd

    n, m = min(len(u), MOST), u.shape[1]
    length = int(np.clip(SETTLINGS * max(settling), SHORTEST, LONGEST))
    edges = np.r_[0, np.flatnonzero(np.diff(run[:n])) + 1, n]
    parts = [(int(a), int(b)) for a, b in pairwise(edges) if b - a >= length]
    if sum(2 * (b - a) // length - 1 for a, b in parts) < SEGMENTS + 2 * m:
        return None
    z = np.column_stack([u[:n], y[:n]])
    scale = z.std(axis=0)
    if not np.all(scale > 0):
        return None
    z = z / scale
    frequency = np.asarray(np.fft.rfftfreq(length), dtype=np.float64)
    cross = np.zeros((len(frequency), m + 1, m + 1), dtype=np.complex128)
    for a, b in parts:
        for i, j in combinations_with_replacement(range(m + 1), 2):
            own = csd(z[a:b, i], z[a:b, j], nperseg=length, detrend="constant")[1] * (b - a)
            cross[:, i, j] += own
            if i != j:
                cross[:, j, i] += own.conj()
    return [_of_input(frequency[1:], cross[1:], i, settling[i]) for i in range(m)]


def _of_input(frequency: Array, cross: NDArray[np.complex128], i: int, settling: int) -> Spectrum:
    power = np.abs(cross[:, i, i])
    ridge = 1e-9 * np.trace(cross, axis1=1, axis2=2).real[:, None, None] * np.eye(cross.shape[1])
    inverse = np.linalg.inv(cross + ridge)
    square = np.abs(inverse[:, i, -1]) ** 2 / np.maximum(np.abs(inverse[:, i, i] * inverse[:, -1, -1]), 1e-300)
    corner = 3.0 / (2 * np.pi * max(settling, 1))
    band = (BAND[0] * corner, min(BAND[1] * corner, 0.5))
    return Spectrum(frequency, power / max(float(power.sum()), 1e-300), np.clip(square, 0.0, 1.0), band)
