"""The guard of controllers in plain C under random histories with sanitizers, by intervals, and over long runs.

``python benchmarks/plain_guard.py [FILE ...] [--scans N] [--steps N]``: for each file (all shipped ones) N random scans
(1,000,000) with the compiler's sanitizers, in which samples, requests, gaps, modes and states are anything; commands
outside an MV's range, faster than its rate or not finite are counted. Then the largest difference of the state between
the eleventh and the last of equal rounds of a thousand samples, N in all (10,000,000 of files whose step takes a
microsecond, 1,000,000 of others). Then, with Frama-C, the assertions that no MV leaves its range which its intervals
prove. A predictive file takes about half an hour.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # the driver's home: the tests use it, too

from plain_c_fuzz import by_intervals, fuzzer, histories

ROOT = Path(__file__).parents[1]
SHORT = 10_000  # scans by which a file's step is timed
QUICK = 2.0  # us: a step that takes ten million times


def row(file: Path, scans: int, steps: int | None) -> str:
    """The figures of one file."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        counts, said = histories(fuzzer(file, folder / "fuzz"), scans, 1)
        found = f"{counts['wrong']} wrong of {counts['scans']:,} scans, {counts['held']:,} in HOLD" if counts else said
        plain = fuzzer(file, folder / "long", "-O2")
        began = time.monotonic()
        histories(plain, SHORT, 1, "drift")
        took = 1e6 * (time.monotonic() - began) / SHORT
        length = steps or (10_000_000 if took < QUICK else 1_000_000)
        _, drift = histories(plain, length, 1, "drift")
        proven = "no Frama-C"
        if shutil.which("frama-c") is not None:
            valid, open_, _ = by_intervals(file, folder / "intervals")
            proven = f"{valid} of {valid + open_} assertions proven"
    return f"{file.parent.name}/{file.stem:28s} {found}; {length:,} steps, {drift.splitlines()[0]}; {proven}"


def main(argv: list[str]) -> int:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--scans", type=int, default=1_000_000, help="of the random histories (1,000,000)")
    parser.add_argument("--steps", type=int, default=None, help="of the long run (by the step's time)")
    options = parser.parse_args(argv)
    for file in options.files or sorted((ROOT / "artifacts").glob("*/*.onnx")):
        print(row(file, options.scans, options.steps), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
