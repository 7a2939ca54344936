"""What a scan costs in a loop's journal, packed: ``python benchmarks/journal.py [--numbers 20]``, a second.

A scan of so many numbers, of which three are set points that stand and the others measurements with noise: from nodes
of 64 bits (LREAL), of 32 bits (REAL), and from converters of 12 bits over a range of 400.
"""

from __future__ import annotations

import argparse

import numpy as np

from loopwright.serving.journal.entries import packed
from loopwright.serving.journal.writer import BLOCK_SCANS

SET_POINTS, STEP = 3, 400 / 4096
YEAR_S = 365.25 * 86_400


def bytes_a_scan(numbers: int, kind: str) -> float:
    """Bytes of a packed scan."""
    rng = np.random.default_rng(0)
    base, rows = rng.normal(size=numbers).cumsum() + 300, []
    for k in range(BLOCK_SCANS):
        values = base + 0.1 * rng.normal(size=numbers)
        values[:SET_POINTS] = base[:SET_POINTS]
        if kind == "REAL":
            values = values.astype(np.float32).astype(np.float64)
        elif kind == "12 bits":
            values = np.round(values / STEP) * STEP
        rows.append((k, 1, 1e9 + k + 1e-4 * rng.normal(), "AUTO", values.tobytes(), None, None))
    return len(packed(rows)) / BLOCK_SCANS


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--numbers", type=int, default=20)
    options = parser.parse_args()
    for kind in ("LREAL", "REAL", "12 bits"):
        size = bytes_a_scan(options.numbers, kind)
        print(f"{kind:8} {size:6.1f} bytes a scan, {size * YEAR_S / 1e9:.2f} GB a year at 1 s")


if __name__ == "__main__":
    main()
