"""MVs in an operator's hand while the law has the others: where they are sent, and how the law is told of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest, Signal

Array: TypeAlias = NDArray[np.float64]
Those: TypeAlias = NDArray[np.bool_]


class ByHand:
    """Where an operator sent the MVs, and the way there: each by at most its ``max_move`` a period, as with any law.

    It counts from the last command, which also a plant without a read-back has. Where nobody knows where the MV
    stands, it is where the operator says, once a good sample has no read-back, and at once where none has ever had one;
    a bad read-back ends the way.
    """

    def __init__(self) -> None:
        self.wanted: Array | None = None  # shape: (n_mv,), NaN of those that are there; None: nobody moves any by hand

    def sent(
        self, mv: Array, wanted: Array, signals: Sequence[Signal], taken: Those | None = None, *, untold: bool = False
    ) -> Array:
        """Begin the way to ``wanted`` (n_mv,); the MV from now on, which is there already where it is not limited.

        Those ``taken`` (n_mv,) out of use with it begin at the next scan, which shows where they stand; and all, where
        nobody knows where they stand, or others had them until now and nothing has told since (``untold``).
        """
        limited = np.array([s.most < np.inf for s in signals])
        limited = limited if taken is None else limited | taken
        if untold or np.isnan(mv).any():
            limited[:] = True
        self.wanted = np.where(limited, wanted, np.nan)
        self._end()
        return np.where(limited, mv, wanted)

    def toward(self, mv: Array, signals: Sequence[Signal]) -> Array:
        """The MV (n_mv,) one period nearer."""
        if self.wanted is None:
            return mv
        wanted = self.goal(mv)
        ahead = np.array([s.toward(*ends) for s, *ends in zip(signals, mv.tolist(), wanted.tolist(), strict=True)])
        self.wanted[ahead == wanted] = np.nan
        self._end()
        return ahead

    def goal(self, mv: Array) -> Array:
        """Where each MV (n_mv,) goes; where it is, unless somebody moves it."""
        return mv.copy() if self.wanted is None else np.where(np.isnan(self.wanted), mv, self.wanted)

    def keep(self, those: Those) -> None:
        """End the way of all MVs but those (n_mv,)."""
        if self.wanted is not None:
            self.wanted[~those] = np.nan
            self._end()

    def _end(self) -> None:
        if self.wanted is not None and np.isnan(self.wanted).all():
            self.wanted = None


# -------------------------------------------------------------------------------------------- as the law is told of it
class MvEntries:
    """The entries of ``operate`` that a law has of each MV.

    A law goes on from what it commanded last. An MV out of use stays there for it, and what a read-back says beyond it
    is an actuator's offset up to ``READ_BACK_MARGIN``. Where somebody else commanded the MV, the law has to learn the
    command itself: for that scan its limits are this one value.
    """

    def __init__(self, manifest: Manifest) -> None:
        whats = ("use", "low", "high", "max_move")
        at: dict[tuple[str, str], int] = {
            (e.signal, e.what): i for i, e in enumerate(manifest.operate) if e.group == "mv"
        }
        reads = "operate" in manifest.inputs
        self._at = np.array([[at.get((s.name, what), -1) if reads else -1 for what in whats] for s in manifest.mv])
        self.able: Those = self._at[:, 0] >= 0  # whether the law can do without each MV
        ends = [manifest.operate[i] if i >= 0 else None for i in self._at[:, 1:].flatten().tolist()]
        self._low, self._high = (
            np.array([np.nan if e is None else getattr(e, end) for e in ends]).reshape(-1, 3) for end in ("low", "high")
        )

    def used(self, operate: Array) -> Those:
        """Whether operators have each MV (n_mv,) in use; one that the law cannot do without is."""
        found = np.ones(len(self._at), dtype=bool)
        found[self.able] = operate[self._at[self.able, 0]] > 0
        return found

    def told(self, operate: Array, out: Those, held: Array | None, given: Array | None) -> Array:
        """``operate`` (n_operate,) as the law gets it, with the MVs ``out`` (n_mv,) out of use.

        ``held`` (n_mv,) is what is commanded of these now, ``given`` (n_mv,) what the law gave last; None: not known.
        """
        if not out.any():
            return operate
        found = operate.copy()
        for i in np.flatnonzero(out).tolist():
            use, low, high, most = self._at[i].tolist()
            found[use] = 0.0
            if held is None or given is None or held[i] == given[i] or min(low, high, most) < 0:
                continue
            if self._low[i, 0] <= held[i] <= self._high[i, 0] and self._low[i, 1] <= held[i] <= self._high[i, 1]:
                found[use], found[low], found[high], found[most] = 1.0, held[i], held[i], self._high[i, 2]
        return found
