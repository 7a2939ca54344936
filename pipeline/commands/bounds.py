"""``loopwright bounds``: bounds that no controller of a case can beat, stored beside the case."""

from __future__ import annotations

import argparse

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.commands.arguments import whole
from loopwright.pipeline.config.params import choose
from loopwright.pipeline.engine.cluster import workers_here
from loopwright.pipeline.stages.bounds import compute


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("case", metavar="CASE", help=", ".join(sorted(CASES)))
    parser.add_argument("--scenario", metavar="NAME", action="append", help="only this test (may be given again)")
    parser.add_argument("--jobs", metavar="N", type=whole(1), help="processes side by side (1)")


def run(options: argparse.Namespace) -> None:
    """Compute the bounds, a line for each figure."""
    case = choose(CASES, options.case, "case")
    tests = case.tests()
    for name in options.scenario or ():
        choose(tests, name, "scenario", f"case {case.name!r}")
    with workers_here(options.jobs, "--jobs"):
        for line in compute(case, options.scenario or list(tests)):
            print(line, flush=True)
