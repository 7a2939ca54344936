"""Every section of params.yaml, read before hours of work depend on it."""

from __future__ import annotations

import argparse
import sys

from pipeline.config.params import sections
from pipeline.errors import PipelineError
from pipeline.stages.check import CHECKS, mistakes, notes


def options(parser: argparse.ArgumentParser) -> None:
    """It takes nothing."""


def run(options: argparse.Namespace) -> int:
    """0 where every section can be read, else 2 after a line for each mistake."""
    try:
        found = mistakes()
    except PipelineError as error:
        found = [str(error)]
    for line in found:
        print(f"check: {line}", file=sys.stderr)
    for line in [] if found else notes():
        print(f"check: note: {line}", file=sys.stderr)
    if not found:
        print("check: params.yaml has no mistake: " + ", ".join(f"{len(sections(kind))} {kind}" for kind in CHECKS))
    return 2 if found else 0
