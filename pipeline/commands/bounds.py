"""``loopwright bounds``: bounds that no controller of a case can beat, stored beside the case."""

from __future__ import annotations

import argparse
import contextlib

from pipeline.cases import CASES
from pipeline.config.params import choose
from pipeline.engine.cluster import local_cluster
from pipeline.stages.bounds import compute


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("case", metavar="CASE", help=", ".join(sorted(CASES)))
    parser.add_argument("--scenario", metavar="NAME", action="append", help="only this test (may be given again)")
    parser.add_argument("--jobs", metavar="N", type=int, default=1, help="processes side by side (1)")


def run(options: argparse.Namespace) -> None:
    """Compute the bounds, a line for each figure."""
    case = choose(CASES, options.case, "case", "bounds")
    tests = case.tests()
    for name in options.scenario or ():
        choose(tests, name, "scenario", f"case {case.name!r}")
    with local_cluster(options.jobs) if options.jobs > 1 else contextlib.nullcontext():
        for line in compute(case, options.scenario or list(tests)):
            print(line, flush=True)
