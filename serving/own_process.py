"""Another Python process that runs a module of this program: the one that this process has.

``python -m`` looks in the current folder first: a numpy.py there would run as the user of the loop.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

HOME = Path(__file__).resolve().parents[2]  # of the folder loopwright, where this package lies in one


def module(name: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """The command that runs a module with arguments, and its environment: it finds what this process finds."""
    places = dict.fromkeys([*filter(None, sys.path), str(HOME)])  # an empty one is the current folder
    command = [sys.executable, "-P", "-m", name, *arguments]
    return command, {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
