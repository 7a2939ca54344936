"""The exact bound on a share of failures (Clopper and Pearson, 1934)."""

from __future__ import annotations


def at_most_fail(failures: int, loops: int, confidence: float) -> float:
    """The largest share of failures that ``failures`` of ``loops`` independent loops allow, one-sided.

        p such that P(at most k failures among n | p) = 1 - c,   p = Beta^-1(c; k + 1, n - k),   1 where all failed

    Whatever the true share is, it lies above this bound in at most 1 - ``confidence`` of all certificates.
    """
    from scipy.stats import beta  # half a second to load

    if failures >= loops:
        return 1.0
    return float(beta.ppf(confidence, failures + 1, loops - failures))
