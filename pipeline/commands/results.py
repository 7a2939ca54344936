"""The figures of every controller, and where to look."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopwright.pipeline.report.results import show_results


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("case", metavar="CASE", nargs="?", help="one case, in all of its tests (default: all cases)")
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"), help="folder of the controllers")


def run(options: argparse.Namespace) -> None:
    """Print the table."""
    show_results(options.artifacts, case=options.case)
