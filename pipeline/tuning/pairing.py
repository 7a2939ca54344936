"""Pairing of MVs and controlled variables when each has a loop of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

Pairs = tuple[tuple[int, int], ...]
"""(CV, MV) of each loop, in the order of the MVs."""

ONE_LOOP: Pairs = ((0, 0),)  # the pairing of one MV and one PV

ALLOWED = "positive relative gains and a positive Niederlinski index"

INDEPENDENT = 1e-6  # least ratio of singular values, of gains in shares of their largest, at which CVs can be held


@dataclass(frozen=True, slots=True)
class TunedPairing:
    """A pairing whose loops were tuned: the relative gain of each pair, and the error that its best numbers gave."""

    pairs: Pairs
    relative_gains: tuple[float, ...]
    error: float  # of closed loops [% of the CVs' ranges], summed over the CVs
    time_weighted: bool = False  # each error times the periods since its set point moved

    def words(self, cvs: Sequence[Signal], mvs: Sequence[Signal]) -> str:
        """The MV of each CV, with the relative gains."""
        rows = zip(self.pairs, self.relative_gains, strict=True)
        return ", ".join(f"{cvs[i].name} by {mvs[j].name} ({gain:.2f})" for (i, j), gain in rows)


def choice_words(
    chosen: TunedPairing,
    others: Sequence[TunedPairing],
    cvs: Sequence[Signal],
    mvs: Sequence[Signal],
    *,
    given: bool = False,
) -> tuple[str, str]:
    """Two notes: the pairs of several loops with what a relative gain is, and by which rule they were chosen."""
    held = (
        f"A loop for each pair, its relative gain beside it: {chosen.words(cvs, mvs)}. With the other loops in manual, "
        "the gain of a loop is as many times that with them in automatic; at 1 they leave it alone."
    )
    rule = (
        f"Rule of the pairs: a pairing needs {ALLOWED} (gains at rest near the start; of an integrating CV, slopes). "
    )
    if given:
        return held, "Rule of the pairs: they were given, as the loops of the record are."
    if not others:
        return held, f"{rule}This is the only one."
    errors = ", ".join(f"{other.error:.3g} % for {other.words(cvs, mvs)}" for other in others)
    weighted = ", times the periods since its set point moved," if chosen.time_weighted else ""
    return held, (
        f"{rule}The {1 + len(others)} of these with relative gains nearest to 1 were tuned in closed loops, and the "
        f"smallest error decided, not the relative gains: {chosen.error:.3g} % for this pairing, {errors}. The error "
        f"is the mean over set points and loads of the development sequences{weighted} in % of each CV's range, added "
        "up; where there is noise, the price of MV travel is in it."
    )


def relative_gains(gain: Array) -> Array:
    """The relative gain array of a square gain matrix (n_cv, n_mv), same shape; no units.

        Lambda = K o (K^-1)'      element by element

    It is 1 for a pair that the other loops leave alone; at a negative one the sign of the gain turns when the other
    loops are closed. Raises LawError where no MVs hold the CVs independently.

    Source: Bristol, On a new measure of interaction for multivariable process control, 1966.
    """
    size = np.abs(gain).max(axis=1, keepdims=True)
    scaled = gain / np.where(size > 0, size, 1.0)
    values = np.linalg.svd(scaled, compute_uv=False)
    if not values[-1] > INDEPENDENT * values[0]:
        raise LawError(
            "the MVs do not hold the controlled variables independently (the matrix of gains is singular): control "
            "fewer variables, or give another MV"
        )
    return np.asarray(scaled * np.linalg.inv(scaled).T)


def gains_of(gain: Array, pairs: Pairs) -> Array:
    """The relative gains (n_cv, n_cv) of given pairs, by the CVs; ``gain`` and errors as of ``pairings``."""
    return relative_gains(gain[:, [mv for _, mv in sorted(pairs)]])


def pairings(gain: Array) -> list[tuple[Pairs, Array]]:
    """Pairings of the CVs with as many MVs, the best first, and the relative gains of their MVs (n_cv, n_cv).

    ``gain`` is in shares of the signals' ranges. Where there are more MVs than CVs, those that do most come first, by
    the column sums of K o (K^+)'; among these, relative gains nearest to 1, sum |Lambda_ij - 1|. Pairings with a
    negative relative gain or a negative Niederlinski index det K / prod K_ii are left out: with integral action they
    are unstable, or become so when one loop is opened. Raises LawError where none is left, or there are fewer MVs than
    CVs.

    Source: Skogestad and Postlethwaite, Multivariable Feedback Control, sections 3.4 and 10.6.
    """
    n_cv, n_mv = gain.shape
    if n_mv < n_cv:
        raise LawError(f"{n_cv} controlled variables need as many MVs; there are {n_mv}: control fewer variables")
    found: list[tuple[float, float, Pairs, Array]] = []
    part = (gain * np.linalg.pinv(gain).T).sum(axis=0)  # of each MV, 1 where there are as many as CVs
    refused: LawError | None = None
    for mvs in permutations(range(n_mv), n_cv):
        own = gain[:, mvs]
        try:
            table = relative_gains(own)
        except LawError as error:
            refused = error
            continue
        index = np.linalg.det(own / np.diag(own)) if np.diag(own).all() else -1.0
        if np.diag(table).min() > 0 and index > 0:
            pairs = tuple(sorted(enumerate(mvs), key=lambda pair: pair[1]))
            spared = round(n_cv - float(part[list(mvs)].sum()), 9)
            found.append((spared, float(np.abs(np.diag(table) - 1).sum()), pairs, table))
    if not found:
        raise refused or LawError(
            f"no pairing of controlled variables and MVs has {ALLOWED}: single loops do not hold this plant, choose "
            "law 'predictive'"
        )
    return [(pairs, table) for _, _, pairs, table in sorted(found, key=lambda f: f[:2])]
