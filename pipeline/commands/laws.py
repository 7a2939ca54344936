"""The control laws, and the parameters of one."""

from __future__ import annotations

import argparse

from loopwright.pipeline.commands.parameters import list_or_show
from loopwright.pipeline.laws import LAWS


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "name", metavar="NAME", nargs="?", help="a law: show its parameters and model parts (default: list)"
    )


def run(options: argparse.Namespace) -> None:
    """Print the list, or one law with its parameters and the parts of a model set that it needs."""
    list_or_show({name: (law.title, law.Params) for name, law in LAWS.items()}, options.name, "law")
    if options.name is not None:
        parts = LAWS[options.name].parts
        print("\nparts of the model set:" + " none needed" * (not parts))
        for part, words in parts.items():
            print(f"  {part:12}  {words}")
