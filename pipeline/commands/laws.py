"""The control laws, and the parameters of one."""

from __future__ import annotations

import argparse

from pipeline.commands.parameters import list_or_show
from pipeline.laws import LAWS


def options(parser: argparse.ArgumentParser) -> None:
    """What the command takes."""
    parser.add_argument("name", metavar="NAME", nargs="?", help="a law: show its parameters (default: list the laws)")


def run(options: argparse.Namespace) -> None:
    """Print the list or one law."""
    list_or_show({name: (law.title, law.Params) for name, law in LAWS.items()}, options.name, "law", "laws")
