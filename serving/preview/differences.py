"""Values of a law's input ``ahead``: what is wrong with some, and how they follow from values to come."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.errors import ContractError
from loopwright.serving.preview.ahead import AheadInput
from loopwright.serving.ranges import numbers

Array: TypeAlias = NDArray[np.float64]

ROUNDING = 1e-9  # share of a range by which a sum of a present value and a difference may be rounded


class Differences:
    """Differences (N n,) of the n signals of ``ahead`` from their present values, at N samples to come."""

    def __init__(self, ahead: AheadInput) -> None:
        self.ahead = ahead
        self.none: Array = np.zeros(ahead.size)  # all stay as they are
        self._low, self._high = (np.array([getattr(s, end) for s in ahead.signals]) for end in ("low", "high"))
        self._slack = ROUNDING * (self._high - self._low)

    def checked(self, values: ArrayLike, present: Array) -> Array:
        """``values`` as float64 (N n,); ContractError with the first signal and sample that is wrong.

        A difference must be finite, and with the ``present`` value (n,) give one within the signal's range. It is
        refused and not clipped: a value out of range is a mistake of whoever made the course. A present value outside
        its range may stay, or come nearer.
        """
        a, n = self.ahead, len(self.ahead.signals)
        if self._plainly(values, present):
            return np.asarray(values)
        try:
            given = np.asarray(numbers(values), dtype=np.float64)
        except TypeError as error:
            raise ContractError(f"ahead {error}; it needs {a.size} numbers") from error
        if given.shape != (a.size,):
            names = ", ".join(s.signal for s in a.signals)
            raise ContractError(
                f"ahead has the shape {given.shape}; it needs ({a.size},): differences of {names} at each of "
                f"{a.horizon} samples, {a.period_s:g} s apart"
            )
        allowed = self.allowed(given, present)
        if not allowed.all():
            i, s = divmod(int(np.argmin(allowed)), n)
            of, change = a.signals[s], float(given[i * n + s])
            raise ContractError(
                f"ahead: {of.signal} is {present[s] + change:g} {of.unit} at sample {i + 1} of {a.horizon}, from "
                f"{present[s]:g} now by the difference {change:g}; allowed is {of.low:g} to {of.high:g} {of.unit}"
            )
        return given

    def _plainly(self, values: ArrayLike, present: Array) -> bool:
        """Whether all values to come lie within the ranges themselves: quick to see in a step, as most do."""
        if not isinstance(values, np.ndarray) or values.dtype != np.float64 or values.shape != self.none.shape:
            return False
        rows = values.reshape(self.ahead.horizon, -1)
        least, most = (rows.min(axis=0) + present).tolist(), (rows.max(axis=0) + present).tolist()
        ranges = zip(self.ahead.signals, least, most, strict=True)
        return all(s.low <= low and high <= s.high for s, low, high in ranges)

    def allowed(self, given: Array, present: Array) -> NDArray[np.bool_]:
        """Whether each difference (..., N n) may be given beside the present values (..., n)."""
        now = present[..., None, :]
        then = now + given.reshape(*given.shape[:-1], self.ahead.horizon, len(self.ahead.signals))
        low, high = np.minimum(self._low, now) - self._slack, np.maximum(self._high, now) + self._slack
        good = ((then >= low) & (then <= high)) | ~np.isfinite(now)  # the sample itself is refused for that
        good &= np.isfinite(given).reshape(then.shape)
        return np.asarray(good).reshape(given.shape)

    def within(self, given: Array, present: Array) -> Array:
        """The differences (N n,) nearest to ``given`` that may be given beside the present values (n,).

        Zeros where a present value is not finite: the sample is refused for that.
        """
        known = np.isfinite(present)
        now = np.where(known, present, self._low)
        low, high = np.minimum(self._low, now) - now, np.maximum(self._high, now) - now
        return np.where(known, np.clip(given.reshape(-1, len(now)), low, high), 0.0).ravel()
