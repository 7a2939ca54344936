"""Every section of params.yaml, read before hours of work depend on it."""

from __future__ import annotations

import argparse
import sys

from loopwright.pipeline.config.params import sections
from loopwright.pipeline.stages.check import CHECKS, mistakes, notes


def options(parser: argparse.ArgumentParser) -> None:
    """It takes nothing."""


def run(options: argparse.Namespace) -> int:
    """0 where every section can be read, else 2 after a line for each mistake."""
    wrong = mistakes()
    for line in wrong or [f"note: {note}" for note in notes()]:
        print(f"check: {line}", file=sys.stderr)
    if not wrong:
        print("check: params.yaml has no mistake: " + ", ".join(f"{len(sections(kind))} {kind}" for kind in CHECKS))
    return 2 if wrong else 0
